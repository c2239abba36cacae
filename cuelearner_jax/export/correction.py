"""Export a correction alone: a corrected policy without its base, which runs elsewhere and supplies its action.

Such a decision takes observation and base action. In the contract, the observation ends with a slice "base action".
Where the base is asked about other observations, these follow the action, and there is a base action for each.
"""

from __future__ import annotations

from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Float, PRNGKeyArray

from cuelearner_jax.environment import BASE, Quantity, action_of, actions_of
from cuelearner_jax.errors import UserError
from cuelearner_jax.export import decisions
from cuelearner_jax.policies import PolicyNode, describe, uniform_in
from cuelearner_jax.spaces import Space
from cuelearner_jax.types import EnvState

ABOUT = (
    "a correction alone: the last slice is the action of a base elsewhere, given as decide(observation, base_action)"
)
ABOUT_QUESTIONS = ", one base_action for each of decide.base_observations(observation), as many as `questions` says"


class FixedActions(PolicyNode):
    """Policy with fixed actions, supplied from elsewhere, for each of its calls, whose observations it keeps."""

    KIND = "given"

    actions: list[Float[Array, "n action"]] = struct.field(default_factory=list)
    questions: list[Float[Array, "n obs"]] = struct.field(pytree_node=False, default_factory=list)

    def act(self, key: PRNGKeyArray, states: EnvState, obs: Float[Array, "n obs"]) -> Float[Array, "n action"]:
        """Return the actions supplied for this call."""
        self.questions.append(obs)
        return self.actions[len(self.questions) - 1]


class CorrectionAlone(PolicyNode):
    """The correction of an action that a base policy elsewhere has chosen."""

    corrected: Any  # the policy, with any base
    space: Space = struct.field(pytree_node=False)
    calls: tuple[int, ...] = struct.field(pytree_node=False)  # for each call of the base: which of its actions counts
    questions: int = struct.field(pytree_node=False)  # number of observations for the base; 0: as they are

    def act(self, key: PRNGKeyArray, states: EnvState, obs: Float[Array, "n input"]) -> Float[Array, "n output"]:
        """Return rows of corrected action and observations for the base, for rows of observation and base actions."""
        count = 1 + max(self.calls)
        own, base = jnp.split(obs, [obs.shape[-1] - count * self.space.size], -1)
        base = self.space.retract(self.space.only_actions(base.reshape(len(obs), count, -1)))
        below = FixedActions([base[:, number] for number in self.calls])
        action = _over(self.corrected, below).act(key, states, own)
        questions = dict(zip(self.calls, below.questions, strict=True))  # the last one of each number
        return jnp.concatenate([action, *(questions[number] for number in range(self.questions))], -1)

    def describe(self) -> dict[str, Any]:
        """Describe the nested corrections of a supplied action."""
        return describe(self.corrected)


def _over(policy: Any, base: Any) -> Any:
    """Return a corrected policy with its innermost base replaced."""
    below = policy.base
    return policy.replace(base=_over(below, base) if getattr(below, "base", None) is not None else base)


def _calls(policy: Any) -> tuple[int, ...]:
    """Return, for each call that a correction makes of its innermost base, the number of the action that answers it.

    A reading calls its base twice, about what is met and about what is met with the change undone. Where one of them
    does not matter, the same action answers both.
    """
    if getattr(policy, "base", None) is None:
        return (0,)
    calls, questions = _calls(policy.base), getattr(policy, "questions", None)  # None: of no reading, which calls once
    return calls + tuple(number + (1 + max(calls)) * (questions > 1) for number in calls if questions is not None)


def correction_of(policy: Any, env: Any) -> tuple[CorrectionAlone, Any, Callable[[], Float[np.ndarray, "n input"]]]:
    """Return a policy's correction alone, its input and output in place of a world, and what draws such inputs."""
    if getattr(policy, "base", None) is None:
        raise UserError("this policy has no correction: give a corrected policy, or export the whole policy")
    space, action, calls, layer, sees = actions_of(env), action_of(env), _calls(policy), policy, False
    while layer is not None:
        layer, sees = getattr(layer, "base", None), sees or getattr(layer, "questions", 0) > 0
    count = 1 + max(calls)
    base = Quantity(BASE, count * space.size, action.unit, "what the base, which is elsewhere, would do")
    size = env.obs_size + base.size
    beside = SimpleNamespace(observation=(*env.observation, base), obs_size=size, actions=space, action=action)
    entry = {"size": space.size, **({"questions": count} if sees else {}), "about": ABOUT + ABOUT_QUESTIONS * sees}
    beside.alone = [env.obs_size, base.size], [space.size, count * env.obs_size][: 1 + sees], entry

    def draw() -> Float[np.ndarray, "n input"]:
        obs = decisions.observations(env, uniform_in(env))
        actions = space.sample(jax.random.key(1), (len(obs), count))
        return np.concatenate([obs, np.asarray(actions).reshape(len(obs), -1)], -1)

    without = jax.tree.map(jnp.asarray, _over(policy, FixedActions()))
    return CorrectionAlone(without, space, calls, count * sees), beside, draw
