"""The arbiter protocol: pure functions of one lane that decide where the guide's action is executed.

An arbiter is made from options (`config.parts`), a class with a `NAME`, a line `ABOUT` it, and `make`; `registry` finds
them by name.
"""

from __future__ import annotations

from typing import Any, ClassVar, NamedTuple, Protocol, runtime_checkable

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from cuelearner_jax.agents.protocol import AgentFunctions, AgentOptions, Offer
from cuelearner_jax.config import GuideScalars, Scalars
from cuelearner_jax.guides.base import Guide
from cuelearner_jax.guides.refining import Refinement
from cuelearner_jax.types import GuidanceModel, Params


class Outcome(NamedTuple):
    """The outcome of one step in each environment."""

    reward: Float[Array, " num_envs"]
    done: Bool[Array, " num_envs"]  # True where the episode ended with this step
    counts: Bool[Array, ""]  # True in the time of guidance


@runtime_checkable
class Arbiter(Protocol):
    """An arbiter's functions; hashable, without arrays of its own."""

    def init(self, num_envs: int) -> Any:
        """Return the arbiter's state for environments at the start of their first episodes."""
        ...

    def guided(self, state: Any) -> Bool[Array, " num_envs"]:
        """Return in which environments the guide's action is executed next, in the time of guidance."""
        ...

    def follow(self, state: Any, options: Any, scalars: Scalars, outcome: Outcome, key: PRNGKeyArray) -> Any:
        """Return the state after one step in every environment.

        Args:
            state: before it.
            options: those that the arbiter was made from, their floats traced.
            scalars: settings that all parts share, such as the discount factor.
            outcome: the step's outcome.
            key: random key of this step.
        """
        ...


class LaneParts(NamedTuple):
    """A lane's parts and what they have learned, for arbiters that choose by agent and guide."""

    env: Any  # or its view
    agent: AgentFunctions
    params: Params  # parameters of the agent
    guide: Guide
    model: GuidanceModel
    scalars: GuideScalars
    steps: Float[Array, ""]  # environment steps that the agent has learned from


@runtime_checkable
class Chooses(Arbiter, Protocol):
    """An arbiter that chooses by the agent's and the guide's values of actions, also in the random steps."""

    def choose(
        self,
        state: Any,
        options: Any,
        known: LaneParts,
        obs: Float[Array, "num_envs obs"],
        base: Float[Array, "num_envs action"],
        learns: Bool[Array, ""],
        key: PRNGKeyArray,
    ) -> Refinement:
        """Return the actions to execute in place of the agent's, until the cut-off.

        Args:
            state: the arbiter's state.
            options: as for `follow`.
            known: the lane's parts.
            obs: to act on.
            base: the agent's own actions, in the random steps uniform ones.
            learns: are the random steps over?
            key: random key of this step.

        Returns:
            The actions, and a pass for each that is not the agent's own.
        """
        ...


@runtime_checkable
class HasCritic(Arbiter, Protocol):
    """An arbiter with a second agent, which learns from the same replay and never acts."""

    def critic(self, state: Any) -> tuple[Params, Any]:
        """Return the second agent's parameters, and the rest of its learning state (`AgentFunctions.init`)."""
        ...

    def with_critic(self, state: Any, critic: tuple[Params, Any]) -> Any:
        """Return the state with another critic; `state` may be that of `init`, which has none."""
        ...


@runtime_checkable
class InTargets(Arbiter, Protocol):
    """An arbiter whose choice may count in bootstrapped targets too, of agents with an actor."""

    @property
    def in_targets(self) -> bool:
        """Whether targets bootstrap from the better of the actor's and the guide's action, in the time of guidance."""
        ...


@runtime_checkable
class Finishes(Arbiter, Protocol):
    """An arbiter that also acts in the finished policy, by whichever of its arms validates best."""

    @property
    def arms(self) -> tuple[str, ...]:
        """Names of the arms. Of arms with equal validation the first acts."""
        ...

    @property
    def judge_steps(self) -> int:
        """Environment steps that validate each arm, in episodes that no reported figure uses."""
        ...

    def arm(self, state: Any) -> Any:
        """Return the number of the finished policy's arm; for a block of lanes one number each (lanes,).

        Shapes in place of the state's arrays will do, of which the arm is the shape.
        """
        ...

    def with_arm(self, state: Any, arm: Int[Array, "*lanes"]) -> Any:
        """Return the state with another arm for the finished policy."""
        ...

    def act(
        self, arm: Int[Array, ""], options: Any, known: LaneParts, obs: Float[Array, "n obs"], key: PRNGKeyArray
    ) -> Float[Array, "n action"]:
        """Return the finished policy's actions by one of the arms."""
        ...


@runtime_checkable
class ArbiterOptions(Protocol):
    """A class of options (`config.part`) that makes an arbiter."""

    NAME: ClassVar[str]
    ABOUT: ClassVar[str]

    def make(self, bootstraps: bool) -> Arbiter:
        """Return the arbiter; floats of the options may be None. `bootstraps`: whether the discount is above 0."""
        ...


def make_arbiter(options: ArbiterOptions, agent: AgentOptions, bootstraps: bool) -> Arbiter:
    """Return the arbiter of the options. Options that depend on the agent have `make_beside(agent, bootstraps)` too."""
    beside = getattr(options, "make_beside", None)
    return options.make(bootstraps) if beside is None else beside(agent, bootstraps)


def offer_of(
    arbiter: Arbiter, guide: Guide, model: GuidanceModel, env: Any, scalars: GuideScalars, counts: Bool[Array, ""]
) -> Offer | None:
    """Return the guide's actions, for targets to compare with the actor's; None: targets ignore the guide.

    `counts`: is this the time of guidance? Outside it the actor's actions come back. It must not differ between lanes.
    """
    if not (isinstance(arbiter, InTargets) and arbiter.in_targets and guide.moves):
        return None

    def offer(obs: Float[Array, "n obs"], own: Float[Array, "n action"]) -> Float[Array, "n action"]:
        every = jnp.ones(len(obs), bool)
        return jax.lax.cond(counts, lambda: guide.act(model, env, obs, own, every, scalars).actions, lambda: own)

    return offer
