"""The actions that a policy means under given unknowns; the policy is a black box, asked in batches of one size."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from cuelearner_jax import user_code
from cuelearner_jax.calibration.families import Family, undo_action, undo_observation, undo_physics
from cuelearner_jax.policies import policy_name
from cuelearner_jax.spaces import Space

Floats = np.ndarray
ROWS_CPU, ROWS_PYTHON, ROWS = 64, 512, 2048  # observations in one call of a policy
CHEAP = 4096  # rows in one call of programs without the policy


class Meaning:
    """A policy as a function of a family's unknowns.

    Args:
        policy: acts by its observations alone; opaque Python functions included.
        space: space of the policy's actions.
    """

    def __init__(self, policy: Any, space: Space) -> None:
        self.policy, self.space = policy, space
        self.known: dict[bytes, Floats] = {}  # actions by observation, where no change is of what the policy sees

    def actions(
        self, family: Family, thetas: Float[Floats, "thetas unknowns"], obs: Float[Floats, "n obs"]
    ) -> Float[Floats, "thetas n action"]:
        """Return the policy's actions in each situation, seen as it was before the changes of each theta."""
        number, count = len(thetas), len(obs)
        theta, rows = np.repeat(thetas, count, 0), np.tile(obs, (number, 1))
        if family and not any(one.sees for one in family):
            found = in_portions(partial(_planned, family), CHEAP, theta, rows, np.tile(self._acts(obs), (number, 1)))
        elif is_python(self.policy):
            before = in_portions(partial(_seen, family), CHEAP, theta, rows)
            act = partial(self.policy.act, jax.random.key(0), None)
            found = in_portions(lambda seen: act(jnp.asarray(seen)), ROWS_PYTHON, before)
            found = in_portions(partial(_planned, family), CHEAP, theta, before, found)
        else:
            portion = ROWS_CPU if jax.default_backend() == "cpu" else ROWS
            found = in_portions(partial(_meant, family, self.policy), portion, theta, rows)
        user_code.check_actions(found, policy_name(self.policy))
        return found.reshape(number, count, self.space.size)

    def _acts(self, obs: Float[Floats, "n obs"]) -> Float[Floats, "n action"]:
        """Return the policy's actions; ask only for observations that were never asked about."""
        keys = [row.tobytes() for row in obs]
        if missing := [row for row, key in enumerate(keys) if key not in self.known]:
            asked = self.actions((), np.zeros((1, 0)), obs[missing])[0]
            self.known.update({keys[row]: action for row, action in zip(missing, asked, strict=True)})
        return np.array([self.known[key] for key in keys])

    def offsets(
        self,
        family: Family,
        thetas: Float[Floats, "thetas unknowns"],
        meant: Float[Floats, "thetas n action"],
        asked: Float[Floats, "n action"],
    ) -> Float[Floats, "thetas n cues"]:
        """Return the vectors (`space.log`) from asked actions to the ones that undo the changes of meant actions."""
        number, count = meant.shape[:2]
        theta, action = np.repeat(thetas, count, 0), np.tile(asked, (number, 1))
        meant = meant.reshape(-1, self.space.size)
        found = in_portions(partial(_offset, self.space, family), CHEAP, theta, meant, action)
        return found.reshape(number, count, len(self.space.cues))

    def moved(
        self, action: Float[Floats, "n action"], offset: Float[Floats, "k n cues"]
    ) -> Float[Floats, "k n action"]:
        """Return actions moved by offsets (`space.exp`)."""
        rows = np.tile(action, (len(offset), 1)), offset.reshape(-1, len(self.space.cues))
        return in_portions(partial(_moved, self.space), CHEAP, *rows).reshape(*offset.shape[:2], self.space.size)

    def right(
        self, family: Family, thetas: Float[Floats, "thetas unknowns"], meant: Float[Floats, "thetas n action"]
    ) -> Float[Floats, "thetas n action"]:
        """Return the actions that the teacher would call right where the policy means `meant`."""
        theta, rows = np.repeat(thetas, meant.shape[1], 0), meant.reshape(-1, self.space.size)
        return in_portions(partial(_right, family), CHEAP, theta, rows).reshape(meant.shape)


def is_python(policy: Any) -> bool:
    """Return whether plain Python acts. Such a policy may call JAX itself, and would deadlock if compiled in."""
    while (base := getattr(policy, "base", None)) is not None:
        policy = base
    return bool(getattr(policy, "on_host", False))


def in_portions(program: Callable[..., Any], portion: int, *rows: Floats) -> Floats:
    """Return a program that takes any number of rows in calls of one size, so that it is compiled once."""
    count = len(rows[0])
    found = []
    for start in range(0, count, portion):
        part = [np.asarray(row[start : start + portion], np.float32) for row in rows]
        short = portion - len(part[0])
        part = [np.concatenate([row, np.repeat(row[-1:], short, 0)]) if short else row for row in part]
        found.append(np.asarray(program(*part))[: portion - short])
    return np.concatenate(found)


@partial(jax.jit, static_argnums=0)
def _meant(family: Family, policy: Any, theta: Any, obs: Any) -> Any:
    before = _seen(family, theta, obs)
    return _planned(family, theta, before, policy.act(jax.random.key(0), None, before))


@partial(jax.jit, static_argnums=0)
def _planned(family: Family, theta: Any, before: Any, action: Any) -> Any:
    return jax.vmap(partial(undo_physics, family))(theta, before, action) if family else action


@partial(jax.jit, static_argnums=0)
def _seen(family: Family, theta: Any, obs: Any) -> Any:
    return jax.vmap(partial(undo_observation, family))(theta, obs) if family else obs


@partial(jax.jit, static_argnums=0)
def _right(family: Family, theta: Any, meant: Any) -> Any:
    return (
        jax.vmap(lambda one, action: undo_action(family, one, action, corrects=False))(theta, meant)
        if family
        else meant
    )


@partial(jax.jit, static_argnums=0)
def _moved(space: Space, action: Any, offset: Any) -> Any:
    return space.exp(action, offset)


@partial(jax.jit, static_argnums=(0, 1))
def _offset(space: Space, family: Family, theta: Any, meant: Any, asked: Any) -> Any:
    return space.log(jnp.asarray(asked), _right(family, theta, meant))
