"""The package's policies, and policies that change another policy's actions."""

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
from cuelearner_jax.config import GuideScalars, GuideSizes, Scalars, Sizes, to_json
from cuelearner_jax.devices import portions
from cuelearner_jax.environment import actions_of
from cuelearner_jax.feedback.answers import intended_action, relative_feedback
from cuelearner_jax.guides.base import Guide
from cuelearner_jax.guides.refining import refine
from cuelearner_jax.policies.node import BY_LANE, SHARED, PolicyNode, describe
from cuelearner_jax.policies.opaque import policy_of
from cuelearner_jax.run_config import kind_to_json, part_to_json
from cuelearner_jax.spaces import DIRECTIONS, Box, Space
from cuelearner_jax.types import EnvState, GuidanceModel, Params, Teacher


class Agent(PolicyNode):
    """A finished agent."""

    params: Params
    functions: AgentFunctions = struct.field(pytree_node=False)
    view: Any = None  # provides `features`; the raw frame needs none

    def act(self, key: PRNGKeyArray, states: EnvState, obs: Float[Array, "n obs"]) -> Float[Array, "n action"]:
        """Return the finished agent's actions."""
        return self.functions.act(self.view, self.params, obs, key)

    @property
    def axes(self) -> Agent:
        """Lane axes: each lane has its own network."""
        return self.replace(params=BY_LANE, view=SHARED)

    def describe(self) -> dict[str, Any]:
        """Return the agent's options and its frame, as JSON values."""
        return {"policy": "agent", "agent": part_to_json(self.functions.options), "frame": self.functions.frame}


class Uniform(PolicyNode):
    """A policy of uniform actions."""

    KIND = "uniform"

    actions: Space = struct.field(pytree_node=False, default=DIRECTIONS)

    def act(self, key: PRNGKeyArray, states: EnvState, obs: Float[Array, "n obs"]) -> Float[Array, "n action"]:
        """Return new uniform draws at each call (paper, Eq. 6)."""
        return self.actions.sample(key, (obs.shape[0],))


class Middle(PolicyNode):
    """A policy of the action halfway between the bounds of a box."""

    KIND = "middle"

    box: Box = struct.field(pytree_node=False)

    def act(self, key: PRNGKeyArray, states: EnvState, obs: Float[Array, "n obs"]) -> Float[Array, "n action"]:
        """Return the same action in every situation."""
        return jnp.broadcast_to(self.box.middle(), (len(obs), self.box.size))


class NearAims(PolicyNode):
    """A policy of random actions near a situation's aims; uniform actions where there is no aim."""

    view: Any  # an environment or view with aims
    reach: Float[Array, ""] | float  # largest distance from the aim, in the unit of the space's `log`

    def act(self, key: PRNGKeyArray, states: EnvState, obs: Float[Array, "n obs"]) -> Float[Array, "n action"]:
        """Return new draws at each call."""
        return jax.vmap(self._one)(jax.random.split(key, len(obs)), obs)

    def _one(self, key: PRNGKeyArray, obs: Float[Array, " obs"]) -> Float[Array, " action"]:
        k_aim, k_turn, k_elsewhere = jax.random.split(key, 3)
        space, aims = actions_of(self.view), self.view.aims(obs)
        index = jax.random.categorical(k_aim, jnp.where(aims.possible, 0.0, -jnp.inf))
        change = jax.random.uniform(k_turn, (len(space.cues),), minval=-self.reach, maxval=self.reach)
        elsewhere = space.sample(k_elsewhere)
        return jnp.where(aims.possible.any(), space.exp(aims.actions[index], change), elsewhere)

    def describe(self) -> dict[str, Any]:
        """Return the kind of policy and its reach, as JSON values."""
        return {"policy": "near aims", "reach": float(actions_of(self.view).to_unit(self.reach))}


class Taught(PolicyNode):
    """A policy that executes a teacher's best actions."""

    KIND = "teacher"
    ASKS = True

    teacher: Teacher

    def act(self, key: PRNGKeyArray, states: EnvState, obs: Float[Array, "n obs"]) -> Float[Array, "n action"]:
        """Return the teacher's best actions."""
        return best_actions(self.teacher, states, obs)


class Heuristic(PolicyNode):
    """A policy of the environment's heuristic."""

    KIND = "heuristic"

    view: Any

    def act(self, key: PRNGKeyArray, states: EnvState, obs: Float[Array, "n obs"]) -> Float[Array, "n action"]:
        """Return the environment's heuristic actions."""
        return jax.vmap(self.view.heuristic)(obs)


class Guided(PolicyNode):
    """Another policy with every action under guidance."""

    base: Any  # a policy
    model: GuidanceModel
    view: Any
    scalars: GuideScalars
    guidance: Guide = struct.field(pytree_node=False)
    bound: Float[Array, ""] | None = None  # largest distance from the base's actions; None: unbounded
    # sizes of the guidance, needed to store it
    sizes: GuideSizes | None = struct.field(pytree_node=False, default=None)

    def act(self, key: PRNGKeyArray, states: EnvState, obs: Float[Array, "n obs"]) -> Float[Array, "n action"]:
        """Return the base's actions after guidance."""
        base = self.base.act(key, states, obs)
        where = (self.model, self.view, obs, base, jnp.ones(obs.shape[0], bool), self.scalars)
        if self.bound is None:
            return self.guidance.act(*where).actions
        return self.guidance.act_within(self.bound, *where).actions

    @property
    def axes(self) -> Guided:
        """Lane axes: each lane has its own base and model, and its own bound where there is more than one."""
        bound = SHARED if self.bound is None or jnp.ndim(self.bound) == 0 else BY_LANE
        return self.replace(base=self.base.axes, model=BY_LANE, view=SHARED, scalars=SHARED, bound=bound)

    def describe(self) -> dict[str, Any]:
        """Return the guidance, its sizes (None: not known) and scalars, its bound, and the base, as JSON values."""
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
    """One policy shared by all lanes of a block."""

    policy: Any

    def act(self, key: PRNGKeyArray, states: EnvState, obs: Float[Array, "n obs"]) -> Float[Array, "n action"]:
        """Return the policy's actions."""
        return self.policy.act(key, states, obs)

    def describe(self) -> dict[str, Any]:
        """Return the policy's own description."""
        return describe(self.policy)

    def lane(self, index: int | ArrayLike) -> Any:
        """Return the shared policy, for any lane."""
        return self if np.ndim(index) else self.policy


class Corrected(PolicyNode):
    """Another policy with actions refined by the teacher's own relative feedback, instead of a model of it."""

    KIND = "corrected"
    ASKS = True

    base: Any  # a policy
    teacher: Teacher
    scalars: GuideScalars
    actions: Space = struct.field(pytree_node=False, default=DIRECTIONS)

    def act(self, key: PRNGKeyArray, states: EnvState, obs: Float[Array, "n obs"]) -> Float[Array, "n action"]:
        """Return the base's actions, corrected by the teacher's answers until the teacher calls them right."""
        space, first = self.actions, self.base.act(key, states, obs)
        eps = space.from_unit(self.scalars.eps_deg)
        best = wanted_actions(space, self.teacher, states, obs, first, self.scalars)
        told = lambda action, best: space.toward(action, relative_feedback(space, action, best, eps), eps) - action  # noqa: E731
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
        """Lane axes: each lane has its own base; all lanes share the teacher."""
        return self.replace(base=self.base.axes, teacher=SHARED, scalars=SHARED)


def plain_part(kind: type, values: Any) -> dict[str, Any]:
    """Return a configuration class's fields, read from an instance of this or another class."""
    plain = lambda value: value.item() if hasattr(value, "item") else value  # noqa: E731
    names = [field.name for field in dataclasses.fields(kind) if hasattr(values, field.name)]
    own = {name: plain(getattr(values, name)) for name in names}
    return {name: value for name, value in to_json(kind(**own)).items() if name in own}


class Teaching(struct.PyTreeNode):
    """A policy as a teacher (`types.Teacher`), which shows what the policy does."""

    policy: Any

    def best_action(self, state: EnvState, obs: Float[Array, " obs"]) -> Float[Array, " action"]:
        """Return the policy's action; a random policy always draws the same."""
        states = jax.tree.map(lambda leaf: leaf[None], state)
        return self.policy.act(jax.random.key(0), states, obs[None])[0]


def teaching(given: Any, space: Space) -> Teacher:
    """Return a teacher as given, or the teacher that shows what a given policy does (`policy_of`)."""
    if callable(getattr(given, "best_action", None)) and not isinstance(given, type | Teaching):
        return given
    return Teaching(policy_of(given.policy if isinstance(given, Teaching) else given, space))


def best_actions(teacher: Teacher, states: EnvState, obs: Float[Array, "n obs"]) -> Float[Array, "n action"]:
    """Return a teacher's actions in n situations, a few at a time: a searching teacher simulates hundreds of actions
    each.
    """
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
    """Return the actions that a teacher intends: its best or, with `scalars.answer` "nearest", the nearest good ones.

    `scalars` without that field (`GuideScalars`) select the best ones.
    """
    if getattr(scalars, "answer", "best") != "nearest":
        return best_actions(teacher, states, obs)
    ask = lambda row: intended_action(space, teacher, row[0], row[1], row[2], scalars)  # noqa: E731
    return jax.lax.map(ask, (states, obs, actions), batch_size=min(len(obs), portions().states))


def uniform_in(env: Any) -> Uniform:
    """Return the policy of uniform actions of an environment's space."""
    return Uniform(actions_of(env))


def asked_from(env: Any, sizes: Sizes) -> Uniform | Middle:
    """Return the policy that questions begin with while training (`Sizes.ask_from`)."""
    space = actions_of(env)
    if sizes.ask_from == "uniform":
        return Uniform(space)
    assert isinstance(space, Box)  # see `RunConfig.guide_in`
    return Middle(space)
