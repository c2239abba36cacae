"""Convert between Gymnasium's spaces and vectors: flatten observations, and make actions from vectors.

This module imports neither JAX nor Gymnasium, so that worker processes start quickly.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import numpy as np

from cuelearner_jax.errors import UserError

IMAGE_AXES = 3
LARGEST = 1e30  # a bound from here on is none: float32's own largest number, say


class Leaf(NamedTuple):
    """One entry of a (nested) space of observations."""

    path: tuple[Any, ...]  # keys and places that lead to it
    kind: str  # "box", "bits" or "one of"
    shape: tuple[int, ...]  # shape of the environment's value
    choices: tuple[int, ...] = ()  # for "one of": the number of values of each entry
    start: tuple[int, ...] = ()  # for "one of": the first value of each entry

    @property
    def size(self) -> int:
        """Number of entries that the leaf fills in the vector."""
        return sum(self.choices) if self.kind == "one of" else int(np.prod(self.shape, dtype=int))

    @property
    def name(self) -> str:
        """The leaf's keys, joined by dots, as a name in messages."""
        return ".".join(map(str, self.path)) or "observation"


def leaves_of(whose: str, space: Any) -> tuple[Leaf, ...]:
    """Return the entries of a space of observations, in the order of the space.

    Raises UserError for images and for spaces that have no vectors; `whose`: for the message.
    """
    return tuple(_leaves(whose, space, ()))


def _leaves(whose: str, space: Any, path: tuple[Any, ...]) -> Iterator[Leaf]:
    name, kind = ".".join(map(str, path)) or "observation", type(space).__name__
    if kind == "Dict":
        for key, inner in space.spaces.items():
            yield from _leaves(whose, inner, (*path, key))
    elif kind == "Tuple":
        for number, inner in enumerate(space.spaces):
            yield from _leaves(whose, inner, (*path, number))
    elif kind == "Box":
        shape = tuple(map(int, space.shape))
        if len(shape) >= IMAGE_AXES or (len(shape) == 2 and space.dtype == np.uint8):
            raise UserError(
                f"{whose}: observation {name!r} is an image of shape {shape}: give one with observations of numbers (a "
                "vector, or a dictionary of vectors); pictures for people come from render_mode='rgb_array'"
            )
        yield Leaf(path, "box", shape)
    elif kind == "Discrete":
        yield Leaf(path, "one of", (), (int(space.n),), (int(space.start),))
    elif kind == "MultiDiscrete":
        counts = tuple(map(int, np.ravel(space.nvec)))
        yield Leaf(path, "one of", tuple(space.shape), counts, tuple(map(int, np.ravel(space.start))))
    elif kind == "MultiBinary":
        yield Leaf(path, "bits", tuple(space.shape))
    else:
        raise UserError(
            f"{whose}: observation {name!r} is a {kind}: give one of Box, Discrete, MultiDiscrete or MultiBinary, or a "
            "Dict or Tuple of these"
        )


class NoVector(Exception):
    """An observation outside its space; the message says what was given and what is wanted."""


def flatten(leaves: tuple[Leaf, ...], obs: Any) -> np.ndarray:
    """Return an observation as a vector (obs,) of float32. Raises NoVector for an observation outside its space."""
    parts = [_vector(leaf, obs) for leaf in leaves]
    return np.concatenate(parts, dtype=np.float32, casting="unsafe") if len(parts) > 1 else parts[0].astype(np.float32)


def _vector(leaf: Leaf, obs: Any) -> np.ndarray:
    value = obs
    for key in leaf.path:
        try:
            value = value[key]
        except (KeyError, IndexError, TypeError):
            raise NoVector(f"no entry {leaf.name!r} in its observation, which its space has") from None
    try:
        found = np.asarray(value)
    except (TypeError, ValueError):
        found = np.empty((0, 0), object)
    if found.shape != leaf.shape or found.dtype.kind not in "biuf":
        raise NoVector(f"an observation {leaf.name!r} of shape {found.shape}, where its space has {leaf.shape}")
    if leaf.kind != "one of":
        return found.ravel()
    rows = np.zeros(sum(leaf.choices), np.float32)
    ends = np.cumsum((0, *leaf.choices))
    for end, count, start, number in zip(ends[:-1], leaf.choices, leaf.start, found.ravel(), strict=True):
        if not 0 <= int(number) - start < count:
            raise NoVector(f"an observation {leaf.name!r} of {number}, where its space has {start} to {start + count}")
        rows[end + int(number) - start] = 1.0
    return rows


class Actions(NamedTuple):
    """A space of actions as vectors: a box between bounds, or choices."""

    low: tuple[float, ...] = ()
    high: tuple[float, ...] = ()
    choices: int = 0  # above 0: one of so many

    @property
    def size(self) -> int:
        """Number of entries of an action."""
        return self.choices or len(self.low)


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
    if (fixed := np.flatnonzero(low == high)).size:
        raise UserError(
            f"{whose}: entry {fixed[0] + 1} of its actions can only be {low[fixed[0]]:g}: wrap it so that the entry is "
            "left out"
        )
    ends = (np.abs(low) < LARGEST) & (np.abs(high) < LARGEST)
    if not ends.all():
        number = int(np.flatnonzero(~ends)[0]) + 1
        raise UserError(
            f"{whose}: entry {number} of its actions has no bounds: wrap it, for instance in "
            "gymnasium.wrappers.RescaleAction"
        )
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
