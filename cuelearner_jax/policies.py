"""Policies: pytrees that act. What evaluation, pictures, labelling and adaptation are about.

A policy's `act` sees many environments at once. Its `axes` say which of its leaves a block of lanes has one of each
(`evaluate.evaluate_lanes` maps over them); what lanes share is there once.
"""

from __future__ import annotations

import dataclasses
import inspect
from collections.abc import Callable
from typing import Any, Protocol, runtime_checkable

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Float, PRNGKeyArray

from cuelearner_jax import types, user_code
from cuelearner_jax.actions import DIRECTIONS, Actions, only_actions, rotate
from cuelearner_jax.agents.choice import greedy_actions
from cuelearner_jax.config import AgentSizes, GuideScalars, GuideSizes
from cuelearner_jax.devices import portions
from cuelearner_jax.environment import actions_of
from cuelearner_jax.errors import UserError, raised_by, shown
from cuelearner_jax.feedback.answers import in_mind, relative_feedback
from cuelearner_jax.guides.base import Guide
from cuelearner_jax.guides.refining import refine
from cuelearner_jax.types import EnvState, GuidanceModel, Params, Teacher

SHARED, BY_LANE = None, 0  # of a leaf: the same for all lanes, or one for each


@runtime_checkable
class Policy(types.Policy, Protocol):
    """A policy of which a block of lanes may have one each."""

    @property
    def axes(self) -> Any:
        """The policy with `BY_LANE` or `SHARED` in place of fields: what a block of lanes has one of each."""
        ...


class Agent(struct.PyTreeNode):
    """The greedy choice of an action-value network."""

    params: Params
    sizes: AgentSizes = struct.field(pytree_node=False)
    actions: Actions = struct.field(pytree_node=False, default=DIRECTIONS)
    view: Any = None  # says how an observation looks from an action; the raw frame needs none

    def act(self, key: PRNGKeyArray, states: EnvState, obs: Float[Array, "n obs"]) -> Float[Array, "n action"]:
        """The action with the largest value of all in the set.

        The rough first look (`sizes.coarse_directions`) is for play while learning alone: where values are sharp it
        misses peaks, which costs a finished agent reward (`benchmarks/search_agreement.py`).
        """
        whole = dataclasses.replace(self.sizes, coarse_directions=0)
        return greedy_actions(whole, self.actions, self.view, self.params, obs)

    @property
    def axes(self) -> Agent:
        """Each lane has its own network."""
        return self.replace(params=BY_LANE, view=SHARED)


class Uniform(struct.PyTreeNode):
    """Uniform actions."""

    actions: Actions = struct.field(pytree_node=False, default=DIRECTIONS)

    def act(self, key: PRNGKeyArray, states: EnvState, obs: Float[Array, "n obs"]) -> Float[Array, "n action"]:
        """Drawn anew each time (paper, Eq. 6)."""
        return self.actions.uniform(key, (obs.shape[0],))

    @property
    def axes(self) -> Uniform:
        """It has nothing."""
        return self


class NearAims(struct.PyTreeNode):
    """Actions near one of a situation's aims, each aim as likely; uniform ones where there is none."""

    view: Any  # offers aims
    reach: Float[Array, ""] | float  # how far from the aim at most [rad]

    def act(self, key: PRNGKeyArray, states: EnvState, obs: Float[Array, "n obs"]) -> Float[Array, "n action"]:
        """Drawn anew each time."""
        return jax.vmap(self._one)(jax.random.split(key, len(obs)), obs)

    def _one(self, key: PRNGKeyArray, obs: Float[Array, " obs"]) -> Float[Array, " action"]:
        k_aim, k_turn, k_elsewhere = jax.random.split(key, 3)
        aims = self.view.aims(obs)
        index = jax.random.categorical(k_aim, jnp.where(aims.possible, 0.0, -jnp.inf))
        turn = jax.random.uniform(k_turn, (), minval=-self.reach, maxval=self.reach)
        elsewhere = actions_of(self.view).uniform(k_elsewhere, ())
        return jnp.where(aims.possible.any(), rotate(aims.actions[index], turn), elsewhere)

    @property
    def axes(self) -> NearAims:
        """It is one for all lanes."""
        return self.replace(view=SHARED, reach=SHARED)


class Taught(struct.PyTreeNode):
    """What a teacher holds for best."""

    teacher: Teacher

    def act(self, key: PRNGKeyArray, states: EnvState, obs: Float[Array, "n obs"]) -> Float[Array, "n action"]:
        """The teacher's own actions."""
        return best_actions(self.teacher, states, obs)

    @property
    def axes(self) -> Taught:
        """One teacher for all."""
        return self.replace(teacher=SHARED)


class Heuristic(struct.PyTreeNode):
    """The environment's own obvious action."""

    view: Any

    def act(self, key: PRNGKeyArray, states: EnvState, obs: Float[Array, "n obs"]) -> Float[Array, "n action"]:
        """It needs no learning."""
        return jax.vmap(self.view.heuristic)(obs)

    @property
    def axes(self) -> Heuristic:
        """One environment for all."""
        return self.replace(view=SHARED)


class Guided(struct.PyTreeNode):
    """Another policy's actions, every one of them under guidance."""

    base: Any  # a policy
    model: GuidanceModel
    view: Any
    scalars: GuideScalars
    guidance: Guide = struct.field(pytree_node=False)
    bound: Float[Array, ""] | None = None  # to the way from the base's actions [rad]; None: wherever guidance leads
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


class Common(struct.PyTreeNode):
    """One policy that all lanes of a block share, whatever it is made of."""

    policy: Any

    def act(self, key: PRNGKeyArray, states: EnvState, obs: Float[Array, "n obs"]) -> Float[Array, "n action"]:
        """What the policy does."""
        return self.policy.act(key, states, obs)

    @property
    def axes(self) -> Common:
        """No lane has anything of its own."""
        return self.replace(policy=SHARED)


class Corrected(struct.PyTreeNode):
    """Another policy's actions, refined by the teacher's own relative feedback instead of a model of it."""

    base: Any  # a policy
    teacher: Teacher
    scalars: GuideScalars
    actions: Actions = struct.field(pytree_node=False, default=DIRECTIONS)

    def act(self, key: PRNGKeyArray, states: EnvState, obs: Float[Array, "n obs"]) -> Float[Array, "n action"]:
        """The base's actions, told the way until they are right."""
        first, eps = self.base.act(key, states, obs), self.scalars.radians("eps")
        best = wanted_actions(self.teacher, states, obs, first, self.scalars)

        def told(action: Array, best: Array) -> Array:
            return self.actions.toward(action, relative_feedback(action, best, eps), eps) - action

        return refine(
            lambda current: jax.vmap(told)(current, best),
            first,
            jnp.ones(obs.shape[0], bool),
            space=self.actions,
            tau=self.scalars.radians("tau"),
            tau_max=self.scalars.radians("tau_max"),
            k_max=self.scalars.k_max,
        ).actions

    @property
    def axes(self) -> Corrected:
        """Each lane has its own base; the teacher is one for all."""
        return self.replace(base=self.base.axes, teacher=SHARED, scalars=SHARED)


class Opaque(struct.PyTreeNode):
    """Any function of a batch of observations: of JAX arrays, or, `on_host`, of NumPy arrays in plain Python.

    What it returns (n, 2) is made unit vectors. A function on the host is called back from compiled programs
    (`jax.pure_callback`): it must give the same for the same observations.
    """

    function: Callable[[Any], Any] = struct.field(pytree_node=False)
    on_host: bool = struct.field(pytree_node=False, default=False)
    actions: Actions = struct.field(pytree_node=False, default=DIRECTIONS)

    def act(self, key: PRNGKeyArray, states: EnvState, obs: Float[Array, "n obs"]) -> Float[Array, "n action"]:
        """What the function gives. Raises UserError if that has another shape."""
        if self.on_host:
            # Asked once while tracing: another shape is told before anything is compiled.
            with jax.ensure_compile_time_eval():  # the function may compute with JAX itself
                self._called(np.zeros(obs.shape, obs.dtype))
            shape = jax.ShapeDtypeStruct((obs.shape[0], self.actions.size), jnp.float32)
            chosen = jax.pure_callback(self._called_back, shape, obs, vmap_method="expand_dims")
        else:
            chosen = self._checked(self.function(obs), obs.shape[0], jnp.asarray)
        return self.actions.retract(only_actions(chosen))

    def _called_back(self, obs: Any) -> np.ndarray:
        """The function's actions; NaN once it has failed, which `user_code` tells when the program is done."""
        nothing = np.full((*obs.shape[:-1], self.actions.size), np.nan, np.float32)
        if user_code.is_waiting():
            return nothing
        try:
            chosen = self._called(np.asarray(obs))
            usable = np.isfinite(chosen).all(-1) & (chosen != 0).any(-1)
            if not usable.all():
                count = f"{(~usable).sum()} of {usable.size}"
                raise UserError(
                    f"{named(self)} gave no direction but zero or not finite numbers, in {count} situations"
                )
            return chosen
        except UserError as error:
            user_code.leave(named(self), error)
            return nothing

    def _called(self, rows: np.ndarray) -> np.ndarray:
        """The function of a batch with any leading axes. Raises UserError for whatever it raises."""
        flat = rows.reshape(-1, rows.shape[-1])
        try:
            chosen = self.function(flat)
        except Exception as error:
            raise raised_by(named(self), error) from error
        return self._checked(chosen, len(flat), np.asarray).reshape(*rows.shape[:-1], self.actions.size)

    def _checked(self, chosen: Any, rows: int, as_array: Callable[..., Any]) -> Any:
        """What the function returned, as an array of real numbers."""
        wanted = (rows, self.actions.size)
        try:
            found = as_array(chosen)
        except (TypeError, ValueError) as error:
            raise UserError(f"{named(self)} returned {shown(chosen)}: return an array of shape {wanted}") from error
        if getattr(found.dtype, "kind", "key") not in "fiu" and not jnp.issubdtype(found.dtype, jnp.floating):
            raise UserError(f"{named(self)} returned {found.dtype} numbers: return real ones, of shape {wanted}")
        if found.shape != wanted:
            raise UserError(
                f"{named(self)} returned actions of shape {found.shape} for {rows} observations: return {wanted}"
            )
        with np.errstate(over="ignore"):
            return found.astype(np.float32)

    @property
    def axes(self) -> Opaque:
        """It has nothing that JAX knows of."""
        return self


def acted(
    policy: types.Policy, key: PRNGKeyArray, states: EnvState, obs: Float[Array, "n obs"], actions: Actions
) -> Float[Array, "n action"]:
    """A policy's actions, NaN in place of each that is none. Raises UserError if they have another shape."""
    chosen, wanted = jnp.asarray(policy.act(key, states, obs)), (obs.shape[0], actions.size)
    if chosen.shape != wanted:
        raise UserError(f"{named(policy)} returned actions of shape {chosen.shape}: return {wanted}")
    return only_actions(chosen)


def named(policy: Any) -> str:
    """A policy for a message: by the user's function or class that acts, below whatever changes its actions."""
    while (below := getattr(policy, "base", None) or getattr(policy, "policy", None)) is not None:
        policy = below
    inner = policy.function if isinstance(policy, Opaque) else type(policy)
    return f"policy {getattr(inner, '__qualname__', type(inner).__qualname__).replace('<locals>.', '')}"


def policy_of(given: Any) -> Any:
    """Anything that acts as a policy.

    Args:
        given: a policy; a class or function that gives one when it is called with nothing; or a function of a batch of
            observations: one that `jax.jit` made is compiled with what calls it, any other gets NumPy arrays.

    Raises:
        UserError: it is none of these, or a policy that is no pytree.
    """
    if callable(given) and not (hasattr(given, "act") and not isinstance(given, type)) and _takes_nothing(given):
        try:
            given = given()
        except Exception as error:
            raise raised_by(f"policy {getattr(given, '__qualname__', given)}", error) from error
    if hasattr(given, "act"):
        if any(leaf is given for leaf in jax.tree.leaves(given)):
            kind = type(given).__name__
            raise UserError(
                f"a {kind} has `act` but is no pytree: make it a flax.struct.PyTreeNode, or give a function"
            )
        return given
    if isinstance(given, jax.stages.Wrapped):
        return Opaque(given)
    if callable(given) and not isinstance(given, type):
        return Opaque(given, on_host=True)
    raise UserError(f"{shown(given)} is no policy: give a function of observations (n, obs), or load one")


def _takes_nothing(given: Callable[..., Any]) -> bool:
    """Can it be called without arguments?"""
    try:
        parameters = inspect.signature(given).parameters.values()
    except (TypeError, ValueError):  # of code that is not Python's
        return False
    variable = (inspect.Parameter.VAR_POSITIONAL, inspect.Parameter.VAR_KEYWORD)
    return all(one.default is not one.empty for one in parameters if one.kind not in variable) and not any(
        one.kind in variable for one in parameters
    )


class Teaching(struct.PyTreeNode):
    """A policy as a teacher (`types.Teacher`): a finished agent, for instance, teaches what it does itself."""

    policy: Any

    def best_action(self, state: EnvState, obs: Float[Array, " obs"]) -> Float[Array, " action"]:
        """What the policy does; one that acts at random always draws the same."""
        states = jax.tree.map(lambda leaf: leaf[None], state)
        return self.policy.act(jax.random.key(0), states, obs[None])[0]


def best_actions(teacher: Teacher, states: EnvState, obs: Float[Array, "n obs"]) -> Float[Array, "n action"]:
    """A teacher's actions in n situations; few at a time, for one by search simulates hundreds of actions of each."""
    ask = lambda pair: teacher.best_action(*pair)  # noqa: E731
    return jax.lax.map(ask, (states, obs), batch_size=min(len(obs), portions().states))


def wanted_actions(
    teacher: Teacher,
    states: EnvState,
    obs: Float[Array, "n obs"],
    actions: Float[Array, "n action"],
    scalars: Any,
) -> Float[Array, "n action"]:
    """What a teacher would have done instead: its best, or, where `scalars.answer` says so, the nearest good action.

    `scalars` without such a field (`GuideScalars`) mean the best.
    """
    if getattr(scalars, "answer", "best") == "best":
        return best_actions(teacher, states, obs)
    ask = lambda row: in_mind(teacher, row[0], row[1], row[2], scalars)  # noqa: E731
    return jax.lax.map(ask, (states, obs, actions), batch_size=min(len(obs), portions().states))


def uniform_in(env: Any) -> Uniform:
    """Uniform actions of an environment's space."""
    return Uniform(actions_of(env))
