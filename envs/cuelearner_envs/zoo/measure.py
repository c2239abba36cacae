"""Measure how much each error costs, and whether the teacher's actions bring the loss back."""

from __future__ import annotations

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from cuelearner_envs.zoo.robots import ZooRobot, policy
from cuelearner_envs.zoo.worlds import ERRORS, change, right, rollout, unchanged


class Scores(NamedTuple):
    """Means over episodes; shape (robots, errors), of `unchanged` the same in each error."""

    unchanged: Float[Array, "robots errors"]  # the policy where nothing is wrong
    unadapted: Float[Array, "robots errors"]  # the policy in the world of the error
    teacher: Float[Array, "robots errors"]  # the teacher's actions in the world of the error


@partial(jax.jit, static_argnames=("episodes",))
def measure(key: PRNGKeyArray, robots: ZooRobot, episodes: int = 20) -> tuple[Scores, Scores]:
    """Return successes and returns of robots (leading axis) in the world of every error."""

    def one(robot: ZooRobot, key: PRNGKeyArray, error: Array) -> tuple[Array, Array]:
        world, keys = change(key, robot, error), jax.random.split(key, episodes)
        act = lambda obs: policy(robot, obs)  # noqa: E731
        ways = (
            lambda key: rollout(key, unchanged(robot), act)[2:],
            lambda key: rollout(key, world, act)[2:],
            lambda key: rollout(key, world, lambda state: right(world, state), knows=True)[2:],
        )
        means = [jax.tree.map(jnp.mean, jax.vmap(way)(keys)) for way in ways]
        return jnp.stack([successes for _, successes in means]), jnp.stack([total for total, _ in means])

    count = robots.task.shape[0]
    keys = jax.random.split(key, (count, len(ERRORS)))
    each = jax.vmap(jax.vmap(one, (None, 0, 0)), (0, 0, None))
    successes, total = each(robots, keys, jnp.arange(len(ERRORS)))
    return Scores(*jnp.moveaxis(successes, -1, 0)), Scores(*jnp.moveaxis(total, -1, 0))
