"""Playing shots one after another and keeping their paths, for pictures."""

from __future__ import annotations

import jax
from jaxtyping import PRNGKeyArray

from cuelearner_envs.billiards.environment import Balls, Billiards
from cuelearner_envs.billiards.physics import Trajectory, trace
from cuelearner_jax.spaces.directions import to_angle
from cuelearner_jax.types import Policy


def record(env: Billiards, policy: Policy, key: PRNGKeyArray, shots: int) -> tuple[list[Trajectory], list[float]]:
    """Paths and rewards of `shots` shots of a policy; a new rack follows the end of an episode."""

    @jax.jit
    def play(key: PRNGKeyArray, state: Balls, obs: jax.Array) -> tuple[Balls, jax.Array, jax.Array, Trajectory]:
        k_act, k_step = jax.random.split(key)
        states = jax.tree.map(lambda leaf: leaf[None], state)
        action = policy.act(k_act, states, obs[None])[0]
        path = trace(env.table, state.positions, state.pocketed, to_angle(action) + env.action_turn)
        after, step = env.step(k_step, state, action)
        return after, step.obs, step.reward, path

    paths, rewards = [], []
    k_reset, k_play = jax.random.split(key)
    state, obs = env.reset(k_reset)
    for shot in range(shots):
        state, obs, reward, path = play(jax.random.fold_in(k_play, shot), state, obs)
        paths.append(jax.device_get(path))
        rewards.append(float(reward))
    return paths, rewards
