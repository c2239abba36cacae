"""Arbiter by prior: labels act as a prior on the agent's choice, during learning and in the finished policy.

Source: policy shaping (Griffith, Subramanian, Scholz, Isbell, Thomaz, "Policy shaping: integrating human feedback with
reinforcement learning", NeurIPS 2013). The labels' density and the critic's value of an action are two opinions to be
combined; labels are not a bonus on the reward. The choice is

    argmax over actions of   Q(s, a) + beta_n log p(a | labels),   beta_n = beta * trust_after / n

after n steps of learning: only the prior before the first step, only the critic in the end. In the random steps actions
are drawn from p. The guide gives p and the candidate actions (`Guide.log_p`, `Guide.candidates`).

The guide's candidates may miss the good actions. So each episode is played by one of three arms, whose steps all enter
the same replay:

- own: the agent's choice among all actions, without the prior;
- prior: the choice above;
- near: that choice, then again among the actions near it, which the critic can only know if they are tried.

The arm that validates best acts in the finished policy (`Finishes`). The arms' shares do not depend on their returns:
an arm with a low return now may be the one that has to learn.
"""

from __future__ import annotations

from typing import Annotated, Any, ClassVar, NamedTuple

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from cuelearner_jax.agents.choice import each_in_portions
from cuelearner_jax.arbiters.protocol import LaneParts, Outcome
from cuelearner_jax.config import POSITIVE, SHARE, Bounds, Scalars, part
from cuelearner_jax.guides.base import Candidates
from cuelearner_jax.guides.refining import Refinement
from cuelearner_jax.spaces import Space

ARMS = ("own", "prior", "near")
OWN, PRIOR, NEAR = range(len(ARMS))


@part
class Config:
    """Options of the arbiter by prior."""

    NAME: ClassVar[str] = "prior"
    ABOUT: ClassVar[str] = "values and labels choose together: argmax of Q + beta log p(action | labels)"

    beta: Annotated[float, Bounds(0)] = 0.1
    """Weight of log p(action | labels) after `trust_after` steps of learning, in units of reward."""
    trust_after: Annotated[float, Bounds(0, above=True)] = 100_000.0
    """Steps of learning after which beta is `beta`; beta falls in inverse proportion to these steps."""
    own_share: Annotated[float, SHARE] = 0.5
    """Probability that an episode is the agent's own choice among all actions, without the labels."""
    near_share: Annotated[float, SHARE] = 0.5
    """Probability that another episode also tries actions near the chosen one."""
    near_deg: Annotated[float, Bounds(0)] = 1.5
    """How far near actions lie from the chosen one at most [deg]."""
    near_actions: Annotated[int, POSITIVE] = 16
    """Number of actions near the chosen one, along each cue."""
    directions: Annotated[int, POSITIVE] = 720
    """Evenly spaced actions among which to choose where the guide names none (`intent` names the task's aims)."""
    judge_steps: Annotated[int, POSITIVE] = 2_000
    """Steps in which each arm is validated before an evaluation; the best arm is evaluated."""

    def make(self, bootstraps: bool) -> Prior:
        """Return the arbiter."""
        return Prior(self.near_actions, self.directions, self.judge_steps)


class Arms(struct.PyTreeNode):
    """The arm that plays each running episode, and the arm of the finished policy."""

    playing: Int[Array, " num_envs"]
    best: Int[Array, ""]


class Choices(NamedTuple):
    """The actions of the two arms other than `own`, in one situation."""

    prior: Float[Array, " action"]
    near: Float[Array, " action"]
    possible: Bool[Array, ""]  # False where the guide has no candidate; the action is then the agent's own


class Prior(NamedTuple):
    """The arbiter's functions (`protocol.Chooses`, `protocol.Finishes`)."""

    near_actions: int
    directions: int
    judge_steps: int

    @property
    def arms(self) -> tuple[str, ...]:
        """Names of the arms: own, prior, near."""
        return ARMS

    def init(self, num_envs: int) -> Arms:
        """Return the state of the start. First episodes alternate between the arms other than `own`."""
        playing = jnp.where(jnp.arange(num_envs) % 2 == 0, PRIOR, NEAR).astype(jnp.int32)
        return Arms(playing, jnp.array(PRIOR, jnp.int32))

    def guided(self, state: Arms) -> Bool[Array, " num_envs"]:
        """Return which episodes are not the agent's own."""
        return state.playing != OWN

    def follow(self, state: Arms, options: Config, scalars: Scalars, outcome: Outcome, key: PRNGKeyArray) -> Arms:
        """Draw an arm for each episode that begins."""
        k_own, k_near = jax.random.split(key)
        own = jax.random.bernoulli(k_own, options.own_share, outcome.done.shape)
        near = jax.random.bernoulli(k_near, options.near_share, outcome.done.shape)
        drawn = jnp.where(own, OWN, jnp.where(near, NEAR, PRIOR)).astype(jnp.int32)
        return state.replace(playing=jnp.where(outcome.done, drawn, state.playing))

    def choose(
        self,
        state: Arms,
        options: Config,
        known: LaneParts,
        obs: Float[Array, "num_envs obs"],
        base: Float[Array, "num_envs action"],
        learns: Bool[Array, ""],
        key: PRNGKeyArray,
    ) -> Refinement:
        """Return each environment's action by the arm of its episode; in the random steps drawn from the prior."""
        keys = jax.random.split(key, len(obs))
        choices = jax.lax.cond(
            learns,
            lambda: self._best(options, known, obs),
            lambda: jax.vmap(lambda key, obs: self._drawn(options, known, obs, key))(keys, obs),
        )
        return _of_arm(state.playing, choices, base)

    def arm(self, state: Arms) -> Any:
        """Return the number of the arm that validated best."""
        return state.best

    def with_arm(self, state: Arms, arm: Int[Array, "*lanes"]) -> Arms:
        """Return the state with another best arm."""
        return state.replace(best=arm)

    def act(
        self, arm: Int[Array, ""], options: Config, known: LaneParts, obs: Float[Array, "n obs"], key: PRNGKeyArray
    ) -> Float[Array, "n action"]:
        """Return the actions of one arm, for the finished policy."""
        own = known.agent.act(known.env, known.params, obs, key)
        return jax.lax.cond(
            arm == OWN,
            lambda: own,
            lambda: _of_arm(jnp.broadcast_to(arm, len(obs)), self._best(options, known, obs), own).actions,
        )

    def _candidates(self, known: LaneParts, obs: Float[Array, " obs"]) -> Candidates:
        """Return the guide's candidates, or evenly spaced actions of the whole space."""
        found = known.guide.candidates(known.env, obs)
        if found is not None:
            return found
        actions = known.guide.spaces.actions.spread(self.directions)
        return Candidates(actions, jnp.ones(len(actions), bool))

    def _best(self, options: Config, known: LaneParts, obs: Float[Array, "n obs"]) -> Choices:
        """Return the action with the largest Q + beta log p, among the candidates and then near the best candidate.

        The sum is taken times n / (n + trust_after): finite before the first step of learning, where log p decides.
        """
        weight = known.steps / (known.steps + options.trust_after)

        def score(obs: Float[Array, " obs"], actions: Float[Array, "m action"]) -> Float[Array, " m"]:
            value = known.agent.value(known.env, known.params, obs, actions)
            log_p = known.guide.log_p(known.model, known.env, obs, actions, known.scalars)
            return weight * value + (1.0 - weight) * options.beta * log_p

        def one(obs: Float[Array, " obs"]) -> Choices:
            actions, possible = self._candidates(known, obs)
            best = actions[jnp.argmax(jnp.where(possible, score(obs, actions), -jnp.inf))]
            near = self._near(known.guide.spaces.actions, options, best)
            return Choices(best, near[jnp.argmax(score(obs, near))], possible.any())

        looked = jax.eval_shape(lambda obs: self._candidates(known, obs), obs[0]).possible.size
        return each_in_portions(one, obs, looked)

    def _near(self, space: Space, options: Config, action: Float[Array, " action"]) -> Float[Array, "near action"]:
        """Return an action and the actions evenly spaced to either side of it along each cue."""
        reach = space.from_unit(options.near_deg)
        # Both ends of a cue's stretch; the action itself stands first, and so wins where all are worth the same.
        along = jnp.linspace(-1.0, 1.0, self.near_actions)[:, None, None] * jnp.eye(len(space.cues))[None]
        changes = jnp.concatenate([jnp.zeros((1, len(space.cues))), along.reshape(-1, len(space.cues))])
        return space.exp(jnp.broadcast_to(action, (len(changes), *action.shape)), reach * changes)

    def _drawn(self, options: Config, known: LaneParts, obs: Float[Array, " obs"], key: PRNGKeyArray) -> Choices:
        """Return a candidate drawn from p, and an action drawn uniformly near it."""
        k_draw, k_near = jax.random.split(key)
        space, (actions, possible) = known.guide.spaces.actions, self._candidates(known, obs)
        log_p = known.guide.log_p(known.model, known.env, obs, actions, known.scalars)
        drawn = actions[jax.random.categorical(k_draw, jnp.where(possible, log_p, -jnp.inf))]
        reach = space.from_unit(options.near_deg)
        change = reach * jax.random.uniform(k_near, (len(space.cues),), minval=-1.0, maxval=1.0)
        return Choices(drawn, space.exp(drawn, change), possible.any())


def _of_arm(arm: Int[Array, " n"], choices: Choices, own: Float[Array, "n action"]) -> Refinement:
    """Return the actions of each row's arm."""
    other = (arm != OWN) & choices.possible
    shaped = jnp.where((arm == NEAR)[:, None], choices.near, choices.prior)
    return Refinement(jnp.where(other[:, None], shaped, own), other.astype(jnp.int32))
