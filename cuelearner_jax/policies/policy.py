"""The base class of policies, the package's own policies, and policies that change another policy's actions."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from typing import Any, ClassVar

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
from cuelearner_jax.errors import UserError
from cuelearner_jax.feedback.answers import intended_action, relative_feedback
from cuelearner_jax.guides.base import Guide
from cuelearner_jax.guides.refining import refine
from cuelearner_jax.run_config import kind_to_json, part_to_json
from cuelearner_jax.spaces import DIRECTIONS, Box, Space
from cuelearner_jax.types import Actions, EnvState, GuidanceModel, Observations, Params, Policy, Teacher

SHARED, BY_LANE = None, 0  # axis of a leaf: shared by all lanes, or one entry for each lane


class PolicyNode(struct.PyTreeNode):
    """A policy, or a block of policies with one entry a lane (`axes`). Inherit this for one of your own."""

    KIND = ""  # name of the kind of policy in files; empty: code
    ASKS = False  # True if the policy asks a teacher
    LANES: ClassVar[tuple[str, ...]] = ()  # fields of a block with one entry for each lane

    def act(self, key: PRNGKeyArray, states: EnvState, obs: Observations) -> Actions:
        """Act as `types.Policy.act`."""
        raise NotImplementedError

    @property
    def axes(self) -> Any:
        """The policy with `BY_LANE` (`LANES`) or `SHARED` in place of fields; a base has its own axes."""
        axes = {field.name: BY_LANE if field.name in self.LANES else SHARED for field in _traced(self)}
        return self.replace(**axes | ({"base": self.base.axes} if "base" in axes else {}))  # pyright: ignore[reportAttributeAccessIssue]

    def describe(self) -> dict[str, Any]:
        """Return JSON values: the policy's kind under `policy`, and under `base` the policy that it changes."""
        asks, base = {"asks": True} if self.ASKS else {}, getattr(self, "base", None)
        if not self.KIND:
            return {"policy": "code", "named": code_name(self), **asks}
        return {"policy": self.KIND, **asks, **({} if base is None else {"base": describe(base)})}

    def lane(self, index: int | ArrayLike) -> Any:
        """Return one lane's policy of a block; with several indices (lanes,), a block of these lanes."""
        axes, names = self.axes, [field.name for field in _traced(self)]
        return self.replace(**{name: _lane(getattr(self, name), getattr(axes, name), index) for name in names})


def _traced(policy: Any) -> list[dataclasses.Field[Any]]:
    return [field for field in dataclasses.fields(policy) if field.metadata.get("pytree_node", True)]


def _lane(part: Any, axes: Any, index: int | ArrayLike) -> Any:
    """Return the entries of some lanes; `axes` as `PolicyNode.axes`."""
    if hasattr(part, "lane"):
        return part.lane(index)
    rows = lambda leaf: jnp.asarray(leaf)[index]  # noqa: E731
    entries = lambda axis, own: own if axis is SHARED else jax.tree.map(rows, own)  # noqa: E731
    return jax.tree.map(entries, axes, part, is_leaf=lambda axis: axis is SHARED)


def lanes_in(policy: PolicyNode) -> int | None:
    """Return the number of lanes of a block; None where no leaf has a lane axis."""
    count = lambda axis, own: [] if axis is SHARED else [len(leaf) for leaf in jax.tree.leaves(own)]  # noqa: E731
    counts = jax.tree.leaves(jax.tree.map(count, policy.axes, policy, is_leaf=lambda axis: axis is SHARED))
    return counts[0] if counts else None


def describe(policy: Any) -> dict[str, Any]:
    """Return a policy's description (`PolicyNode.describe`); a policy without one is described as code."""
    return policy.describe() if hasattr(policy, "describe") else {"policy": "code", "named": code_name(policy)}


def code_name(code: Any) -> str:
    """Return the qualified name of a function, of a policy's function, or of the class of any other policy."""
    code = getattr(code, "function", code)
    return getattr(code, "__qualname__", type(code).__qualname__).replace("<locals>.", "")


def innermost(policy: Any) -> Any:
    """Return the policy below all layers."""
    while (below := getattr(policy, "base", None) or getattr(policy, "policy", None)) is not None:
        policy = below
    return policy


def policy_name(policy: Any) -> str:
    """Return a policy's name for a message: that of the user's function or class below all layers."""
    policy = innermost(policy)
    return f"policy {code_name(policy)}"


def call_policy(policy: Policy, key: PRNGKeyArray, states: EnvState, obs: Observations, actions: Space) -> Actions:
    """Return a policy's actions, NaN in place of each invalid one. Raises UserError for another shape."""
    result, shape = jnp.asarray(policy.act(key, states, obs)), (obs.shape[0], actions.size)
    if result.shape != shape:
        raise UserError(f"{policy_name(policy)} returned actions of shape {result.shape}: return {shape}")
    return actions.only_actions(result)


def layers(described: dict[str, Any]) -> Iterator[dict[str, Any]]:
    """Yield a described policy, the policy whose actions it changes, and so on."""
    layer: dict[str, Any] | None = described
    while layer is not None:
        yield layer
        layer = layer.get("base")


class Agent(PolicyNode):
    """A finished agent. In a block each lane has its own network."""

    LANES = ("params",)

    params: Params
    functions: AgentFunctions = struct.field(pytree_node=False)
    view: Any = None  # provides `features`; the raw frame needs none

    def act(self, key: PRNGKeyArray, states: EnvState, obs: Observations) -> Actions:
        """Return the finished agent's actions."""
        return self.functions.act(self.view, self.params, obs, key)

    def describe(self) -> dict[str, Any]:
        """Return the agent's options and its frame, as JSON values."""
        return {"policy": "agent", "agent": part_to_json(self.functions.options), "frame": self.functions.frame}


class Uniform(PolicyNode):
    """A policy of uniform actions."""

    KIND = "uniform"

    actions: Space = struct.field(pytree_node=False, default=DIRECTIONS)

    def act(self, key: PRNGKeyArray, states: EnvState, obs: Observations) -> Actions:
        """Return new uniform draws at each call (paper, Eq. 6)."""
        return self.actions.sample(key, (obs.shape[0],))


class Middle(PolicyNode):
    """A policy of the action halfway between the bounds of a box."""

    KIND = "middle"

    box: Box = struct.field(pytree_node=False)

    def act(self, key: PRNGKeyArray, states: EnvState, obs: Observations) -> Actions:
        """Return the same action in every situation."""
        return jnp.broadcast_to(self.box.middle(), (len(obs), self.box.size))


class NearAims(PolicyNode):
    """A policy of random actions near a situation's aims; uniform actions where there is no aim."""

    view: Any  # an environment or view with aims
    reach: Float[Array, ""] | float  # largest distance from the aim, in the unit of the space's `log`

    def act(self, key: PRNGKeyArray, states: EnvState, obs: Observations) -> Actions:
        """Return new draws at each call."""
        return jax.vmap(self._one)(jax.random.split(key, len(obs)), obs)

    def _one(self, key: PRNGKeyArray, obs: Float[Array, " obs"]) -> Float[Array, " action"]:
        k_aim, k_turn, k_elsewhere = jax.random.split(key, 3)
        space, aims = actions_of(self.view), self.view.aims(obs)
        index = jax.random.categorical(k_aim, jnp.where(aims.possible, 0.0, -jnp.inf))
        change = jax.random.uniform(k_turn, (len(space.cues),), minval=-self.reach, maxval=self.reach)
        return jnp.where(aims.possible.any(), space.exp(aims.actions[index], change), space.sample(k_elsewhere))

    def describe(self) -> dict[str, Any]:
        """Return the kind of policy and its reach, as JSON values."""
        return {"policy": "near aims", "reach": float(actions_of(self.view).to_unit(self.reach))}


class Taught(PolicyNode):
    """A policy that executes a teacher's best actions."""

    KIND = "teacher"
    ASKS = True

    teacher: Teacher

    def act(self, key: PRNGKeyArray, states: EnvState, obs: Observations) -> Actions:
        """Return the teacher's best actions."""
        return best_actions(self.teacher, states, obs)


class Heuristic(PolicyNode):
    """A policy of the environment's heuristic."""

    KIND = "heuristic"

    view: Any

    def act(self, key: PRNGKeyArray, states: EnvState, obs: Observations) -> Actions:
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

    def act(self, key: PRNGKeyArray, states: EnvState, obs: Observations) -> Actions:
        """Return the base's actions after guidance."""
        base = self.base.act(key, states, obs)
        where = (self.model, self.view, obs, base, jnp.ones(obs.shape[0], bool), self.scalars)
        if self.bound is None:
            return self.guidance.act(*where).actions
        return self.guidance.act_within(self.bound, *where).actions

    @property
    def LANES(self) -> tuple[str, ...]:
        """Each lane has its own model, and its own bound where there is more than one."""
        return ("model", "bound") if self.bound is not None and jnp.ndim(self.bound) else ("model",)

    def describe(self) -> dict[str, Any]:
        """Return the guidance, its sizes (None: not known) and scalars, its bound, and the base, as JSON values."""
        scalars = _plain_part(Scalars, self.scalars)
        space = self.guidance.spaces.actions
        bound = space.reach if self.bound is None else float(space.to_unit(np.max(self.bound), np))
        return {
            "policy": "guided",
            "guidance": self.guidance.name,
            "sizes": None if self.sizes is None else _plain_part(GuideSizes, self.sizes),
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

    def act(self, key: PRNGKeyArray, states: EnvState, obs: Observations) -> Actions:
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
    scalars: Scalars
    actions: Space = struct.field(pytree_node=False, default=DIRECTIONS)

    def act(self, key: PRNGKeyArray, states: EnvState, obs: Observations) -> Actions:
        """Return the base's actions, corrected by the teacher's answers until the teacher calls them right."""
        space, first = self.actions, self.base.act(key, states, obs)
        eps = space.from_unit(self.scalars.eps_deg)
        intend = lambda row: intended_action(space, self.teacher, row[0], row[1], row[2], self.scalars)  # noqa: E731
        best = jax.lax.map(intend, (states, obs, first), batch_size=min(len(obs), portions().states))
        step = lambda action, best: space.toward(action, relative_feedback(space, action, best, eps), eps) - action  # noqa: E731
        return refine(
            lambda current: jax.vmap(step)(current, best),
            first,
            jnp.ones(obs.shape[0], bool),
            space=space,
            tau=space.from_unit(self.scalars.tau_deg),
            tau_max=space.from_unit(self.scalars.tau_max_deg),
            k_max=self.scalars.k_max,
        ).actions


def _plain_part(kind: type, values: Any) -> dict[str, Any]:
    """Return a configuration class's fields, read from an instance of this or another class."""
    plain = lambda value: value.item() if hasattr(value, "item") else value  # noqa: E731
    names = [field.name for field in dataclasses.fields(kind) if hasattr(values, field.name)]
    own = {name: plain(getattr(values, name)) for name in names}
    return {name: value for name, value in to_json(kind(**own)).items() if name in own}


def best_actions(teacher: Teacher, states: EnvState, obs: Observations) -> Actions:
    """Return a teacher's actions in n situations, a few at a time: a searching teacher simulates hundreds for each."""
    ask = lambda pair: teacher.best_action(*pair)  # noqa: E731
    return jax.lax.map(ask, (states, obs), batch_size=min(len(obs), portions().states))


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
