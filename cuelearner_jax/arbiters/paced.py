"""When to guide: the share of guided episodes follows what guided and own episodes have earned lately.

A two-armed bandit whose arms change. Each arm (own, guided) keeps sums over its finished episodes, which fade with
every episode of either arm (discounted UCB: Garivier and Moulines, "On upper-confidence bound policies for switching
bandit problems", 2011), so that an arm that is seldom seen becomes uncertain again. The next episode is guided with the
probability that guidance is the better arm (Thompson sampling of the difference of two means, taken as normal), doubled
and cut: a draw means the unpaced share.

An episode that earns a little more does not teach more: a weak guide costs an agent most of what it would have learned
from episodes of its own (docs/results/bootstrapping.md). With `pace_lead` the share is proportional as well to what own
episodes are behind, up to that lead (regret matching: Hart and Mas-Colell, "A simple adaptive procedure leading to
correlated equilibrium", 2000), so that a draw means the floor.

What an episode earned is a pair (gain, size), an arm's score the ratio of their sums:

- At discount 0 each step is a problem of its own, and agents maximise the reward a step: gain is the episode's reward,
  size its steps. Episodes differ in length, so this is a ratio of two random sums.
- Where targets bootstrap, agents maximise the discounted return: gain is that return from the episode's first step,
  size 1. A reward a step would call a quick failure better than a long way to a success.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from cuelearner_jax.config import Scalars
from cuelearner_jax.types import ArmSums, Pace

ENOUGH = 2.0  # episodes, after fading, without which an arm has no variance
RESOLUTION = 1e-6  # relative, of sums in single precision: scores closer than that are equal
TINY = 1e-30  # keeps 0 / 0 at 0


def start(num_envs: int) -> Pace:
    """Nothing seen yet, in environments at the start of their first episodes."""
    nothing = jnp.zeros(2)
    return Pace(
        gain=jnp.zeros(num_envs),
        steps=jnp.zeros(num_envs),
        whole=jnp.ones(num_envs, bool),
        sums=ArmSums(*[nothing] * 6),
    )


def follow(
    pace: Pace,
    scalars: Scalars,
    bootstraps: bool,
    reward: Float[Array, " num_envs"],
    done: Bool[Array, " num_envs"],
    guided: Bool[Array, " num_envs"],
    counts: Bool[Array, ""],
) -> Pace:
    """The record after one step in every environment.

    Args:
        pace: before it.
        scalars: discount and window are taken from here.
        bootstraps: do targets look at the next observation?
        reward: of the step.
        done: did the episode end with it?
        guided: is the episode a guided one?
        counts: False for steps that belong to neither arm; no episode with such a step is counted.
    """
    gain = pace.gain + (scalars.discount**pace.steps * reward if bootstraps else reward)
    steps, whole = pace.steps + 1, pace.whole & counts
    finished = done & whole
    arms = jnp.stack([finished & ~guided, finished & guided]).astype(jnp.float32)  # (2, num_envs)
    size = jnp.ones_like(steps) if bootstraps else steps
    # Sums and not a matrix product, whose factors accelerators round.
    earned = (jnp.ones_like(gain), gain, size, gain**2, gain * size, size**2)
    new = ArmSums(*[(arms * each[None]).sum(-1) for each in earned])
    fade = (1 - 1 / scalars.pace_window) ** finished.sum()
    return Pace(
        gain=jnp.where(done, 0, gain),
        steps=jnp.where(done, 0, steps),
        whole=whole | done,
        sums=jax.tree.map(lambda old, added: fade * old + added, pace.sums, new),
    )


def scores(sums: ArmSums) -> tuple[Float[Array, "2"], Float[Array, "2"]]:
    """Each arm's ratio of sums, and the variance that one episode gives it.

    The standard error of a ratio of m episodes is sqrt(variance / m) (Cochran, Sampling Techniques, 1977, chapter 6,
    without the correction for a finite population: residuals gain - ratio * size, over the mean size).
    """
    ratio = sums.gain / jnp.maximum(sums.size, TINY)
    residuals = sums.gain_gain - 2 * ratio * sums.gain_size + ratio**2 * sums.size_size
    size = sums.size / jnp.maximum(sums.episodes, TINY)
    return ratio, jnp.maximum(residuals, 0) / jnp.maximum(size**2, TINY) / jnp.maximum(sums.episodes - 1, 1)


def probability(pace: Pace, scalars: Scalars) -> Float[Array, ""]:
    """That the next episode is guided.

    At most `guided_probability`, which is also what holds until both arms have been seen; at least `pace_floor` (but
    never more than `guided_probability`), and as much below 1, so that both arms go on being seen.
    """
    sums = pace.sums
    (own, guided), variance = scores(sums)
    # A few episodes that went alike would be believed for certain: no arm varies less than both do on average.
    freedom = jnp.maximum(sums.episodes - 1, 0)
    pooled = (variance * freedom).sum() / jnp.maximum(freedom.sum(), 1)
    error = jnp.sqrt((jnp.maximum(variance, pooled) / jnp.maximum(sums.episodes, TINY)).sum())
    error = error + RESOLUTION * (jnp.abs(own) + jnp.abs(guided)) + TINY
    better = jax.scipy.stats.norm.cdf((guided - own) / error)
    lead = jnp.clip((guided - own) / jnp.maximum(scalars.pace_lead, TINY), 0, 1)
    worth = jnp.where(scalars.pace_lead > 0, lead, 1)
    most = scalars.guided_probability
    paced = jnp.clip(most * jnp.minimum(2 * better, 1) * worth, scalars.pace_floor, 1 - scalars.pace_floor)
    return jnp.where((sums.episodes >= ENOUGH).all(), jnp.minimum(paced, most), most)
