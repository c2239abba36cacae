"""Adaptation by a feedback model, from the first question to the judged policies.

result = adapt(Adaptation(guide, sizes, scalars, env, bases), lanes, Judging(tuning_env), teacher)
result.judgement.in_use, result.policy(env)
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh
from jaxtyping import Array

from cuelearner_jax import user_code
from cuelearner_jax.adaptation.judging import LABELS, PERSON, Judge, Judgement, Judging
from cuelearner_jax.adaptation.lanes import Adaptation, Lanes, ask_round, begin, blame, rounds, take_labels
from cuelearner_jax.config import GuideSizes, Scalars
from cuelearner_jax.devices import BY_LANE, SHARED, lane_mesh, place
from cuelearner_jax.environment import actions_of
from cuelearner_jax.errors import UserError
from cuelearner_jax.evaluate import Tell, ignore_progress
from cuelearner_jax.policies import Policy, policy_name
from cuelearner_jax.reading import Result
from cuelearner_jax.spaces import DIRECTIONS, Space
from cuelearner_jax.types import Label, Teacher

# Seconds a fit on a CPU. The paper's networks are `GuideSizes()`.
SIZES = GuideSizes(feedback_layers=(128, 128), fit_steps=400, fit_batch_size=64)
REACH_QUANTILE = 0.95  # quantile of the distances between labelled actions and the policy's own: how far labels reach
BOUND = 1 / 4  # default bound, as a share of the space's reach (45 deg)
MOST_NATS = 13.8  # log of a million: evidence above is not told in numbers
PASSES = 20  # threshold tau as a share of eps: a pass that turns an action by less has settled


@dataclass(frozen=True)
class AdaptationResult:
    """The adapted lanes and their judgement. A lane whose model is not used acts as its base."""

    of: Adaptation
    lanes: Lanes
    block: Any  # `LaneState`, or `by_reading.ReadingLanes`
    judgement: Judgement
    results: tuple[Result, ...] = ()  # reading only: each lane's estimates

    @property
    def labels(self) -> Label:
        """The labels of all lanes (lanes, slots, ...), as NumPy arrays."""
        return jax.device_get(self.block.labels)

    @property
    def failed(self) -> np.ndarray:
        """Whether each lane's model is no longer finite: (lanes,) bool."""
        return np.asarray(self.block.failed)

    def policy(self, env: Any) -> Any:
        """Return the lanes' adapted policies, to act in `env`."""
        return self.of.policy(self.block, env)

    @property
    def words(self) -> list[str]:
        """The result line by line: of each lane what a reading found, whether the correction is used, and why."""
        lines, space, valid = [], actions_of(self.of.env), self.labels.valid
        for lane in range(self.lanes.number):
            _, seed, budget, bound = (column[lane] for column in self.lanes)
            result = self.results[lane] if self.results else None
            within = "" if result and bound >= space.reach else f" within {bound:g} {space.unit}"
            sentences = ["No question was answered."] if not valid[lane].any() else result.words() if result else []
            if result is None or result.changed:
                sentences.append(self._verdict(lane, space.unit))
            lane_of = f", seed {seed}" if self.lanes.number > 1 else ""
            lines += [f"{budget} labels{within}{lane_of}: {line}" for line in sentences]
        return lines

    def _verdict(self, lane: int, unit: str) -> str:
        of, bound = self.judgement, self.lanes.bound_deg[lane]
        before, after, narrowed = of.before[lane], of.after[lane], of.within_deg[lane]
        if of.by == PERSON:
            preferred = f"the policy as it was in {before:.0%}, the corrected in {after:.0%}"
            why = f"of pairs of films a person preferred {preferred}"
        elif of.by != LABELS:
            difference = "{:+.3g} [{:+.3g}, {:+.3g}]".format(*of.difference[lane])
            spent = f"difference {difference}; {of.rewarded_steps[lane]:,} rewarded steps"
            why = f"{of.by} on tuning episodes {before:.4g} before, {after:.4g} after ({spent})"
        elif self.results:
            factor = f"{np.exp(after):.3g}" if after < MOST_NATS else "more than a million"
            why = f"answers predicted before they were read: {factor} times as likely as without a change"
        else:
            why = f"predicts {after:.4g} of held-out answers, always 'already right' {before:.4g}"
        if not of.in_use[lane]:
            return f"{why}; not shown to be better, so the policy stays as it was"
        return f"{why}; the correction is used" + (f" within {narrowed:g} {unit}" if narrowed < 0.999 * bound else "")


def adapt(
    of: Adaptation,
    lanes: Lanes,
    how: Judging,
    teacher: Teacher | None = None,
    labels: Label | None = None,
    mesh: Mesh | None = None,
    watch: Callable[[str], Tell] = lambda what: ignore_progress,
) -> AdaptationResult:
    """Ask for labels, fit a model and judge the corrected policy in every lane.

    `teacher`: who answers in rounds; or `labels`: rows (lanes, slots, ...) in place of questions, fitted at once.
    `mesh`: devices that share the lanes (default: all of this process's). `watch`: takes the name of a piece of work,
    returns its progress callback.
    """
    mesh, count = mesh or lane_mesh(), lanes.number
    # the block is filled up with repeats of the last lane, which are dropped in the end
    filled = np.minimum(np.arange(-(-count // mesh.size) * mesh.size), count - 1)
    judge = Judge(of, Lanes(*(column[filled] for column in lanes)), how, mesh, watch)
    placed = of.replace(env=place(mesh, of.env, SHARED), bases=place(mesh, of.bases, SHARED))
    block = place(mesh, begin(of, judge.lanes), BY_LANE)
    if labels is not None:
        rows = jax.tree.map(lambda leaf: jnp.asarray(leaf)[filled], labels)
        block = take_labels(placed, place(mesh, rows, BY_LANE), block, mesh)
    else:
        asks, number, tell = place(mesh, teacher, SHARED), rounds(lanes, of.sizes), watch("labels")
        for index in range(number):
            tell(index, number)
            block = jax.block_until_ready(ask_round(placed, asks, block, mesh))
            if block.failed.all():
                blame(placed, asks, block)
        tell(number, number)
    return result_of(judge, block, count)


def result_of(judge: Judge, block: Any, count: int, results: tuple[Result, ...] = ()) -> AdaptationResult:
    """Judge a block's first `count` lanes and take out corrections that are not used."""
    judgement, block = judge.judge_lanes(block, results)
    block = judge.of.drop_unused(block, jnp.asarray(judgement.in_use))
    block, lanes = jax.tree.map(lambda leaf: leaf[:count], block), Lanes(*(column[:count] for column in judge.lanes))
    judgement = Judgement(judgement.by, *(column[:count] for column in judgement[1:]))
    return AdaptationResult(judge.of, lanes, block, judgement, results)


def check_amounts(space: Space, bounds: Sequence[float], scalars: Scalars | None, tries: bool = True) -> None:
    """Raise UserError for bounds that no action reaches, and answers from which nothing could be learned within them.

    `scalars`: None where nothing is known of answers. `tries`: whether a pass moves actions by them.
    """
    if not all(0 < bound <= space.reach for bound in bounds) or len(set(bounds)) < len(bounds):  # NaN is neither
        text = " ".join(f"{bound:g}" for bound in bounds)
        raise UserError(f"bound_deg is {text}: give numbers above 0, up to {space.reach:g} ({space.unit}), each once")
    eps = 0.0 if scalars is None else scalars.eps_deg
    if eps > space.reach:
        raise UserError(f"scalars.eps_deg is {eps:g} {space.unit}, beyond all actions: give at most {space.reach:g}")
    if scalars is None or not tries:
        return
    if not space.grain <= eps <= min(bounds):
        advice = f"give a scalars.eps_deg from {space.grain:g} on, about a tenth of the bound"
        raise UserError(f"labels of {eps:g} {space.unit} say nothing within a bound of {min(bounds):g}: {advice}")
    if scalars.tau_deg >= eps:
        why = f"a pass moves an action by {eps:g}, after which refinement would stop"
        raise UserError(f"scalars.tau_deg is {scalars.tau_deg:g} and {why}: give scalars.tau_deg {eps / PASSES:g}")


def reach(space: Space, policy: Policy, obs: Any, action: Any) -> float:
    """Return how far 95% of labelled actions (labels, action) lie from a policy's own at most, in the space's unit."""
    away = _distances(space, policy, jnp.asarray(obs), jnp.asarray(action))
    user_code.check_actions(away, policy_name(policy))
    return float(space.to_unit(np.quantile(np.asarray(away), REACH_QUANTILE), np))


@partial(jax.jit, static_argnames="space")
def _distances(space: Space, policy: Any, obs: Array, action: Array) -> Array:
    return space.distance(policy.act(jax.random.key(0), None, obs), action)


def plain_scalars(space: Space) -> Scalars:
    """Return default scalars in a space's unit, scaled by the space's reach; eps is at least the space's grain."""
    names = ("eps_deg", "tau_deg", "tau_max_deg", "scalar_within_deg", "nearest_aim_deg")
    scalars = replace(Scalars(), **{name: getattr(Scalars, name) * (space.reach / DIRECTIONS.reach) for name in names})
    return replace(scalars, eps_deg=max(scalars.eps_deg, space.grain)) if space.grain else scalars


def settling(scalars: Scalars, eps_deg: float | None) -> Scalars:
    """Return the scalars with answers of strength eps (None: unchanged) and a threshold tau small beside eps."""
    eps = scalars.eps_deg if eps_deg is None else eps_deg
    return replace(scalars, eps_deg=eps, tau_deg=min(scalars.tau_deg, eps / PASSES))
