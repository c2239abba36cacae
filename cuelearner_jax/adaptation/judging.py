"""Judge whether an adapted policy is better than its base. An adapted policy is used only if it is.

With a simulator both play the same episodes of the changed world, those of the split "tuning", until a sequential test
of the paired differences decides (`PairedTest`). Reported figures are measured on other episodes. A person may compare
films of such episodes in place of a metric. Without a simulator, held-out labels are predicted, against answering
"already right" always; a reading has a rule of its own.
"""

from __future__ import annotations

import contextlib
import dataclasses
import tempfile
from collections.abc import Callable, Generator, Sequence
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
from cuelearner_jax.reading import Result
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
SHARES = ("success", "finished", PERSON)  # values within [0, 1]

# films of the same start -> -1: the left one is better, 0: neither, 1: the right one
Prefer = Callable[[Path, Path], int]
Pair = tuple[dict[str, np.ndarray], dict[str, np.ndarray]]  # values (lanes, episodes) by name, before and after


@dataclass(frozen=True)
class Judging:
    """Settings of the comparison between policies and their bases."""

    env: Environment | None  # the changed world with the episodes of `SPLIT`; None: there is no simulator
    num_envs: int = 50  # episodes at most
    steps: int = 100  # environment steps of each
    by: str = "reward"  # a metric, "labels" or "person"
    prefer: Prefer | None = None  # where a person judges: who compares films of `pictures`
    pictures: Pictures | None = None
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


def step_of(env: Any) -> Any:
    """Return the shapes of an environment's step, whose metrics and outcome a roll-out measures."""
    key = jax.random.key(0)
    state, _ = jax.eval_shape(env.reset, key)
    return jax.eval_shape(env.step, key, state, jnp.zeros(actions_of(env).size))[1]


@dataclass(frozen=True)
class Judge:
    """Decides which models of an adaptation's lanes are used.

    A block of lanes is a `LaneState`, or any record with `base`, `bound`, `corrects` and `failed`.
    """

    of: Adaptation
    lanes: Lanes
    how: Judging
    mesh: Mesh  # devices that share the lanes
    watch: Callable[[str], Tell]  # given the name of a piece of work, returns its progress callback

    def judge_lanes(self, block: Any, results: Sequence[Result] = ()) -> tuple[Judgement, Any]:
        """Return the judgement of the finished lanes, and the lanes with the bounds that are used.

        `results`: of a reading, whose evidence judges in place of held-out labels.
        """
        how, lanes = self.how, self.lanes
        difference, steps = np.full((lanes.number, 3), np.nan), np.zeros(lanes.number, int)
        if how.by != LABELS:
            block, steps = self._narrowed(block)
            before, after, in_use, spent = self._by_episodes(block)
            difference, steps = mean_interval(after - before).T, steps + spent
            before, after = before.mean(-1), after.mean(-1)
        elif results:
            before, after = np.zeros(lanes.number), np.array([one.evidence for one in results])
            in_use = np.array([one.used for one in results])
        else:
            before, after, in_use = judge_by_labels(self.of, block)
        within = actions_of(self.of.env).to_unit(np.asarray(block.bound), np)
        return Judgement(how.by, before, after, in_use, within, difference, steps), block

    def _by_episodes(self, block: Any) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Return values before and after (lanes, episodes), whether each lane is used, and its rewarded steps."""
        number, usable = self.lanes.number, ~np.asarray(block.failed) & np.asarray(block.corrects)
        test, values, steps = PairedTest(number), [], np.zeros(number, int)
        is_person = self.how.by == PERSON  # who is not asked about a policy that cannot be used
        with contextlib.closing(self._by_person(block) if is_person else self._by_metric(block)) as pairs:
            for pair, spent in pairs if usable.any() or not is_person else ():
                values.append([one[self.how.by] for one in pair])
                steps += spent
                test.add(differences(pair, self.how.by), gains(pair, self.how.by))
                if (test.decided | ~usable).all():
                    break
        before, after = np.concatenate(values, -1) if values else np.full((2, number, 1), np.nan)
        return before, after, usable & test.better, steps

    def _by_metric(self, block: Any) -> Generator[tuple[Pair, np.ndarray], None, None]:
        """Yield values of base and adapted policy on the same episodes, and the rewarded steps (lanes,) of these."""
        adapted = self.of.policy(block, self.how.env)
        for first in range(0, self.how.num_envs, AT_ONCE):
            key, count = jax.random.fold_in(episodes(SPLIT), first // AT_ONCE), min(AT_ONCE, self.how.num_envs - first)
            bases, base_steps = self._rolled(self.of.bases, "the policy as it was", key, count)
            after, steps = self._rolled(adapted, "the corrected policy", key, count)
            own = self.lanes.base if len(base_steps) > 1 else np.zeros(self.lanes.number, int)
            yield ({name: values[own] for name, values in bases.each.items()}, after.each), steps + base_steps[own]

    def _by_person(self, block: Any) -> Generator[tuple[Pair, int], None, None]:
        """Yield which policy a person prefers, for one start after another; films change sides by chance.

        Raises UserError for an answer other than -1, 0 and 1.
        """
        how: Any = self.how  # with `prefer` and `pictures`
        policies = self.of.bases.lane(0), self.of.policy(block, how.env).lane(0)
        with tempfile.TemporaryDirectory() as folder:
            for number in range(how.num_envs):
                start = jax.random.fold_in(episodes(SPLIT), number)
                films = [Path(folder, f"{number}{name}.gif") for name in "ab"]
                for policy, file in zip(policies, films, strict=True):
                    steps = int(_length(how.env, policy, start, how.steps))
                    how.pictures.animate(how.env, how.pictures.record(how.env, policy, start, steps)[0], file)
                is_swapped = bool(jax.random.bernoulli(jax.random.fold_in(start, 1)))
                if (answer := how.prefer(*(films[::-1] if is_swapped else films))) not in (-1, 0, 1):
                    says = f"judge_by gave {format_value(answer)}"
                    raise UserError(f"{says}: give -1 (left), 0 (no difference) or 1 (right)")
                better = -answer if is_swapped else answer
                before, after = ({PERSON: np.array([[better == which]], float)} for which in (-1, 1))
                yield (before, after), 0

    def _narrowed(self, block: Any) -> tuple[Any, np.ndarray]:
        """Return lanes within the best share of their bounds, and the rewarded steps (lanes,) of this."""
        steps, best, value = np.zeros(self.lanes.number, int), block.bound, np.full(self.lanes.number, -np.inf)
        for share in (1.0, *self.how.bounds) if self.how.bounds else ():
            within = block.replace(bound=share * block.bound)
            what = f"the adapted policy within {share:g} of its bound"
            rolled, spent = self._rolled(self.of.policy(within, self.how.env), what, episodes(SPLIT), self.how.num_envs)
            steps = steps + spent
            better = np.asarray(rolled.means[self.how.by]) > value
            value = np.where(better, rolled.means[self.how.by], value)
            best = jnp.where(jnp.asarray(better), within.bound, best)
        return block.replace(bound=best), steps

    def _rolled(self, policy: PolicyNode, what: str, key: PRNGKeyArray, num_envs: int) -> tuple[Rollout, np.ndarray]:
        """Play episodes; return their values, and the steps (lanes,) whose rewards or outcomes count.

        Where an outcome judges, or no other episodes are played, these are the steps of first episodes.
        """
        how = self.how
        assert how.env is not None  # a metric needs episodes
        mesh = None if policy is self.of.bases or self.mesh.size == 1 else self.mesh
        rolled = rollout_lanes(how.env, policy, key, num_envs, num_envs * how.steps, self.watch(what), mesh)
        is_of_first = plays_once(how.env) or how.by in step_of(how.env).outcome
        first = rolled.episode_steps.sum(-1)
        return rolled, first if is_of_first else np.full(len(first), num_envs * how.steps)


class PairedTest:
    """A sequential test of differences in [-1, 1], whose chance to call better what is not is 1/20 at most.

    Under "not better", E = mean over lambda of prod(1 + lambda d) is a test martingale; so is H with -d under "not
    worse". The first to reach 20 decides (Ville's inequality: the chance to ever reach 20 is 1/20). The bound holds for
    shares. Rewards and returns are clipped, so a rare crash counts too little: better also needs a mean gain so far.
    """

    def __init__(self, lanes: int) -> None:
        self._products, self._gain = np.ones((2, len(STAKES), lanes)), np.zeros(lanes)  # for better and worse; so far
        self.better, self.worse = np.zeros(lanes, bool), np.zeros(lanes, bool)

    @property
    def decided(self) -> np.ndarray:
        """Whether the test of each lane (lanes,) has ended."""
        return self.better | self.worse

    def add(self, differences: np.ndarray, gains: np.ndarray | None = None) -> None:
        """Add episodes (lanes, episodes) in their order; `gains`: their differences where these are clipped."""
        for d, gain in zip(differences.T, (differences if gains is None else gains).T, strict=True):
            self._products *= 1 + np.stack([np.outer(STAKES, d), -np.outer(STAKES, d)])
            self._gain += gain
            better, worse = self._products.mean(1) >= DECIDED
            better &= self._gain >= 0  # False for NaN
            open_yet = ~self.decided
            self.better |= open_yet & better
            self.worse |= open_yet & worse & ~better


def gains(pair: Pair, by: str) -> np.ndarray:
    """Return after less before of each episode: NaN without a value after, 0 without one before; such a share is 0."""
    before, after = (one[by] for one in pair)
    if by in SHARES:
        return np.nan_to_num(after) - np.nan_to_num(before)
    return np.where(np.isnan(before), 0.0, after - before)


def differences(pair: Pair, by: str) -> np.ndarray:
    """Return how much better each episode (lanes, episodes) of the second policy was, in [-1, 1].

    Values of a share, as success, count as they are; others in units of the largest value of both policies in the
    batch, since a unit of one policy alone would favour the other where neither is better. Where the second policy
    alone has no value, it is worse. Where a share is equal, the returns decide, with half of the weight.
    """
    before, after = pair

    def relative(name: str) -> np.ndarray:
        largest = np.nanmax(np.abs(np.concatenate([before[name], after[name]], -1)), axis=-1, keepdims=True)
        return np.nan_to_num(np.clip(gains(pair, name) / np.fmax(largest, 1e-9), -1, 1), nan=-1.0)

    if by in SHARES:
        d = gains(pair, by)
        return np.where(d == 0, 0.5 * relative("return"), d) if "return" in before else d
    return relative(by)


def judge_by_labels(of: Adaptation, block: LaneState) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return before, after and used of a `Judgement`: "already right" always, and a model, on every fifth label.

    The model in use is fitted to all labels; a second one is fitted for this comparison alone.
    """
    form: Any = of.guidance.form
    if not form.by_eps:
        raise UserError(f"{form.name} answers cannot be held out for judging: give --judge-by a metric of the task")
    failed = np.asarray(block.failed)
    if np.asarray(block.guide.labels.valid).sum(-1)[~failed].min(initial=HELD_OUT) < HELD_OUT:
        raise UserError(f"fewer than {HELD_OUT} labels cannot judge a model: give more, or --judge-by a metric")
    zero, right = jax.device_get(_predicted(of, block))
    return zero, right, ~failed & (right > zero)


@jax.jit
def _predicted(of: Adaptation, block: LaneState) -> tuple[Array, Array]:
    """Return the shares (lanes,) of held-out answers that "already right" and a model of the other answers predict."""
    guidance, env, space = of.guidance, of.env, actions_of(of.env)
    one_pass = dataclasses.replace(of.scalars, k_max=1, tau_max_deg=space.reach)

    def one(lane: LaneState) -> tuple[Array, Array]:
        key = jax.random.fold_in(lane.key, HELD_OUT)
        labels = fitted_labels(key, lane.guide.labels, of.scalars)
        held = labels.valid & (jnp.arange(labels.valid.shape[0]) % HELD_OUT == HELD_OUT - 2)
        model = guidance.fit(key, env, labels.replace(valid=labels.valid & ~held), guidance.init(key), of.scalars)
        refined = guidance.act(model, env, labels.obs, labels.action, held, one_pass).actions
        moves = space.log(labels.action, refined) / space.from_unit(of.scalars.eps_deg)
        # words about one cue each; of the other cues nothing is compared
        counts = is_answered(labels.answer) & held[:, None]
        share = lambda flags: jnp.sum(flags, where=counts) / jnp.maximum(counts.sum(), 1)  # noqa: E731
        right = share(jnp.round(jnp.clip(moves, -1, 1)) == labels.answer)
        return share(labels.answer == 0), jnp.where(counts.any(), right, jnp.nan)

    return each_lane(one)(block)


@jax.jit
def _length(env: Environment, policy: Policy, key: PRNGKeyArray, steps: Int[Array, ""] | int) -> Int[Array, ""]:
    """Return the steps of an episode that begins by a key, with the random numbers of `Pictures.record`."""
    k_reset, k_play = jax.random.split(key)

    def advance(carry: tuple[Any, ...]) -> tuple[Any, ...]:
        number, state, obs, _ = carry
        k_act, k_step = jax.random.split(jax.random.fold_in(k_play, number))
        action = policy.act(k_act, jax.tree.map(lambda leaf: leaf[None], state), obs[None])[0]
        following, step = env.step(k_step, state, action)
        return number + 1, following, step.obs, step.terminated | step.truncated

    first = (jnp.zeros((), jnp.int32), *env.reset(k_reset), jnp.array(False))
    return jax.lax.while_loop(lambda carry: (carry[0] < steps) & ~carry[-1], advance, first)[0]
