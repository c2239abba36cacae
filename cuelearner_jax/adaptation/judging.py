"""Judge whether an adapted policy is better than its base. An adapted policy that is worse is not used.

With a simulator both play the same episodes, none of which reported figures are measured on: those of the "tuning"
split of the changed world. Without one, held-out labels are predicted, against answering "already right" always.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh
from jaxtyping import Array

from cuelearner_jax.adaptation.lanes import Adaptation, Lanes, LaneState
from cuelearner_jax.asking import fitted_labels
from cuelearner_jax.devices import each_lane
from cuelearner_jax.environment import Environment, actions_of
from cuelearner_jax.errors import UserError, suggestion
from cuelearner_jax.evaluate import Rollout, Tell, episodes, mean_interval, rollout_lanes
from cuelearner_jax.policies import PolicyBlock
from cuelearner_jax.spaces import is_answered

HELD_OUT = 5  # every fifth label is held out
LABELS = "labels"  # `Judging.by` where held-out labels judge in place of a metric
SPLIT = "tuning"  # the split that the judging episodes come from
STEPS = 100  # steps of each environment, where a task counts steps
MOST_BOUNDS = 16  # largest number of shares of a bound


@dataclass(frozen=True)
class Judging:
    """Settings of the comparison between policies and their bases, at the end and along the learning curve."""

    env: Environment | None  # the changed world with the episodes of `SPLIT`; None: there is no simulator
    num_envs: int = 100
    steps: int = 10_000  # environment steps, shared by the environments
    by: str = "reward"  # a metric, or "labels"
    every: int = 0  # labels between two measurements on the way (0: at the end alone)
    bounds: tuple[float, ...] = ()  # shares of a lane's bound within which its policy is tried as well


class Judgement(NamedTuple):
    """The values of the base policies and of the adapted ones, one entry a lane; larger is better."""

    by: str  # a metric, or "labels": the share of held-out answers that are predicted
    before: np.ndarray  # (lanes,)
    after: np.ndarray  # (lanes,)
    used: np.ndarray  # (lanes,) bool: is the model used? Not if it is worse than the base, or not finite
    within_deg: np.ndarray  # (lanes,) how far corrections then lead from the base's actions [the space's unit]
    # (lanes, 3) after less before and the ends of its 95% interval over episodes, paired; nan by labels
    difference: np.ndarray
    rewarded_steps: np.ndarray  # (lanes,) int: environment steps whose rewards or outcomes decided; 0 by labels


def metrics_of(env: Environment) -> tuple[str, ...]:
    """Return the names of the metrics that a roll-out measures in an environment."""
    step = _step_of(env)
    return ("reward", *step.metrics, *step.outcome)


def _step_of(env: Environment) -> Any:
    key = jax.random.key(0)
    state, _ = jax.eval_shape(env.reset, key)
    return jax.eval_shape(env.step, key, state, jnp.zeros(actions_of(env).size))[1]


def check_bounds(shares: tuple[float, ...], by: str) -> None:
    """Raise UserError for shares of a bound outside (0, 1), or too many of them."""
    if len(shares) > MOST_BOUNDS:
        raise UserError(f"judge_bounds has {len(shares):,} shares, each played by itself: give at most {MOST_BOUNDS}")
    if not all(0 < share < 1 for share in shares) or len(set(shares)) < len(shares):
        given = " ".join(f"{share:g}" for share in shares)
        raise UserError(f"judge_bounds is {given}: give shares of the bound above 0 and below 1, each once")
    if shares and by == LABELS:
        raise UserError("judge_bounds needs episodes to be tried on: give --judge-by a metric of the task")


class Judge:
    """Measures the lanes of an adaptation along the learning curve, and decides in the end which models are used.

    A block of lanes is a `LaneState`, or any record with `base`, `bound`, `asked`, `corrects` and `failed`.

    A block of lanes is a `LaneState`, or what else has `base`, `bound`, `asked`, `corrects` and `failed`.
    """

    def __init__(self, of: Adaptation, lanes: Lanes, how: Judging, mesh: Mesh, watch: Callable[[str], Tell]) -> None:
        """`mesh`: devices that share the lanes; `watch`: given the name of a piece of work, who is told progress."""
        self.of, self.lanes, self.how, self.watch = of, lanes, how, watch
        self.mesh = mesh if mesh.size > 1 else None
        self.curve: list[dict[str, np.ndarray]] = []

    def measure_if_due(self, block: Any, asked: int) -> None:
        """Add a row to the learning curve if enough labels came since the last row."""
        if self.how.every and asked % self.how.every == 0:
            self.measure(block)

    def judge_lanes(self, block: Any) -> tuple[Judgement, Any]:
        """Return the judgement of the finished lanes, and the lanes with the bounds that are used.

        Raises UserError if the world has no such metric, or labels cannot judge.
        """
        how, lanes = self.how, self.lanes
        found = judged_by_labels(self.of, block) if how.by == LABELS else None
        after = self.measure(block) if how.env is not None else None
        if found is not None:
            return found, block
        assert after is not None  # a metric needs episodes
        if how.by not in after.means:
            raise UserError(f"there is no metric {how.by!r} to judge by{suggestion(how.by, [*after.means, LABELS])}")
        bases = self._rolled(self.of.bases, "the policy as it was")
        own = np.zeros(lanes.number, int) if len(bases.means[how.by]) == 1 else lanes.base
        played = self._played(after) + self._played(bases)[own]
        block, after, more = self._narrowed(block, after)
        before, worth = np.asarray(bases.means[how.by])[own], np.asarray(after.means[how.by])
        usable = ~np.asarray(block.failed) & np.asarray(block.corrects)
        used = usable & (worth >= before)  # NaN ranks below every value
        difference = mean_interval(np.asarray(after.each[how.by]) - np.asarray(bases.each[how.by])[own]).T
        return Judgement(how.by, before, worth, used, bounds_of(self.of, block), difference, played + more), block

    def _narrowed(self, block: Any, after: Rollout) -> tuple[Any, Rollout, np.ndarray]:
        """Return lanes within the best share of their bounds, their value, and the rewarded steps (lanes,) of this."""
        bound, played, by = block.bound, np.zeros(self.lanes.number, int), self.how.by
        for share in self.how.bounds:
            tried = block.replace(bound=share * block.bound)
            found = self._rolled(self._policy(tried), f"the adapted policy within {share:g} of its bound")
            played = played + self._played(found)
            better = np.asarray(found.means[by] > after.means[by])
            after = jax.tree.map(
                lambda new, old, better=better: np.where(better.reshape(-1, *[1] * (new.ndim - 1)), new, old),
                found,
                after,
            )
            bound = jnp.where(jnp.asarray(better), tried.bound, bound)
        return block.replace(bound=bound), after, played

    def measure(self, block: Any) -> Rollout:
        """Roll out the lanes' current policies, and add a row to the learning curve."""
        found = self._rolled(self._policy(block), "the adapted policy")
        asked, failed = np.asarray(block.asked), np.asarray(block.failed)
        self.curve.append({"asked": asked, "failed": failed, **found.means})
        return found

    def _policy(self, block: Any) -> PolicyBlock:
        return self.of.policy(block, self.how.env)

    def _rolled(self, policy: PolicyBlock, what: str) -> Rollout:
        how = self.how
        assert how.env is not None
        mesh = None if policy is self.of.bases else self.mesh  # the number of environments may differ
        return rollout_lanes(how.env, policy, episodes(SPLIT), how.num_envs, how.steps, self.watch(what), mesh)

    def _played(self, rolled: Rollout) -> np.ndarray:
        """Return the environment steps (lanes,) of a roll-out that count.

        Where a metric is an outcome, only the steps of first episodes count.
        """
        assert self.how.env is not None
        first = np.asarray(rolled.episode_steps)
        return first.sum(-1) if self.how.by in _step_of(self.how.env).outcome else np.full(len(first), self.how.steps)


def judged_by_labels(of: Adaptation, block: LaneState) -> Judgement:
    """Compare a model with answering "already right" always, on every fifth label, which the model was not fitted to.

    The model in use is fitted to all labels; a second one is fitted for this comparison alone.

    Raises:
        UserError: answers that say nothing about turning an action, or fewer than five.
    """
    form = of.guidance.form
    if form is None or not form.by_eps:
        told = form.name if form else "no"
        raise UserError(f"{told} answers cannot be judged by held-out labels: give --judge-by a metric of the task")
    if int(np.asarray(block.guide.labels.valid).sum(-1).min()) < HELD_OUT:
        raise UserError(f"fewer than {HELD_OUT} labels cannot judge a model: give more, or --judge-by a metric")
    zero, right = jax.device_get(_predicted(of, block))
    used = ~np.asarray(block.failed) & (right >= zero)
    unknown, none = np.full((len(used), 3), np.nan), np.zeros(len(used), int)
    return Judgement(LABELS, zero, right, used, bounds_of(of, block), unknown, none)


@jax.jit
def _predicted(of: Adaptation, block: LaneState) -> tuple[Array, Array]:
    """Return the shares (lanes,) of held-out answers that "already right" and a model of the other answers predict."""
    guidance, env, space = of.guidance, of.env, actions_of(of.env)
    one_pass = dataclasses.replace(of.scalars, k_max=1, tau_max_deg=space.reach)

    def one(lane: LaneState) -> tuple[Array, Array]:
        key = jax.random.fold_in(lane.key, HELD_OUT)
        labels = fitted_labels(key, lane.guide.labels, of.scalars)
        held = labels.valid & (jnp.arange(labels.valid.shape[0]) % HELD_OUT == HELD_OUT - 2)
        others = labels.replace(valid=labels.valid & ~held)
        model = guidance.fit(key, env, others, guidance.init(key), of.scalars)
        moved = guidance.refine_labelled_actions(model, env, labels, held, one_pass).actions
        moves = space.log(labels.action, moved) / space.from_unit(of.scalars.eps_deg)
        # words about one cue each; of the other cues nothing is compared
        told = is_answered(labels.answer) & held[:, None]
        count = jnp.maximum(told.sum(), 1)
        share = lambda flags: jnp.sum(flags, where=told) / count  # noqa: E731
        right = share(jnp.round(jnp.clip(moves, -1, 1)) == labels.answer)
        return share(labels.answer == 0), jnp.where(told.any(), right, jnp.nan)

    return each_lane(one)(block)


def bounds_of(of: Adaptation, block: Any) -> np.ndarray:
    """Return the bounds (lanes,) of a block of lanes, in the space's unit."""
    return actions_of(of.env).to_unit(np.asarray(block.bound), np)
