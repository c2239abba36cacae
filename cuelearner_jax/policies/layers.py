"""The policies of the package, and those that change another policy's actions."""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax.typing import ArrayLike
from jaxtyping import Array, Float, PRNGKeyArray

from cuelearner_jax.agents.protocol import AgentFunctions
from cuelearner_jax.config import GuideScalars, GuideSizes, Scalars, to_json
from cuelearner_jax.devices import portions
from cuelearner_jax.environment import actions_of
from cuelearner_jax.feedback.answers import intended_action, relative_feedback
from cuelearner_jax.guides.base import Guide
from cuelearner_jax.guides.refining import refine
from cuelearner_jax.policies.node import BY_LANE, SHARED, PolicyNode, describe
from cuelearner_jax.policies.opaque import in_space, policy_of
from cuelearner_jax.run_config import kind_to_json, part_to_json
from cuelearner_jax.spaces import DIRECTIONS, Space
from cuelearner_jax.types import EnvState, GuidanceModel, Params, Teacher


class Agent(PolicyNode):
    """A finished agent."""

    params: Params
    functions: AgentFunctions = struct.field(pytree_node=False)
    view: Any = None  # says how an observation looks from an action; the raw frame needs none

    def act(self, key: PRNGKeyArray, states: EnvState, obs: Float[Array, "n obs"]) -> Float[Array, "n action"]:
        """The agent's action once learning is over."""
        return self.functions.act(self.view, self.params, obs, key)

    @property
    def axes(self) -> Agent:
        """Each lane has its own network."""
        return self.replace(params=BY_LANE, view=SHARED)

    def describe(self) -> dict[str, Any]:
        """The agent's options, and the frame in which it sees."""
        own = {"agent": part_to_json(self.functions.options), "frame": self.functions.frame}
        return {"policy": "agent", **own}


class Uniform(PolicyNode):
    """Uniform actions."""

    actions: Space = struct.field(pytree_node=False, default=DIRECTIONS)

    def act(self, key: PRNGKeyArray, states: EnvState, obs: Float[Array, "n obs"]) -> Float[Array, "n action"]:
        """Drawn anew each time (paper, Eq. 6)."""
        return self.actions.sample(key, (obs.shape[0],))

    def describe(self) -> dict[str, Any]:
        """Chance."""
        return {"policy": "uniform"}


class NearAims(PolicyNode):
    """Actions near one of a situation's aims, each aim as likely; uniform ones where there is none."""

    view: Any  # offers aims
    reach: Float[Array, ""] | float  # how far from the aim at most, as `log` of the space counts

    def act(self, key: PRNGKeyArray, states: EnvState, obs: Float[Array, "n obs"]) -> Float[Array, "n action"]:
        """Drawn anew each time."""
        return jax.vmap(self._one)(jax.random.split(key, len(obs)), obs)

    def _one(self, key: PRNGKeyArray, obs: Float[Array, " obs"]) -> Float[Array, " action"]:
        k_aim, k_turn, k_elsewhere = jax.random.split(key, 3)
        space, aims = actions_of(self.view), self.view.aims(obs)
        index = jax.random.categorical(k_aim, jnp.where(aims.possible, 0.0, -jnp.inf))
        change = jax.random.uniform(k_turn, (len(space.cues),), minval=-self.reach, maxval=self.reach)
        elsewhere = space.sample(k_elsewhere)
        return jnp.where(aims.possible.any(), space.exp(aims.actions[index], change), elsewhere)

    def describe(self) -> dict[str, Any]:
        """Chance near aims."""
        return {"policy": "near aims", "reach": float(actions_of(self.view).to_unit(self.reach))}


class Taught(PolicyNode):
    """What a teacher holds for best."""

    teacher: Teacher

    def act(self, key: PRNGKeyArray, states: EnvState, obs: Float[Array, "n obs"]) -> Float[Array, "n action"]:
        """The teacher's own actions."""
        return best_actions(self.teacher, states, obs)

    def describe(self) -> dict[str, Any]:
        """A teacher."""
        return {"policy": "teacher", "asks": True}


class Heuristic(PolicyNode):
    """The environment's own obvious action."""

    view: Any

    def act(self, key: PRNGKeyArray, states: EnvState, obs: Float[Array, "n obs"]) -> Float[Array, "n action"]:
        """It needs no learning."""
        return jax.vmap(self.view.heuristic)(obs)

    def describe(self) -> dict[str, Any]:
        """The task's own."""
        return {"policy": "heuristic"}


class Guided(PolicyNode):
    """Another policy's actions, every one of them under guidance."""

    base: Any  # a policy
    model: GuidanceModel
    view: Any
    scalars: GuideScalars
    guidance: Guide = struct.field(pytree_node=False)
    bound: Float[Array, ""] | None = None  # to the way from the base's actions; None: wherever guidance leads
    sizes: GuideSizes | None = struct.field(pytree_node=False, default=None)  # of the guidance: needed to store it

    def act(self, key: PRNGKeyArray, states: EnvState, obs: Float[Array, "n obs"]) -> Float[Array, "n action"]:
        """The base's actions as the guidance has them."""
        base = self.base.act(key, states, obs)
        where = (self.model, self.view, obs, base, jnp.ones(obs.shape[0], bool), self.scalars)
        if self.bound is None:
            return self.guidance.act(*where).actions
        return self.guidance.act_within(self.bound, *where).actions

    @property
    def axes(self) -> Guided:
        """Each lane has its own base and model, and its own bound where there is more than one."""
        bound = SHARED if self.bound is None or jnp.ndim(self.bound) == 0 else BY_LANE
        return self.replace(base=self.base.axes, model=BY_LANE, view=SHARED, scalars=SHARED, bound=bound)

    def describe(self) -> dict[str, Any]:
        """The guidance, its sizes (None: not known) and scalars, how far it leads at most, and the base."""
        scalars = plain_part(Scalars, self.scalars)
        space = self.guidance.spaces.actions
        bound = space.reach if self.bound is None else float(space.to_unit(np.max(self.bound), np))
        return {
            "policy": "guided",
            "guidance": self.guidance.name,
            "sizes": None if self.sizes is None else plain_part(GuideSizes, self.sizes),
            "options": kind_to_json(self.guidance.options),
            "scalars": scalars,
            "bounded": self.bound is not None,
            "clip_radius_deg": min(scalars["tau_max_deg"], bound),
            "fitted": bool(np.all(self.model.fitted)),
            "base": describe(self.base),
        }


class Common(PolicyNode):
    """One policy that all lanes of a block share, whatever it is made of."""

    policy: Any

    def act(self, key: PRNGKeyArray, states: EnvState, obs: Float[Array, "n obs"]) -> Float[Array, "n action"]:
        """What the policy does."""
        return self.policy.act(key, states, obs)

    def describe(self) -> dict[str, Any]:
        """The policy's own description."""
        return describe(self.policy)

    def lane(self, index: int | ArrayLike) -> Any:
        """The policy itself; of several lanes, what they share."""
        return self if np.ndim(index) else self.policy


class Corrected(PolicyNode):
    """Another policy's actions, refined by the teacher's own relative feedback instead of a model of it."""

    base: Any  # a policy
    teacher: Teacher
    scalars: GuideScalars
    actions: Space = struct.field(pytree_node=False, default=DIRECTIONS)

    def act(self, key: PRNGKeyArray, states: EnvState, obs: Float[Array, "n obs"]) -> Float[Array, "n action"]:
        """The base's actions, told the way until they are right."""
        space, first = self.actions, self.base.act(key, states, obs)
        eps = space.from_unit(self.scalars.eps_deg)
        best = wanted_actions(space, self.teacher, states, obs, first, self.scalars)

        def told(action: Array, best: Array) -> Array:
            return space.toward(action, relative_feedback(space, action, best, eps), eps) - action

        return refine(
            lambda current: jax.vmap(told)(current, best),
            first,
            jnp.ones(obs.shape[0], bool),
            space=space,
            tau=space.from_unit(self.scalars.tau_deg),
            tau_max=space.from_unit(self.scalars.tau_max_deg),
            k_max=self.scalars.k_max,
        ).actions

    @property
    def axes(self) -> Corrected:
        """Each lane has its own base; the teacher is one for all."""
        return self.replace(base=self.base.axes, teacher=SHARED, scalars=SHARED)

    def describe(self) -> dict[str, Any]:
        """A teacher's corrections of the base."""
        return {"policy": "corrected", "asks": True, "base": describe(self.base)}


def plain_part(kind: type, values: Any) -> dict[str, Any]:
    """The fields of a configuration class that an instance has, of it or of a class with more or fewer."""
    plain = lambda value: value.item() if hasattr(value, "item") else value  # noqa: E731
    names = [field.name for field in dataclasses.fields(kind) if hasattr(values, field.name)]
    own = {name: plain(getattr(values, name)) for name in names}
    return {name: value for name, value in to_json(kind(**own)).items() if name in own}


class Teaching(struct.PyTreeNode):
    """A policy as a teacher (`types.Teacher`): a finished agent, for instance, teaches what it does itself."""

    policy: Any

    def best_action(self, state: EnvState, obs: Float[Array, " obs"]) -> Float[Array, " action"]:
        """What the policy does; one that acts at random always draws the same."""
        states = jax.tree.map(lambda leaf: leaf[None], state)
        return self.policy.act(jax.random.key(0), states, obs[None])[0]


def teaching(given: Any, space: Space) -> Teacher:
    """Return who answers: a teacher, or whatever acts as a policy in a space of actions, which teaches what it does.

    Raises UserError for what is neither.
    """
    if callable(getattr(given, "best_action", None)) and not isinstance(given, type | Teaching):
        return given
    policy = given.policy if isinstance(given, Teaching) else policy_of(given)
    return Teaching(in_space(policy, space))


def best_actions(teacher: Teacher, states: EnvState, obs: Float[Array, "n obs"]) -> Float[Array, "n action"]:
    """A teacher's actions in n situations; few at a time, for one by search simulates hundreds of actions of each."""
    ask = lambda pair: teacher.best_action(*pair)  # noqa: E731
    return jax.lax.map(ask, (states, obs), batch_size=min(len(obs), portions().states))


def wanted_actions(
    space: Space,
    teacher: Teacher,
    states: EnvState,
    obs: Float[Array, "n obs"],
    actions: Float[Array, "n action"],
    scalars: Any,
) -> Float[Array, "n action"]:
    """What a teacher would have done instead: its best, or, where `scalars.answer` says so, the nearest good action.

    `scalars` without such a field (`GuideScalars`) mean the best.
    """
    if getattr(scalars, "answer", "best") != "nearest":
        return best_actions(teacher, states, obs)
    ask = lambda row: intended_action(space, teacher, row[0], row[1], row[2], scalars)  # noqa: E731
    return jax.lax.map(ask, (states, obs, actions), batch_size=min(len(obs), portions().states))


def uniform_in(env: Any) -> Uniform:
    """Uniform actions of an environment's space."""
    return Uniform(actions_of(env))
