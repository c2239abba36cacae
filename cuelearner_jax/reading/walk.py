"""Situations and answers in a simulated world: states that the policy meets, and a simulated teacher."""

from __future__ import annotations

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from cuelearner_jax import user_code
from cuelearner_jax.asking import check_observations
from cuelearner_jax.config import Scalars
from cuelearner_jax.devices import portions
from cuelearner_jax.environment import Environment, actions_of
from cuelearner_jax.feedback.answers import RELATIVE
from cuelearner_jax.policies import policy_name
from cuelearner_jax.reading.session import run_of
from cuelearner_jax.types import EnvState, Teacher

BEFORE = 12  # steps before the first questions
EACH, APART = 4, 12  # situations of each environment between two batches; steps between two situations


class Walk:
    """Environments of the changed world in which a policy acts between questions, and that world's teacher."""

    def __init__(self, env: Environment, teacher: Teacher, scalars: Scalars) -> None:
        self.env, self.teacher, self.scalars = env, teacher, scalars
        self.states: Any = None
        self.obs: Any = None

    def situations(self, key: PRNGKeyArray, policy: Any, count: int) -> tuple[EnvState, Float[Array, "count obs"]]:
        """Let a policy act on, and return `count` situations on the way."""
        envs, steps = -(-count // EACH), EACH * APART
        total = steps + (BEFORE if self.states is None else 0)
        keys = jax.random.split(key, 1 + total)
        if self.states is None or len(self.obs) != envs:
            self.states, self.obs = _start(self.env, jax.random.split(keys[0], envs))
        act, name, situations = run_of(policy), policy_name(policy), []
        for rest in reversed(range(total)):
            k_act, k_env = jax.random.split(keys[total - rest])
            check_observations(self.obs)
            action = act(k_act, self.states, self.obs)
            user_code.check_actions(actions_of(self.env).only_actions(action), name)  # before the world is blamed
            self.states, self.obs = _step(self.env, jax.random.split(k_env, envs), self.states, action)
            if rest % APART == 0 and rest < steps:
                situations.append((self.states, self.obs))
        check_observations(self.obs)
        # Situations of one environment are adjacent, so that one question is chosen from few environments.
        return _adjacent(count, situations)

    def answers(
        self, key: PRNGKeyArray, states: EnvState, obs: Float[Array, "n obs"], actions: Float[Array, "n action"]
    ) -> tuple[Float[Array, "n cues"], Bool[Array, " n"]]:
        """Return the teacher's answers, and which questions are answered."""
        return _answers(self.env, self.teacher, self.scalars, jax.random.split(key, len(obs)), states, obs, actions)


@partial(jax.jit, static_argnums=0)
def _adjacent(count: int, situations: Any) -> Any:
    return jax.tree.map(lambda *rows: jnp.stack(rows, 1).reshape(-1, *rows[0].shape[1:])[:count], *situations)


_start = jax.jit(lambda env, keys: jax.vmap(env.reset)(keys))


@jax.jit
def _step(env: Any, keys: Any, states: Any, actions: Any) -> Any:
    after, step = jax.vmap(env.step)(keys, states, actions)
    return after, step.obs


@jax.jit
def _answers(env: Any, teacher: Any, scalars: Any, keys: Any, states: Any, obs: Any, actions: Any) -> Any:
    def one(row: Any) -> Any:
        key, state, own_obs, action = row
        return RELATIVE.answer(key, env, teacher, state, own_obs, action, scalars)

    return jax.lax.map(one, (keys, states, obs, actions), batch_size=min(len(obs), portions().states))
