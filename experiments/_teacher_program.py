"""Training of a learned teacher: action values fitted far from the 1:1 recipe of the compared agents.

Many environments in parallel, states visited by the teacher's own play, many directions tried in each, large batches.
It serves tasks whose value of an action is its immediate reward (discount 0), because then any number of actions may be
tried in one state.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import partial
from typing import Annotated, Any, NamedTuple

import jax
import jax.numpy as jnp
import optax
from flax import struct
from jaxtyping import Array, Float, PRNGKeyArray

from cuelearner_jax.agents.networks import all_finite
from cuelearner_jax.config import Bounds, Layers
from cuelearner_jax.environment import random_symmetries
from cuelearner_jax.spaces import directions as geometry
from cuelearner_jax.teachers import expected_reward, init_params
from cuelearner_jax.types import Params

SHARPNESS = 0.05  # values that differ by this are told apart when promising directions are drawn


@dataclass(frozen=True)
class TeacherConfig:
    """Settings of a teacher's training."""

    layers: Layers = (512, 512, 512, 512)
    """Hidden layers."""
    tables: Annotated[int, Bounds(1)] = 4096
    """Environments that play in parallel."""
    tries: Annotated[int, Bounds(4, 1 << 16)] = 8
    """Directions tried in each state: the best, promising ones near their peaks, two uniform ones."""
    search: Annotated[int, Bounds(1)] = 360
    """Directions over which it looks for promising ones (turned at random each time)."""
    directions: Annotated[int, Bounds(1)] = 3600
    """Directions among which the finished teacher takes its best."""
    memory: Annotated[int, Bounds(1)] = 64
    """Rounds of play kept for training."""
    updates: Annotated[int, Bounds(1)] = 8
    """Gradient steps a round."""
    batch_size: Annotated[int, Bounds(1)] = 8192
    """Tries in a gradient step."""
    learning_rate: Annotated[float, Bounds(0, math.inf, above=True)] = 1e-3
    """Adam's peak step size (cosine decay over the run)."""
    rounds: Annotated[int, Bounds(1)] = 8000
    """Rounds of play."""
    explore_probability: Annotated[float, Bounds(0, 1)] = 0.05
    """Share of shots played in a uniform direction."""
    spread_deg: Annotated[float, Bounds(0, 180)] = 2.0
    """Largest standard deviation of the directions tried round a promising one [deg]."""


class TeacherState(struct.PyTreeNode):
    """The whole state of a teacher's training."""

    params: Params
    average: Params  # exponential moving average: what becomes the teacher
    opt_state: Any
    obs: Float[Array, "memory tables obs"]  # states of the last rounds
    tried: Float[Array, "memory tables tries 2"]
    rewards: Float[Array, "memory tables tries"]
    env: Any  # leading axis: tables
    current: Float[Array, "tables obs"]
    key: PRNGKeyArray
    round: jax.Array


class Trainer(NamedTuple):
    """Pure functions of a training: a hashable value, so that `init` and `train` are jitted once for each config."""

    config: TeacherConfig

    @property
    def optimizer(self) -> optax.GradientTransformation:
        """Adam with a warm-up and a cosine decay, gradients clipped to a norm of 1."""
        c = self.config
        schedule = optax.warmup_cosine_decay_schedule(
            0.0, c.learning_rate, min(500, c.rounds * c.updates // 10), c.rounds * c.updates
        )
        return optax.chain(optax.clip_by_global_norm(1.0), optax.adam(schedule))

    @partial(jax.jit, static_argnums=0)
    def init(self, env: Any, key: PRNGKeyArray) -> TeacherState:
        """A fresh network, every table at the start of an episode."""
        c = self.config
        k_params, k_env, key = jax.random.split(key, 3)
        env_state, obs = jax.vmap(env.reset)(jax.random.split(k_env, c.tables))
        params = init_params(c.layers, env, k_params)
        return TeacherState(
            params=params,
            average=jax.tree.map(jnp.copy, params),
            opt_state=self.optimizer.init(params),
            obs=jnp.zeros((c.memory, c.tables, env.obs_size)),
            tried=jnp.ones((c.memory, c.tables, c.tries, 2)),
            rewards=jnp.zeros((c.memory, c.tables, c.tries)),
            env=env_state,
            current=obs,
            key=key,
            round=jnp.zeros((), jnp.int32),
        )

    def propose(self, env: Any, params: Params, obs: jax.Array, key: PRNGKeyArray) -> jax.Array:
        """Directions to try in one state (tries, 2): the best, promising ones, two uniform ones."""
        c = self.config
        k_turn, k_draw, k_width, k_noise, k_uniform = jax.random.split(key, 5)
        turn = jax.random.uniform(k_turn, maxval=2 * jnp.pi / c.search)
        options = geometry.rotate(geometry.evenly_spaced(c.search), turn)
        values = expected_reward(c.layers, env, params, obs, options)
        best = jnp.argmax(values)
        promising = jax.random.categorical(k_draw, values / SHARPNESS, shape=(c.tries - 3,))
        width = jnp.deg2rad(c.spread_deg) * jax.random.uniform(k_width, (c.tries - 3,))
        near = geometry.rotate(options[promising], width * jax.random.normal(k_noise, (c.tries - 3,)))
        return jnp.concatenate([options[best][None], near, geometry.uniform(k_uniform, (2,))])

    def play(self, env: Any, state: TeacherState) -> tuple[TeacherState, jax.Array]:
        """Play one round: every table tries its directions, then continues from one of them."""
        c = self.config
        k_propose, k_try, k_choice, key = jax.random.split(state.key, 4)
        tried = jax.vmap(partial(self.propose, env, state.params))(state.current, jax.random.split(k_propose, c.tables))
        keys = jax.random.split(k_try, (c.tables, c.tries))
        outcomes, steps = jax.vmap(jax.vmap(env.step, (0, None, 0)))(keys, state.env, tried)
        # The best direction comes first and the last one is uniform.
        choice = jnp.where(jax.random.bernoulli(k_choice, c.explore_probability, (c.tables,)), c.tries - 1, 0)
        taken = jax.tree.map(lambda leaf: leaf[jnp.arange(c.tables), choice], (outcomes, steps.obs))
        slot = state.round % c.memory
        put = partial(jax.lax.dynamic_update_index_in_dim, index=slot, axis=0)
        state = state.replace(
            obs=put(state.obs, state.current),
            tried=put(state.tried, tried),
            rewards=put(state.rewards, steps.reward),
            env=taken[0],
            current=taken[1],
            key=key,
            round=state.round + 1,
        )
        return state, steps.reward[:, 0].mean()

    def learn(self, env: Any, state: TeacherState, key: PRNGKeyArray) -> tuple[TeacherState, jax.Array]:
        """Take one gradient step on tries from memory, each under a random symmetry of the environment."""
        c = self.config
        k_round, k_table, k_try, k_mirror = jax.random.split(key, 4)
        shape = (c.batch_size,)
        filled = jnp.minimum(state.round, c.memory)
        where = (jax.random.randint(k_round, shape, 0, filled), jax.random.randint(k_table, shape, 0, c.tables))
        attempt = jax.random.randint(k_try, shape, 0, c.tries)
        obs, action, reward = state.obs[where], state.tried[(*where, attempt)], state.rewards[(*where, attempt)]
        obs, action = random_symmetries(k_mirror, env, c.batch_size)(obs, action)

        def loss(params: Params) -> jax.Array:
            values = jax.vmap(partial(expected_reward, c.layers, env, params))(obs, action)
            return jnp.mean(jnp.square(values - reward))

        error, gradient = jax.value_and_grad(loss)(state.params)
        updates, opt_state = self.optimizer.update(gradient, state.opt_state, state.params)
        params = optax.apply_updates(state.params, updates)
        # The average forgets its random start first, then covers about a thousand steps.
        rate = jnp.maximum(1.0 / (1.0 + state.round), 1e-3)
        average = optax.incremental_update(params, state.average, rate)
        return state.replace(params=params, average=average, opt_state=opt_state), error

    @partial(jax.jit, static_argnums=(0, 3), donate_argnums=2)
    def train(self, env: Any, state: TeacherState, rounds: int) -> tuple[TeacherState, dict[str, jax.Array]]:
        """`rounds` rounds of play with their gradient steps.

        Returns:
            The state; mean "reward" of its own best directions, mean "loss", and whether all is "finite".
        """

        def one_round(state: TeacherState, _: None) -> tuple[TeacherState, tuple[jax.Array, jax.Array]]:
            state, reward = self.play(env, state)
            key, k_learn = jax.random.split(state.key)
            state, errors = jax.lax.scan(
                lambda state, key: self.learn(env, state, key),
                state.replace(key=key),
                jax.random.split(k_learn, self.config.updates),
            )
            return state, (reward, errors.mean())

        state, (reward, error) = jax.lax.scan(one_round, state, length=rounds)
        finite = all_finite((error, reward, state.params, state.average))
        return state, {"reward": reward.mean(), "loss": error.mean(), "finite": finite}
