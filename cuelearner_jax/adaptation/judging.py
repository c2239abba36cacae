"""Judge whether an adapted policy is better than its base. An adapted policy is used only if it is.

With a simulator both play the same episodes of the changed world, those of the split "tuning", until a sequential test
of the paired differences decides (`PairedTest`). Reported figures are measured on other episodes. A person may compare
films of such episodes in place of a metric. Without a simulator, held-out labels are predicted, against answering
"already right" always; a reading has a rule of its own.
"""

from __future__ import annotations

import contextlib
import dataclasses
import itertools
import tempfile
from collections.abc import Callable, Generator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh
from jaxtyping import Array, Int, PRNGKeyArray

from cuelearner_jax.adaptation.lanes import Adaptation, Lanes, LaneState
from cuelearner_jax.asking import fitted_labels
from cuelearner_jax.devices import each_lane
from cuelearner_jax.environment import Environment, actions_of, plays_once
from cuelearner_jax.errors import UserError, format_value
from cuelearner_jax.evaluate import Rollout, Tell, episodes, mean_interval, rollout_lanes
from cuelearner_jax.policies import Policy, PolicyNode
from cuelearner_jax.spaces import is_answered
from cuelearner_jax.task import Pictures

HELD_OUT = 5  # every fifth label is held out
LABELS = "labels"  # `Judging.by` where held-out labels judge in place of a metric
PERSON = "person"  # where a person does
SPLIT = "tuning"  # the split that the judging episodes come from
STEPS = 100  # steps of each environment, where a task counts steps
AT_ONCE = 10  # episodes between two looks
STAKES = np.array([0.1, 0.2, 0.35, 0.5, 0.7, 0.9])  # lambda of the sequential test
DECIDED = 20.0  # value of the test martingale that decides
SHARES = ("success", "finished")  # metrics within [0, 1]

# films of the same start -> -1: the left one is better, 0: neither, 1: the right one
Prefer = Callable[[Path, Path], int]


class Person(NamedTuple):
    """Who compares films, and how these are drawn."""

    prefer: Prefer
    pictures: Pictures


@dataclass(frozen=True)
class Judging:
    """Settings of the comparison between policies and their bases."""

    env: Environment | None  # the changed world with the episodes of `SPLIT`; None: there is no simulator
    num_envs: int = 50  # episodes at most
    steps: int = 100  # environment steps of each
    by: str = "reward"  # a metric, "labels" or "person"
    person: Person | None = None
    bounds: tuple[float, ...] = ()  # shares of a lane's bound within which its policy is tried as well


class Judgement(NamedTuple):
    """The values of the base policies and of the adapted ones, one entry a lane; larger is better."""

    by: str  # a metric; "labels": the share of held-out answers that are predicted; "person": of pairs preferred
    before: np.ndarray  # (lanes,)
    after: np.ndarray  # (lanes,)
    in_use: np.ndarray  # (lanes,) bool: is the correction used? Only if it is shown to be better, and finite
    within_deg: np.ndarray  # (lanes,) how far corrections then lead from the base's actions [the space's unit]
    # (lanes, 3) after less before and the ends of its 95% interval over episodes, paired; nan by labels
    difference: np.ndarray
    rewarded_steps: np.ndarray  # (lanes,) int: environment steps whose rewards or outcomes decided; 0 by labels


def metrics_of(env: Environment) -> tuple[str, ...]:
    """Return the names of the metrics that a roll-out measures in an environment."""
    step = _step_of(env)
    return ("reward", *step.metrics, *step.outcome)


def _step_of(env: Any) -> Any:
    key = jax.random.key(0)
    state, _ = jax.eval_shape(env.reset, key)
    return jax.eval_shape(env.step, key, state, jnp.zeros(actions_of(env).size))[1]


class Judge:
    """Decides which models of an adaptation's lanes are used.

    A block of lanes is a `LaneState`, or any record with `base`, `bound`, `corrects` and `failed`.
    """

    def __init__(self, of: Adaptation, lanes: Lanes, how: Judging, mesh: Mesh, watch: Callable[[str], Tell]) -> None:
        """`mesh`: devices that share the lanes; `watch`: given the name of a piece of work, who is told progress."""
        self.of, self.lanes, self.how, self.watch = of, lanes, how, watch
        self.mesh = mesh if mesh.size > 1 else None

    def judge_lanes(self, block: Any) -> tuple[Judgement, Any]:
        """Return the judgement of the finished lanes, and the lanes with the bounds that are used."""
        how, lanes = self.how, self.lanes
        if how.by == LABELS:
            if self.of.guidance.by_evidence:
                verdict = np.zeros(lanes.number), block.evidence, block.in_use
            else:
                verdict = judge_by_labels(self.of, block)
            unknown, none = np.full((lanes.number, 3), np.nan), np.zeros(lanes.number, int)
            return Judgement(LABELS, *verdict, bounds_of(self.of, block), unknown, none), block
        usable = ~np.asarray(block.failed) & np.asarray(block.corrects)
        if how.person is not None:
            return self._compared(how.person, block, usable), block
        block, steps = self._narrowed(block)
        test, values = PairedTest(lanes.number), []
        for number in range(-(-how.num_envs // AT_ONCE)):
            pair, own_steps = self._pair(block, number)
            values.append(pair)
            steps += own_steps
            test.add(differences(pair, how.by))
            if (test.decided | ~usable).all():
                break
        before, after = (np.concatenate([pair[end][how.by] for pair in values], -1) for end in (0, 1))
        means, difference = (before.mean(-1), after.mean(-1)), mean_interval(after - before).T
        return Judgement(how.by, *means, usable & test.better, bounds_of(self.of, block), difference, steps), block

    def _compared(self, person: Person, block: Any, usable: np.ndarray) -> Judgement:
        """Return what a person says of the only lane's episodes."""
        assert self.how.env is not None
        assert self.lanes.number == 1  # `AdaptRequest`
        test, answers = PairedTest(1), []
        policies = self.of.bases.lane(0), self.of.policy(block, self.how.env).lane(0)
        answers_of_person = preferences(person, self.how.env, policies, episodes(SPLIT), self.how.steps)
        with contextlib.closing(answers_of_person):
            for answer in itertools.islice(answers_of_person, self.how.num_envs if usable[0] else 0):
                answers.append(answer)
                test.add(np.array([[float(answer)]]))
                if test.decided[0]:
                    break
        each = np.array([answers], float).reshape(1, -1)
        before, after = (np.mean(each == which, -1) if answers else np.zeros(1) for which in (-1, 1))
        difference = mean_interval(each).T if answers else np.full((1, 3), np.nan)
        in_use, steps = usable & test.better, np.zeros(1, int)
        return Judgement(PERSON, before, after, in_use, bounds_of(self.of, block), difference, steps)

    def _pair(self, block: Any, number: int) -> tuple[tuple[dict[str, np.ndarray], ...], np.ndarray]:
        """Play episodes by base and adapted policy; return the values of each (lanes, episodes), and the steps."""
        key = jax.random.fold_in(episodes(SPLIT), number)
        bases = self._rolled(self.of.bases, "the policy as it was", key, AT_ONCE)
        after = self._rolled(self.of.policy(block, self.how.env), "the corrected policy", key, AT_ONCE)
        shared = len(next(iter(bases.each.values()))) == 1
        own = np.zeros(self.lanes.number, int) if shared else self.lanes.base
        pair = ({name: np.asarray(values)[own] for name, values in bases.each.items()}, after.each)
        return pair, self._counted_steps(after, AT_ONCE) + self._counted_steps(bases, AT_ONCE)[own]

    def _narrowed(self, block: Any) -> tuple[Any, np.ndarray]:
        """Return lanes within the best share of their bounds, and the rewarded steps (lanes,) of this."""
        spent = np.zeros(self.lanes.number, int)
        best, value = block.bound, np.full(self.lanes.number, -np.inf)
        for share in (1.0, *self.how.bounds) if self.how.bounds else ():
            within = block.replace(bound=share * block.bound)
            what = f"the adapted policy within {share:g} of its bound"
            rollout = self._rolled(self.of.policy(within, self.how.env), what)
            spent = spent + self._counted_steps(rollout, self.how.num_envs)
            better = np.asarray(rollout.means[self.how.by]) > value
            value = np.where(better, rollout.means[self.how.by], value)
            best = jnp.where(jnp.asarray(better), within.bound, best)
        return block.replace(bound=best), spent

    def _rolled(self, policy: PolicyNode, what: str, key: Any = None, num_envs: int | None = None) -> Rollout:
        how = self.how
        assert how.env is not None  # a metric needs episodes
        mesh = None if policy is self.of.bases else self.mesh  # the number of environments may differ
        key, envs = episodes(SPLIT) if key is None else key, num_envs or how.num_envs
        return rollout_lanes(how.env, policy, key, envs, envs * how.steps, self.watch(what), mesh)

    def _counted_steps(self, rolled: Rollout, num_envs: int) -> np.ndarray:
        """Return the steps (lanes,) that count: for an outcome, or where no others are played, of first episodes."""
        first, whole = np.asarray(rolled.episode_steps), num_envs * self.how.steps
        is_of_first = plays_once(self.how.env) or self.how.by in _step_of(self.how.env).outcome
        return first.sum(-1) if is_of_first else np.full(len(first), whole)


class PairedTest:
    """A sequential test of differences in [-1, 1], whose chance to call better what is not is 1/20 at most.

    Under "not better", E = mean over lambda of prod(1 + lambda d) is a test martingale; so is H with -d under "not
    worse". The first to reach 20 decides (Ville's inequality: the chance to ever reach 20 is 1/20).
    """

    def __init__(self, lanes: int) -> None:
        self._products = np.ones((2, len(STAKES), lanes))  # for better, for worse
        self.better, self.worse = np.zeros(lanes, bool), np.zeros(lanes, bool)

    @property
    def decided(self) -> np.ndarray:
        """Whether the test of each lane (lanes,) has ended."""
        return self.better | self.worse

    def add(self, differences: np.ndarray) -> None:
        """Add episodes (lanes, episodes) in their order."""
        for d in differences.T:
            self._products *= 1 + np.stack([np.outer(STAKES, d), -np.outer(STAKES, d)])
            better, worse = self._products.mean(1) >= DECIDED
            open_yet = ~self.decided
            self.better |= open_yet & better
            self.worse |= open_yet & worse & ~better


def differences(pair: tuple[dict[str, np.ndarray], ...], by: str) -> np.ndarray:
    """Return how much better each episode (lanes, episodes) of the second policy was, in [-1, 1].

    Values of a share, as success, count as they are; others in units of the largest value of both policies in the
    batch, since a unit of one policy alone would favour the other where neither is better.
    Where a share is equal, the returns decide, with half of the weight.
    """
    before, after = pair

    def relative(name: str) -> np.ndarray:
        largest = np.nanmax(np.abs(np.concatenate([before[name], after[name]], -1)), axis=-1, keepdims=True)
        return np.nan_to_num(np.clip((after[name] - before[name]) / np.maximum(largest, 1e-9), -1, 1))

    if by in SHARES:
        d = np.nan_to_num(after[by]) - np.nan_to_num(before[by])
        return np.where(d == 0, 0.5 * relative("return"), d) if "return" in before else d
    return relative(by)


def judge_by_labels(of: Adaptation, block: LaneState) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return before, after and used of a `Judgement`: "already right" always, and a model, on every fifth label.

    The model in use is fitted to all labels; a second one is fitted for this comparison alone.
    """
    form = of.guidance.form
    if form is None or not form.by_eps:
        name = form.name if form else "no"
        raise UserError(f"{name} answers cannot be judged by held-out labels: give --judge-by a metric of the task")
    failed = np.asarray(block.failed)
    if np.asarray(block.guide.labels.valid).sum(-1)[~failed].min(initial=HELD_OUT) < HELD_OUT:
        raise UserError(f"fewer than {HELD_OUT} labels cannot judge a model: give more, or --judge-by a metric")
    zero, right = jax.device_get(_predicted(of, block))
    return zero, right, ~failed & (right >= zero)


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
        refined = guidance.refine_labelled_actions(model, env, labels, held, one_pass).actions
        moves = space.log(labels.action, refined) / space.from_unit(of.scalars.eps_deg)
        # words about one cue each; of the other cues nothing is compared
        counts = is_answered(labels.answer) & held[:, None]
        count = jnp.maximum(counts.sum(), 1)
        share = lambda flags: jnp.sum(flags, where=counts) / count  # noqa: E731
        right = share(jnp.round(jnp.clip(moves, -1, 1)) == labels.answer)
        return share(labels.answer == 0), jnp.where(counts.any(), right, jnp.nan)

    return each_lane(one)(block)


def bounds_of(of: Adaptation, block: Any) -> np.ndarray:
    """Return the bounds (lanes,) of a block of lanes, in the space's unit."""
    return actions_of(of.env).to_unit(np.asarray(block.bound), np)


def preferences(
    person: Person, env: Environment, policies: tuple[Policy, Policy], key: PRNGKeyArray, steps: int
) -> Generator[int, None, None]:
    """Yield, for one start after another, 1 where the second policy is preferred, -1 where the first is, else 0.

    Films change sides by chance. `steps`: of an episode, at most. Raises UserError for another answer.
    """
    with tempfile.TemporaryDirectory() as folder:
        number = 0
        while True:
            start = jax.random.fold_in(key, number)
            films = [Path(folder, f"{number}{name}.gif") for name in "ab"]
            for policy, file in zip(policies, films, strict=True):
                frames, _ = person.pictures.record(env, policy, start, int(_length(env, policy, start, steps)))
                person.pictures.animate(env, frames, file)
            swapped = bool(jax.random.bernoulli(jax.random.fold_in(start, 1)))
            answer = person.prefer(*(films[::-1] if swapped else films))
            if answer not in (-1, 0, 1):
                raise UserError(f"judge_by gave {format_value(answer)}: give -1 (left), 0 (no difference) or 1 (right)")
            yield -answer if swapped else answer
            for file in films:
                file.unlink()
            number += 1


@jax.jit
def _length(env: Environment, policy: Policy, key: PRNGKeyArray, steps: Int[Array, ""] | int) -> Int[Array, ""]:
    """Return the steps of an episode that begins by a key, with the random numbers of `Pictures.record`."""
    k_reset, k_play = jax.random.split(key)

    def unfinished(carry: tuple[Any, ...]) -> Array:
        number, *_, ended = carry
        return (number < steps) & ~ended

    def advance(carry: tuple[Any, ...]) -> tuple[Any, ...]:
        number, state, obs, _ = carry
        k_act, k_step = jax.random.split(jax.random.fold_in(k_play, number))
        action = policy.act(k_act, jax.tree.map(lambda leaf: leaf[None], state), obs[None])[0]
        following, step = env.step(k_step, state, action)
        return number + 1, following, step.obs, step.terminated | step.truncated

    first = (jnp.zeros((), jnp.int32), *env.reset(k_reset), jnp.array(False))
    return jax.lax.while_loop(unfinished, advance, first)[0]
