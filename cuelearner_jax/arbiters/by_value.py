"""Arbiter by value: execute the guide's action where critics value it above the agent's.

Imitation bootstrapped reinforcement learning takes whichever of two actions has the larger Q (Hu, Mirchandani, Sadigh,
RSS 2024): while acting, in bootstrapped targets, and in the finished policy. The agent decides which critics compare:

- An agent with an actor (`sac`): its own critics, as in the paper. The actor climbs their values by gradients and
  seldom stands at their maximum, so another action can be larger by the same values. `value` compares, the smallest
  value of all critics.
- An agent that takes the argmax of Q (`ddqn`) never finds another action larger by the same Q. So a second critic
  compares: it starts from other parameters, learns from other batches of the same replay, and selects nothing, so that
  what the first overestimates is not the second's error too (double Q-learning: van Hasselt, NeurIPS 2010). It compares
  while acting alone; targets and the finished policy are the agent's.

Acting and targets follow the guide until the cut-off. In the finished policy the better of both acts only where that
validates better than the agent alone.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Any, ClassVar

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from cuelearner_jax.agents.protocol import AgentOptions, has_actor
from cuelearner_jax.arbiters.episodes import redraw
from cuelearner_jax.arbiters.protocol import Arbiter, LaneParts, Outcome
from cuelearner_jax.config import POSITIVE, SHARE, Scalars, part
from cuelearner_jax.guides.refining import Refinement
from cuelearner_jax.types import Params

ARMS = ("own", "better")
OWN, BETTER = range(len(ARMS))


@part
class Config:
    """Options of the arbiter by value."""

    NAME: ClassVar[str] = "by_value"
    ABOUT: ClassVar[str] = "the guide's action is executed where critics value it above the agent's"

    probability: Annotated[float, SHARE] = 1.0
    """Probability that an episode is arbitrated; others are the agent's own."""
    in_targets: bool = True
    """Let targets bootstrap from the better of both actions (only for agents with an actor)."""
    in_policy: bool = True
    """Let the finished policy take the better of both actions (only for agents with an actor)."""
    judge_steps: Annotated[int, POSITIVE] = 2_000
    """Steps in which the agent alone and the better of both are validated before an evaluation, where `in_policy`."""

    def make(self, bootstraps: bool) -> ByValue:
        """Return the arbiter beside an agent that takes the argmax of its values."""
        return ByValue()

    def make_beside(self, agent: AgentOptions, bootstraps: bool) -> Arbiter:
        """Return the arbiter beside any agent."""
        if not has_actor(agent):
            return self.make(bootstraps)
        in_targets = self.in_targets and bootstraps
        return Finishing(in_targets, self.judge_steps) if self.in_policy else ByOwnValues(in_targets)


class ComparingState(struct.PyTreeNode):
    """The arbitrated episodes, with the second critic, or with the arm of the finished policy."""

    arbitrated: Bool[Array, " num_envs"]
    params: Params = None
    training: Any = None  # optimiser state and target parameters of the second critic
    best: Int[Array, ""] | None = None


def agent_values_higher(
    known: LaneParts,
    critics: Params,
    obs: Float[Array, "n obs"],
    own: Float[Array, "n action"],
    other: Float[Array, "n action"],
) -> Bool[Array, " n"]:
    """Return where the critics `critics` value the other action above the agent's."""

    def gain(obs: Array, own: Array, other: Array) -> Array:
        values = known.agent.value(known.env, critics, obs, jnp.stack([own, other]))
        return values[1] - values[0]

    return jax.vmap(gain)(obs, own, other) > 0


def choose_by_value(
    known: LaneParts,
    critics: Params,
    obs: Float[Array, "n obs"],
    own: Float[Array, "n action"],
    asked: Bool[Array, " n"],
) -> Refinement:
    """Return the guide's actions where critics value them above the agent's, in the rows `asked`."""
    guided = known.guide.act(known.model, known.env, obs, own, asked, known.scalars)
    taken = asked & agent_values_higher(known, critics, obs, own, guided.actions)
    return Refinement(jnp.where(taken[:, None], guided.actions, own), jnp.where(taken, guided.passes, 0))


class Comparing:
    """Base class of the arbiters that compare values (`protocol.Chooses`)."""

    def init(self, num_envs: int) -> ComparingState:
        """Return the state of the start. First episodes begin with uniform actions and belong to the agent."""
        return ComparingState(jnp.zeros(num_envs, bool))

    def guided(self, state: ComparingState) -> Bool[Array, " num_envs"]:
        """Return which episodes are arbitrated."""
        return state.arbitrated

    def follow(
        self, state: ComparingState, options: Config, scalars: Scalars, outcome: Outcome, key: PRNGKeyArray
    ) -> ComparingState:
        """Draw whether to arbitrate each episode that begins."""
        return state.replace(arbitrated=redraw(key, state.arbitrated, outcome.done, options.probability))

    def compares(self, state: ComparingState, known: LaneParts) -> Params:
        """Return the parameters of the critics that compare."""
        raise NotImplementedError(f"{type(self).__name__} does not say which critics compare: write `compares`")

    def choose(
        self,
        state: ComparingState,
        options: Config,
        known: LaneParts,
        obs: Float[Array, "num_envs obs"],
        base: Float[Array, "num_envs action"],
        learns: Bool[Array, ""],
        key: PRNGKeyArray,
    ) -> Refinement:
        """Return the guide's action where the critics value it above the agent's, in arbitrated episodes."""
        return choose_by_value(known, self.compares(state, known), obs, base, state.arbitrated & learns)


@dataclass(frozen=True)
class ByValue(Comparing):
    """The arbiter beside an agent that takes the argmax of its values (`protocol.HasCritic`)."""

    def compares(self, state: ComparingState, known: LaneParts) -> Params:
        """Return the parameters of the second critic."""
        return state.params

    def critic(self, state: ComparingState) -> tuple[Params, Any]:
        """Return the second critic."""
        return state.params, state.training

    def with_critic(self, state: ComparingState, critic: tuple[Params, Any]) -> ComparingState:
        """Return the state with another second critic."""
        return state.replace(params=critic[0], training=critic[1])


@dataclass(frozen=True)
class ByOwnValues(Comparing):
    """The arbiter beside an agent with an actor (`protocol.InTargets`)."""

    in_targets: bool

    def compares(self, state: ComparingState, known: LaneParts) -> Params:
        """Return the parameters of the agent's own critics."""
        return known.params


@dataclass(frozen=True)
class Finishing(ByOwnValues):
    """The arbiter by value that may act in the finished policy too, for agents with an actor (`protocol.Finishes`)."""

    judge_steps: int

    @property
    def arms(self) -> tuple[str, ...]:
        """Names of the arms: the agent alone, and the better of both actions."""
        return ARMS

    def init(self, num_envs: int) -> ComparingState:
        """Return the state of the start: the agent alone acts until another arm validates better."""
        return super().init(num_envs).replace(best=jnp.array(OWN, jnp.int32))

    def arm(self, state: ComparingState) -> Any:
        """Return the number of the arm that validated best."""
        return state.best

    def with_arm(self, state: ComparingState, arm: Int[Array, "*lanes"]) -> ComparingState:
        """Return the state with another best arm."""
        return state.replace(best=arm)

    def act(
        self, arm: Int[Array, ""], options: Config, known: LaneParts, obs: Float[Array, "n obs"], key: PRNGKeyArray
    ) -> Float[Array, "n action"]:
        """Return the actor's actions, or the better of these and the guide's, as the arm says."""
        own, every = known.agent.act(known.env, known.params, obs, key), jnp.ones(len(obs), bool)
        return jax.lax.cond(
            arm == OWN, lambda: own, lambda: choose_by_value(known, known.params, obs, own, every).actions
        )
