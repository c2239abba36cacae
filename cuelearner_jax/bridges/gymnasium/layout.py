"""Convert between Gymnasium's spaces and vectors: flatten observations, and make actions from vectors.

This module imports neither JAX nor Gymnasium, so that worker processes start quickly.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from cuelearner_jax.errors import UserError

LARGEST = 1e30  # a bound from here on is none: float32's own largest number, say


class Leaf(NamedTuple):
    """One entry of a (nested) space of observations."""

    path: tuple[Any, ...]  # keys and places that lead to it
    shape: tuple[int, ...]  # shape of the environment's value
    choices: tuple[int, ...] = ()  # number of values of each entry, which the vector holds one-hot; (): as they are
    start: tuple[int, ...] = ()  # the first value of each entry with choices

    @property
    def size(self) -> int:
        """Number of entries that the leaf fills in the vector."""
        return sum(self.choices) or int(np.prod(self.shape, dtype=int))

    @property
    def name(self) -> str:
        """The leaf's keys, joined by dots."""
        return ".".join(map(str, self.path)) or "observation"


def leaves_of(whose: str, space: Any, path: tuple[Any, ...] = ()) -> tuple[Leaf, ...]:
    """Return the entries of a space of observations, in the order of the space.

    Raises UserError for images and for spaces that have no vectors; `whose`: for the message.
    """
    kind = type(space).__name__
    if kind in ("Dict", "Tuple"):
        parts = space.spaces.items() if kind == "Dict" else enumerate(space.spaces)
        return tuple(leaf for key, inner in parts for leaf in leaves_of(whose, inner, (*path, key)))
    leaf = Leaf(path, tuple(space.shape or ()))
    if kind in ("Discrete", "MultiDiscrete"):
        counts, start = (
            np.ravel(part).tolist() for part in (getattr(space, "nvec", getattr(space, "n", 0)), space.start)
        )
        return (leaf._replace(choices=tuple(counts), start=tuple(start)),)
    if kind not in ("Box", "MultiBinary"):
        raise UserError(
            f"{whose}: observation {leaf.name!r} is a {kind}: give one of Box, Discrete, MultiDiscrete or MultiBinary, "
            "or a Dict or Tuple of these"
        )
    if kind == "Box" and len(leaf.shape) + (space.dtype == np.uint8) >= 3:
        raise UserError(
            f"{whose}: observation {leaf.name!r} is an image of shape {leaf.shape}: give one with observations of "
            "numbers (a vector, or a dictionary of vectors); pictures for people come from render_mode='rgb_array'"
        )
    return (leaf,)


class NoVector(Exception):
    """An observation outside its space; the message says what was given and what is wanted."""


def flatten(leaves: tuple[Leaf, ...], obs: Any) -> np.ndarray:
    """Return an observation as a vector (obs,) of float32. Raises NoVector for an observation outside its space."""
    return np.concatenate([_vector(leaf, obs) for leaf in leaves], dtype=np.float32, casting="unsafe")


def _vector(leaf: Leaf, obs: Any) -> np.ndarray:
    try:
        for key in leaf.path:
            obs = obs[key]
        value = np.asarray(obs)
    except (KeyError, IndexError, TypeError, ValueError):
        raise NoVector(f"no numbers {leaf.name!r} in its observation, which its space has") from None
    if value.shape != leaf.shape or value.dtype.kind not in "biuf":
        raise NoVector(f"an observation {leaf.name!r} of shape {value.shape}, where its space has {leaf.shape}")
    if not leaf.choices:
        return value.ravel()
    places = value.ravel().astype(int) - np.array(leaf.start, int)
    if ((places < 0) | (places >= leaf.choices)).any():
        raise NoVector(
            f"an observation {leaf.name!r} of {value}, beyond the {leaf.choices} values from {leaf.start} on"
        )
    rows = np.zeros(leaf.size, np.float32)
    rows[places + np.cumsum((0, *leaf.choices[:-1]), dtype=int)] = 1.0
    return rows


class Actions(NamedTuple):
    """A space of actions as vectors: a box between bounds, or choices."""

    low: tuple[float, ...] = ()
    high: tuple[float, ...] = ()
    choices: int = 0  # above 0: one of so many


def actions_of(whose: str, space: Any) -> Actions:
    """Return a space of actions as vectors. Raises UserError for one that is neither a bounded box nor choices."""
    kind = type(space).__name__
    if kind == "Discrete":
        if int(space.n) < 2:
            raise UserError(f"{whose}: there is only one action: give an environment with a choice")
        return Actions(choices=int(space.n))
    if kind != "Box":
        raise UserError(f"{whose}: its actions are a {kind}: wrap the environment so that they are a Box or Discrete")
    low, high = np.ravel(space.low).astype(float), np.ravel(space.high).astype(float)
    for number, (least, most) in enumerate(zip(low, high, strict=True), 1):
        if least == most:
            raise UserError(f"{whose}: entry {number} of its actions can only be {least:g}: wrap it to leave it out")
        if not max(-least, most) < LARGEST:
            raise UserError(f"{whose}: entry {number} of its actions has no bounds: wrap it, as in RescaleAction")
    return Actions(tuple(low.tolist()), tuple(high.tolist()))


def action_maker(space: Any) -> Callable[[np.ndarray], Any]:
    """Return the function that makes an environment's action from a vector (action,)."""
    if type(space).__name__ == "Discrete":
        start = int(space.start)
        return lambda vector: int(vector.argmax()) + start
    shape, dtype = space.shape, space.dtype
    if np.issubdtype(dtype, np.integer):
        return lambda vector: np.round(vector).reshape(shape).astype(dtype)
    return lambda vector: vector.reshape(shape).astype(dtype)
