"""Is an adapted policy worth more than its base? One that is worth less is not used.

With a simulator both play the same episodes, none of which reported figures are measured on: those of the "tuning"
split of the changed world. Without one, held-out labels are predicted, against answering "already right" always.
"""

from __future__ import annotations

import dataclasses
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh
from jaxtyping import Array, Float

from cuelearner_jax.adaptation.program import Adapting, Lanes
from cuelearner_jax.asking import fitted_labels
from cuelearner_jax.config import GuideSizes, Scalars
from cuelearner_jax.devices import each_lane
from cuelearner_jax.environment import Environment, actions_of
from cuelearner_jax.errors import UserError, closest
from cuelearner_jax.evaluate import Rolled, Tell, episodes, mean_interval, roll_lanes, untold, watched, watched_lanes
from cuelearner_jax.guides.base import Guide
from cuelearner_jax.policies import PolicyBlock, lanes_in
from cuelearner_jax.spaces import Space, said
from cuelearner_jax.types import Label

HELD_OUT = 5  # every fifth label
LABELS = "labels"  # what is judged by, in place of a metric
STEPS = 100  # of an environment, where a task counts steps
MOST_BOUNDS = 16  # shares of a bound


class Judged(NamedTuple):
    """What the base policies and the adapted ones are worth, lane by lane; more is better."""

    by: str  # a metric, or "labels": the share of held-out answers that are predicted
    before: np.ndarray  # (lanes,)
    after: np.ndarray  # (lanes,)
    used: np.ndarray  # (lanes,) bool: is the model used? Not if it is worth less than nothing, or not finite
    within_deg: np.ndarray  # (lanes,) how far corrections then lead from the base's actions [the space's unit]
    # (lanes, 3) after less before and the ends of its 95% interval over episodes, paired; nan by labels
    difference: np.ndarray
    rewarded_steps: np.ndarray  # (lanes,) int: environment steps whose rewards or outcomes decided; 0 by labels


def metrics_of(env: Environment) -> tuple[str, ...]:
    """Names of what a roll-out measures in an environment."""
    step = _step_of(env)
    return ("reward", *step.metrics, *step.outcome)


def _step_of(env: Environment) -> Any:
    key = jax.random.key(0)
    state, _ = jax.eval_shape(env.reset, key)
    return jax.eval_shape(env.step, key, state, jnp.zeros(actions_of(env).size))[1]


def steps_played(env: Environment, by: str, rolled: Rolled, steps: int) -> np.ndarray:
    """Environment steps (lanes,) of a roll-out that a metric is about: of an outcome those of first episodes alone."""
    first = np.asarray(rolled.episode_steps)
    return first.sum(-1) if by in _step_of(env).outcome else np.full(len(first), steps)


def measured(
    env: Environment,
    policy: PolicyBlock,
    num_envs: int,
    steps: int,
    split: str = "tuning",
    mesh: Mesh | None = None,
    tell: Tell = untold,
) -> Rolled:
    """Roll out a block of policies, or one that all lanes share (as one lane), on the episodes of a split.

    Args:
        env: the changed world, of that split.
        policy: a block, or one policy for all lanes.
        num_envs, steps: as `evaluate.rollout` has them.
        split: see `evaluate.SPLITS`.
        mesh: devices that share the lanes (default: one).
        tell: is told how far it is.
    """
    key = episodes(split)
    if lanes_in(policy) is None:
        found = watched(env, policy, key, num_envs, steps, tell)
        return jax.tree.map(lambda leaf: np.asarray(leaf)[None], found)
    if mesh is not None and mesh.size > 1:
        return jax.device_get(roll_lanes(env, policy, key, mesh=mesh, num_envs=num_envs, steps=steps))
    return watched_lanes(env, policy, key, num_envs, steps, tell)


def judged(
    by: str,
    lanes: Lanes,
    bases: Rolled,
    policies: Rolled,
    usable: np.ndarray,
    within_deg: np.ndarray,
    rewarded_steps: np.ndarray,
) -> Judged:
    """Compares base policies (bases or one) and lanes on the same episodes.

    Args:
        by: the metric.
        lanes: which base is whose.
        bases, policies: from `measured`.
        usable: (lanes,) bool: False where nothing could be fitted, or not to finite numbers.
        within_deg: (lanes,) the bounds of the policies.
        rewarded_steps: (lanes,) that it took.
    """
    own = np.zeros(lanes.number, int) if len(bases.means[by]) == 1 else lanes.base
    before, after = np.asarray(bases.means[by])[own], np.asarray(policies.means[by])
    used = np.asarray(usable) & (after >= before)  # NaN is worth less than anything
    difference = mean_interval(np.asarray(policies.each[by]) - np.asarray(bases.each[by])[own]).T
    return Judged(by, before, after, used, within_deg, difference, rewarded_steps)


@partial(jax.jit, static_argnames=("guidance",))
def _predicted(guidance: Guide, env: Any, scalars: Any, block: Adapting) -> tuple[Array, Array]:
    """Shares (lanes,) of held-out answers that are 0, and that a model of the others predicts."""
    one_pass = dataclasses.replace(scalars, k_max=1, tau_max_deg=actions_of(env).reach)
    space = actions_of(env)

    def one(lane: Adapting) -> tuple[Array, Array]:
        key = jax.random.fold_in(lane.key, HELD_OUT)
        labels = fitted_labels(key, lane.guide.labels, scalars)
        held = labels.valid & (jnp.arange(labels.valid.shape[0]) % HELD_OUT == HELD_OUT - 2)
        others = labels.replace(valid=labels.valid & ~held)
        model = guidance.fit(key, env, others, guidance.init(key), scalars)
        right, zero = _right(labels, guidance.moved_on(model, env, labels, held, one_pass).actions)
        count = jnp.maximum(held.sum(), 1)
        return jnp.sum(zero, where=held) / count, jnp.where(held.any(), jnp.sum(right, where=held) / count, jnp.nan)

    def _right(labels: Label, moved: Float[Array, "n action"]) -> tuple[Array, Array]:
        """Shares (n,) of what was said of each label that the model says too, and that is "already right"."""
        moves = space.log(labels.action, moved) / space.from_unit(scalars.eps_deg)
        told = said(labels.answer)
        share = lambda flags: jnp.mean(flags, -1, where=told)  # noqa: E731
        return share(jnp.round(jnp.clip(moves, -1, 1)) == labels.answer), share(labels.answer == 0)

    return each_lane(one)(block)


def judged_by_labels(guidance: Guide, sizes: GuideSizes, env: Environment, scalars: Scalars, block: Adapting) -> Judged:
    """Compares a model with answering "already right" always, on every fifth label, to which it was not fitted.

    The model that is kept is fitted to all of them; this one is made for the comparison alone.

    Args:
        guidance, sizes, env, scalars, block: as `program.ask_round` has them; the block has its labels.

    Raises:
        UserError: answers that say nothing about turning an action, or fewer than five.
    """
    form = guidance.form
    if form is None or not form.by_eps:
        told = form.name if form else "no"
        raise UserError(f"{told} answers cannot be judged by held-out labels: give --judge-by a metric of the task")
    if int(np.asarray(block.guide.labels.valid).sum(-1).min()) < HELD_OUT:
        raise UserError(f"fewer than {HELD_OUT} labels cannot be judged by: give more, or --judge-by a metric")
    zero, right = jax.device_get(_predicted(guidance, env, scalars, block))
    used = ~np.asarray(block.failed) & (right >= zero)
    unknown, none = np.full((len(used), 3), np.nan), np.zeros(len(used), int)
    return Judged(LABELS, zero, right, used, within(actions_of(env), block), unknown, none)


def within(space: Space, block: Adapting) -> np.ndarray:
    """The bounds (lanes,) of a block, in the unit of the space."""
    return space.to_unit(np.asarray(block.bound), np)


def check_bounds(shares: tuple[float, ...], by: str, named: str) -> None:
    """Raises UserError for shares of a bound that cannot be tried; `named` is what the user calls them."""
    if len(shares) > MOST_BOUNDS:
        raise UserError(f"{named} has {len(shares):,} shares, each played by itself: give at most {MOST_BOUNDS}")
    if not all(0 < share < 1 for share in shares) or len(set(shares)) < len(shares):
        given = " ".join(f"{share:g}" for share in shares)
        raise UserError(f"{named} is {given}: give shares of the bound above 0 and below 1, each once")
    if shares and by == LABELS:
        raise UserError(f"{named} needs episodes to try them on: judge by a metric of the task")


def check_metric(by: str, policies: Rolled) -> None:
    """Raises UserError if there is no such metric."""
    if by not in policies.means:
        raise UserError(f"there is no metric {by!r} to judge by{closest(by, [*policies.means, LABELS])}")


def kept(block: Adapting, used: np.ndarray) -> Adapting:
    """The block with models that leave actions alone where they are not to be used."""
    model = block.guide.model
    return block.replace(guide=block.guide.replace(model=model.replace(fitted=model.fitted & jnp.asarray(used))))
