"""Where questions come from in a simulated world: situations that the policy meets, and a simulated teacher."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from cuelearner_jax.calibration.meaning import is_python
from cuelearner_jax.config import Scalars
from cuelearner_jax.devices import portions
from cuelearner_jax.environment import Environment
from cuelearner_jax.feedback.answers import relative_answer
from cuelearner_jax.types import EnvState, Teacher

BEFORE, BETWEEN = 12, 4  # steps before the first questions, and between two batches


class Walk:
    """Environments in which a policy acts between questions.

    Args:
        env: the changed world.
        teacher: of that world.
        scalars: strength of answers, in the space's unit, and faults of the teacher.
    """

    def __init__(self, env: Environment, teacher: Teacher, scalars: Scalars) -> None:
        self.env, self.teacher, self.scalars = env, teacher, scalars
        self.states: Any = None
        self.obs: Any = None

    def situations(self, key: PRNGKeyArray, policy: Any, count: int) -> tuple[EnvState, Float[Array, "count obs"]]:
        """Walk on with a policy, and return where `count` environments are then."""
        k_start, *keys = jax.random.split(key, 1 + (BETWEEN if self.states is not None else BEFORE))
        if self.states is None or len(self.obs) != count:
            self.states, self.obs = _start(self.env, jax.random.split(k_start, count))
        act = policy.act if is_python(policy) else jax.jit(policy.act)
        for k_step in keys:
            k_act, k_env = jax.random.split(k_step)
            action = act(k_act, self.states, self.obs)
            self.states, self.obs = _step(self.env, jax.random.split(k_env, count), self.states, action)
        return self.states, self.obs

    def answers(
        self, key: PRNGKeyArray, states: EnvState, obs: Float[Array, "n obs"], actions: Float[Array, "n action"]
    ) -> Float[Array, "n cues"]:
        """The teacher's answers; NaN where it says nothing."""
        keys = jax.random.split(key, len(obs))
        return _answers(self.env, self.teacher, self.scalars, keys, states, obs, actions)


@jax.jit
def _start(env: Any, keys: Any) -> Any:
    return jax.vmap(env.reset)(keys)


@jax.jit
def _step(env: Any, keys: Any, states: Any, actions: Any) -> Any:
    after, step = jax.vmap(env.step)(keys, states, actions)
    return after, step.obs


@jax.jit
def _answers(env: Any, teacher: Any, scalars: Any, keys: Any, states: Any, obs: Any, actions: Any) -> Any:
    def one(row: Any) -> Any:
        key, state, seen, action = row
        answer, answered = relative_answer(key, env, teacher, state, seen, action, scalars)
        return jnp.where(answered, answer, jnp.nan)

    return jax.lax.map(one, (keys, states, obs, actions), batch_size=min(len(obs), portions().states))
