"""Arbiters decide in which episodes the guide acts: each with the same probability, or as far as guided ones earn more.

An arbiter is a class of options (`config.part`) with a `NAME`, a line `ABOUT` it, and functions of one lane. Name your
own as package.module:NAME, or add it to `ARBITERS`.
"""

from __future__ import annotations

from typing import Annotated, Any, ClassVar, NamedTuple

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from cuelearner_jax.config import SHARE, Bounds, Scalars, part

WINDOW = 200.0  # episodes, own and guided together, within which what they earned fades to 1/e
FLOOR = 0.02  # least share of guided episodes, and of own ones, so that both go on being seen
ENOUGH = 2.0  # episodes, after fading, without which an arm has no variance
RESOLUTION = 1e-6  # relative, of sums in single precision: scores closer than that are equal
TINY = 1e-30  # added to denominators so that 0 / 0 is 0


class Outcome(NamedTuple):
    """The outcome of one step in each environment."""

    reward: Float[Array, " num_envs"]
    done: Bool[Array, " num_envs"]  # True where the episode ended with this step
    counts: Bool[Array, ""]  # True in the time of guidance
    bootstraps: bool  # whether targets use the next observation (discount above 0)


class Arbiter:
    """The options of an arbiter, and its functions; here the state says which running episodes are guided."""

    NAME: ClassVar[str]
    ABOUT: ClassVar[str]

    def init(self, num_envs: int) -> Any:
        """Return the state of the start. First episodes begin with uniform actions and are the agent's own."""
        return jnp.zeros(num_envs, bool)

    def guided(self, state: Any) -> Bool[Array, " num_envs"]:
        """Return in which environments the guide's action is executed next, in the time of guidance."""
        return state

    def follow(self, state: Any, outcome: Outcome, scalars: Scalars, key: PRNGKeyArray) -> Any:
        """Return the state after one step in every environment; `scalars` hold the discount factor."""
        raise NotImplementedError(f"{type(self).__name__} does not say which episodes are guided: write `follow`")


Flags = Bool[Array, " num_envs"]


def redraw(key: PRNGKeyArray, guided: Flags, done: Flags, probability: Float[Array, ""] | float) -> Flags:
    """Return which episodes are guided, with a new draw where an episode is done."""
    return jnp.where(done, jax.random.bernoulli(key, probability, done.shape), guided)


@part
class Episodes(Arbiter):
    """Guide whole episodes, each with the same probability (paper: every second one)."""

    NAME: ClassVar[str] = "episodes"
    ABOUT: ClassVar[str] = "each episode is guided with the same probability"

    probability: Annotated[float, SHARE] = 0.5
    """Probability that an episode is guided."""

    def follow(self, state: Flags, outcome: Outcome, scalars: Scalars, key: PRNGKeyArray) -> Flags:
        """Draw whether to guide each episode that begins."""
        return redraw(key, state, outcome.done, self.probability)


class ArmSums(struct.PyTreeNode):
    """Fading sums over the episodes of two arms, own and guided; an episode earned `gain` in `size`."""

    episodes: Float[Array, "2"]
    gain: Float[Array, "2"]
    size: Float[Array, "2"]
    gain_gain: Float[Array, "2"]
    gain_size: Float[Array, "2"]
    size_size: Float[Array, "2"]


class Pace(struct.PyTreeNode):
    """The returns of guided and own episodes so far, and the running episodes' sums."""

    guided: Flags  # True where the running episode is guided
    gain: Float[Array, " num_envs"]  # gain of the running episode so far
    steps: Float[Array, " num_envs"]  # steps of the running episode so far
    whole: Bool[Array, " num_envs"]  # True where the running episode belonged to its arm from its first step on
    sums: ArmSums


@part
class Paced(Arbiter):
    """The share of guided episodes follows the recent returns of guided and own episodes.

    Source: a two-armed bandit with changing arms. Each arm (own, guided) keeps sums over its finished episodes, which
    fade with every episode of either arm, so that a rarely played arm becomes uncertain again. (Discounted UCB:
    Garivier and Moulines, "On upper-confidence bound policies for switching bandit problems", 2011.) The next episode
    is guided with the probability that guidance is the better arm, doubled and clipped: equal arms give the unpaced
    share. (Thompson sampling of the difference of two means, taken as normal.)

    An episode with a slightly larger return does not teach more: a weak guide costs an agent most of what it would have
    learned from episodes of its own (docs/results/bootstrapping.md). With a `lead` the share is also proportional to
    the lag of own episodes, up to that lead, so that equal arms give the floor. (Regret matching: Hart and Mas-Colell,
    "A simple adaptive procedure leading to correlated equilibrium", 2000.)

    Each episode gives a pair (gain, size); an arm's score is the ratio of the pairs' sums:

    - At discount 0 each step is a problem of its own, and agents maximise the reward a step: gain is the episode's
      reward, size its steps. Episodes differ in length, so this is a ratio of two random sums.
    - Where targets bootstrap, agents maximise the discounted return: gain is that return from the episode's first step,
      size 1. A reward a step would call a quick failure better than a long way to a success.
    """

    NAME: ClassVar[str] = "paced"
    ABOUT: ClassVar[str] = "the share of guided episodes follows whether they earn more than the agent's own"

    probability: Annotated[float, SHARE] = 0.5
    """Probability that an episode is guided while both kinds are unknown, and at most."""
    lead: Annotated[float, Bounds(0)] = 0.25
    """What guided episodes must earn more than own ones to have their whole share; below it the share is proportional
    (0: any lead will do)."""

    def init(self, num_envs: int) -> Pace:
        """Return the state before the first episode."""
        guided, gain, steps = jnp.zeros(num_envs, bool), jnp.zeros(num_envs), jnp.zeros(num_envs)
        return Pace(guided, gain, steps, whole=~guided, sums=ArmSums(*[jnp.zeros(2)] * 6))

    def guided(self, state: Pace) -> Flags:
        """Return which running episodes are guided."""
        return state.guided

    def follow(self, state: Pace, outcome: Outcome, scalars: Scalars, key: PRNGKeyArray) -> Pace:
        """Add finished episodes to their arms' sums, and draw an arm for each episode that begins.

        Steps outside the time of guidance belong to neither arm; no episode with such a step is counted.
        """
        reward, done = outcome.reward, outcome.done
        gain = state.gain + (scalars.discount**state.steps * reward if outcome.bootstraps else reward)
        steps, whole = state.steps + 1, state.whole & outcome.counts
        finished = done & whole
        arms = jnp.stack([finished & ~state.guided, finished & state.guided]).astype(jnp.float32)  # (2, num_envs)
        size = jnp.ones_like(steps) if outcome.bootstraps else steps
        # Sums and not a matrix product, whose factors accelerators round.
        earned = (jnp.ones_like(gain), gain, size, gain**2, gain * size, size**2)
        new = ArmSums(*[(arms * each[None]).sum(-1) for each in earned])
        fade = (1 - 1 / jnp.float32(WINDOW)) ** finished.sum()
        sums = jax.tree.map(lambda old, added: fade * old + added, state.sums, new)
        guided = redraw(key, state.guided, done, guided_share(sums, self))
        return Pace(guided, jnp.where(done, 0, gain), jnp.where(done, 0, steps), whole | done, sums)


def scores(sums: ArmSums) -> tuple[Float[Array, "2"], Float[Array, "2"]]:
    """Return each arm's ratio of sums, and the variance of that ratio for one episode.

    The standard error of a ratio of m episodes is sqrt(variance / m) (Cochran, Sampling Techniques, 1977, chapter 6,
    without the correction for a finite population: residuals gain - ratio * size, over the mean size).
    """
    ratio = sums.gain / jnp.maximum(sums.size, TINY)
    residuals = sums.gain_gain - 2 * ratio * sums.gain_size + ratio**2 * sums.size_size
    size = sums.size / jnp.maximum(sums.episodes, TINY)
    return ratio, jnp.maximum(residuals, 0) / jnp.maximum(size**2, TINY) / jnp.maximum(sums.episodes - 1, 1)


def guided_share(sums: ArmSums, options: Paced) -> Float[Array, ""]:
    """Return the probability that the next episode is guided.

    At most the options' probability, which is also what holds until both arms have been seen; at least `FLOOR` (but
    never more than that probability), and as much below 1, so that both arms go on being seen.
    """
    (own, guided), variance = scores(sums)
    # A few similar episodes would look certain, so no arm's variance is below the mean variance of both arms.
    freedom = jnp.maximum(sums.episodes - 1, 0)
    pooled = (variance * freedom).sum() / jnp.maximum(freedom.sum(), 1)
    error = jnp.sqrt((jnp.maximum(variance, pooled) / jnp.maximum(sums.episodes, TINY)).sum())
    error = error + RESOLUTION * (jnp.abs(own) + jnp.abs(guided)) + TINY
    better = jax.scipy.stats.norm.cdf((guided - own) / error)
    worth = jnp.where(options.lead > 0, jnp.clip((guided - own) / jnp.maximum(options.lead, TINY), 0, 1), 1)
    most, floor = options.probability, jnp.float32(FLOOR)
    paced = jnp.clip(most * jnp.minimum(2 * better, 1) * worth, floor, 1 - floor)
    return jnp.where((sums.episodes >= ENOUGH).all(), jnp.minimum(paced, most), most)


ARBITERS: dict[str, type[Arbiter]] = {kind.NAME: kind for kind in (Episodes, Paced)}
