"""Calibration from the first question to the result: which changes explain the answers, their sizes and intervals.

calibration = Calibration(policy, declared_distortions(env), actions_of(env), eps_deg=2.0)
while calibration.asked < 100:
    questions = calibration.questions(obs, 10)
    calibration.learn(obs[questions.index], questions.action, answers, doubt=questions.doubt)
if calibration.is_far:    # then ask in other situations: is the corrected policy nearer?
    questions = calibration.confirmations(obs, 20)
    calibration.confirm(obs[questions.index], questions.action, answers, doubt=questions.doubt)
found = calibration.result()    # found.words(), found.estimates, found.policy
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from copy import copy
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from cuelearner_jax.calibration.families import Distortion, check_family, unknowns_of
from cuelearner_jax.calibration.likelihood import GRID
from cuelearner_jax.calibration.meaning import Meaning
from cuelearner_jax.calibration.policy import Calibrated
from cuelearner_jax.calibration.posterior import HELD_OUT, Answers, Fit
from cuelearner_jax.calibration.questions import Questions, choose, draw_hypotheses, ties
from cuelearner_jax.calibration.response import Responses
from cuelearner_jax.calibration.scales import scales_of
from cuelearner_jax.errors import UserError
from cuelearner_jax.policies import in_space, policy_of
from cuelearner_jax.spaces import Space, is_answered

Floats = np.ndarray
Given = Array | np.ndarray  # accepted arrays
BATCH = 10  # questions between two fits
CHOICE = 6  # situations from which one question is chosen
LOOKS = 6  # nodes at which the policy is asked in each situation to choose from
FRESH = 3  # nodes after each batch
ROUNDS = 4  # rounds of samples for a set without samples
LEAST = 20  # answers before two changes at once are considered
DOUBT = 2.0  # least evidence for each change [nats]
SURE = 3.0  # least evidence for all changes, against no change [nats]
LOOSE = 5.0  # least evidence where answers differ much from the corrected policy [nats]
LARGEST = 3  # most changes at once
SETTLED, SETTLING = 10.0, 6  # effective samples for each unknown and one in the end; most rounds for these
MOSTLY = 0.75  # share of answers about something else, above which the verdict is UNEXPLAINED
APART = 2.5  # [eps]: larger typical distance between teacher and policy gives the verdict UNEXPLAINED

FAR = 2.0  # [eps]: larger typical distance, after most labels, calls for answers that confirm
CONFIRMING = 5  # every fifth label then asks whether the corrected policy is nearer
MET = 240  # situations from which these questions are chosen
MOVED = (3.0, 20.0)  # [eps]: distance between both policies in such a question, so that neither is right halfway
AGREE = 1.5  # more answers than this must be for the corrected policy, for each one against it

CHANGED, UNCHANGED, UNEXPLAINED = "changed", "nothing changed", "none of these"


class Estimate(NamedTuple):
    """The estimate of one unknown after all answers, in the unknown's unit."""

    name: str
    unit: str
    mean: float
    low: float  # ends of the 95% interval
    high: float
    changed: bool  # True if the unknown is corrected; else the interval is for this unknown added alone

    def words(self) -> str:
        """Describe the estimate in one line."""
        return f"{self.name}: {self.mean:.4g} [{self.low:.4g}, {self.high:.4g}] {self.unit}"


class Result(NamedTuple):
    """The verdict of calibration, the estimates and the corrected policy."""

    verdict: str  # CHANGED, UNCHANGED or UNEXPLAINED
    changes: tuple[str, ...]  # names of the distortions that are corrected
    estimates: tuple[Estimate, ...]  # estimates of all unknowns
    evidence: dict[tuple[str, ...], float]  # evidence of each set of changes, less that of no change [nats]
    held_out: tuple[float, float]  # mean log probability of a held-out answer without and with the changes [nats]
    confirmed: tuple[int, int] | None  # answers for the corrected policy and against it; None: not asked
    refused: tuple[str, ...]  # names of the distortions that were not confirmed
    wrong: float  # share of answers about something else
    apart: float  # typical distance between teacher and corrected policy, in the space's unit
    more: int | None  # expected number of labels still needed; None: not known
    policy: Any  # the corrected policy, or its base where nothing changed

    def words(self) -> list[str]:
        """Describe the result, line by line."""
        if self.refused:
            named = f"The answers named {' and '.join(self.refused)}, but the last answers did not confirm this."
            return [f"{named} The policy stays as it was."]
        if self.verdict == UNEXPLAINED:
            return ["None of these changes explains the answers. The policy stays as it was."]
        if self.verdict == UNCHANGED:
            return ["The answers ask for no change. The policy stays as it was."]
        lines = [one.words() for one in self.estimates if one.changed]
        return [*lines, f"About {self.more} more labels are needed." if self.more else "No more labels are needed."]


class Calibration:
    """The answers so far, and the posterior of the changes.

    Args:
        policy: a policy, or any function of a batch of observations.
        family: the possible changes; see `families.declared_distortions`.
        space: space of the actions.
        eps_deg: strength of an answer, in the space's unit.
        seed: seed of all random numbers.

    Raises:
        UserError: a family that makes no sense, or actions without cues.
    """

    def __init__(self, policy: Any, family: Sequence[Distortion], space: Space, eps_deg: float, seed: int = 0) -> None:
        if not space.cues:
            raise UserError("actions without cues cannot be corrected by relative answers: give another space")
        self.family, self.space, self.seed = check_family(family), space, seed
        self.base = in_space(policy_of(policy), space)
        self.meaning = Meaning(self.base, space)
        self.eps = float(space.from_unit(eps_deg))
        self.random = np.random.default_rng(seed)
        self.answers: Answers | None = None
        self.scales: dict[str, float] = {}
        self.fits: dict[tuple[str, ...], Fit] = {}
        self.ready: list[Responses] = []  # none before the first situations
        self.confirmed: tuple[int, int] | None = None  # see `Result`

    def copy(self, random: np.random.Generator) -> Calibration:
        """Return a copy for choosing questions while the original goes on; `random`: for these questions."""
        other = copy(self)
        other.fits, other.random = {names: copy(fit) for names, fit in self.fits.items()}, random
        other.ready = [copy(one) for one in self.ready]
        return other

    @property
    def asked(self) -> int:
        """Number of answers so far."""
        return 0 if self.answers is None else len(self.answers.obs)

    def questions(self, obs: Float[Given, "n obs"], count: int = BATCH) -> Questions:
        """Return at least `count` questions for n situations; more situations give better questions."""
        obs = np.asarray(obs, np.float32)
        self._scaled(obs)
        fits = list(self.fits.values()) or [self._new(names) for names in self._singles()]
        draws = draw_hypotheses(fits, self._odds(fits), self.random)
        places = np.concatenate([fit.places(thetas) for fit, thetas in draws])
        response = self.responses.respond(obs, self.responses.covering(places, LOOKS))
        chosen = choose(draws, response, count, self.random)
        best = self.best
        theta = np.zeros(0) if best is None else best.interval()[0][: best.changes]
        asks = () if best is None else best.asks
        return chosen._replace(doubt=ties(self.meaning, asks, theta, obs[chosen.index], self.eps))

    def learn(
        self,
        obs: Float[Given, "n obs"],
        action: Float[Given, "n action"],
        answer: Float[Given, "n cues"],
        doubt: Float[Given, " n"] | None = None,
    ) -> None:
        """Add answers (-1, 0, 1 or `UNSAID` for each cue), and fit the changes to all answers so far.

        An answer with every cue unsaid is dropped.
        """
        obs, action, answer = (np.asarray(rows, np.float32) for rows in (obs, action, answer))
        there = np.asarray(is_answered(jnp.asarray(answer)) & np.isfinite(answer)).any(-1)
        obs, action, answer = obs[there], action[there], answer[there]
        if not len(obs):
            return
        doubt = None if doubt is None else np.asarray(doubt)[there]
        self._scaled(obs)
        if doubt is None:
            doubt = ties(self.meaning, (), np.zeros(0), obs, self.eps)
        told = np.asarray(is_answered(jnp.asarray(answer)), np.float32) * np.isfinite(answer)
        new = Answers(obs, action, answer, told, np.asarray(doubt, np.float32))
        old = self.answers
        self.answers = new if old is None else Answers._make(map(np.concatenate, zip(old, new, strict=True)))
        self._compare()

    def confirmations(self, obs: Float[Given, "n obs"], count: int) -> Questions:
        """Return questions about actions halfway between the policy and the corrected one, where these differ.

        The policy is corrected by the most likely changes, however little evidence there is. An answer tells which of
        both is nearer to what the teacher means, whatever else is wrong with the policy. Give situations that were not
        asked about before.
        """
        obs = np.asarray(obs, np.float32)
        if (fit := self._candidate()) is None:
            return self.questions(obs, count)
        before, offset = self._correction(fit, obs)
        apart = np.abs(offset).max(-1) / self.eps
        differs = np.where(apart <= MOVED[1], np.minimum(apart, MOVED[0]), 0) + 1e-3 * self.random.random(len(obs))
        index = np.array([own[differs[own].argmax()] for own in np.array_split(np.arange(len(obs)), count)])
        action = self.meaning.moved(before[index], offset[None, index] / 2)[0]
        return Questions(index, action, ties(self.meaning, (), np.zeros(0), obs[index], self.eps), np.zeros(count))

    def confirm(
        self,
        obs: Float[Given, "n obs"],
        action: Float[Given, "n action"],
        answer: Float[Given, "n cues"],
        doubt: Float[Given, " n"] | None = None,
    ) -> None:
        """Count the answers to `confirmations` that are for the corrected policy, then learn from them too.

        The paired counts of a sign test (Dixon and Mood, 1946), out of sample: the answers have not been learned.
        Without enough answers for the corrected policy, `result` refuses the changes.
        """
        if (fit := self._candidate()) is not None:
            self.confirmed = 0, 0
            if len(obs):
                said = np.where(np.asarray(is_answered(jnp.asarray(answer))) & np.isfinite(answer), answer, 0)
                toward = (said * self._correction(fit, np.asarray(obs, np.float32))[1]).sum(-1)
                self.confirmed = int((toward > 0).sum()), int((toward < 0).sum())
        self.learn(obs, action, answer, doubt)

    @property
    def is_far(self) -> bool:
        """Whether teacher and corrected policy still differ so widely that answers should confirm a change.

        The model of answers is then wrong, and its evidence too certain.
        """
        fit = self._candidate()
        return fit is not None and bool((fit.nuisance @ GRID)[1] > FAR)

    def _candidate(self) -> Fit | None:
        """Return the most likely fit that corrects the policy."""
        fits = [self.fits[names] for names in self._current() if self.fits[names].corrects]
        return max(fits, key=self._score, default=None)

    def _correction(self, fit: Fit, obs: Floats) -> tuple[Floats, Floats]:
        """Return the actions that the teacher would call right without changes, and the vectors to those with them."""
        theta = fit.interval()[0]
        of_teacher = np.concatenate([np.full(len(one.unknowns), one.of_teacher) for one in fit.family])
        thetas = np.stack([np.where(of_teacher, theta, 0), theta])
        right = self.meaning.right(fit.family, thetas, self.meaning.actions(fit.asks, thetas[:, : fit.changes], obs))
        return right[0], self.meaning.offsets((), np.zeros((1, 0)), right[1:], right[0])[0]

    def _scaled(self, obs: Floats) -> None:
        self.scales = self.scales or scales_of(self.meaning, self.family, obs, self.eps)
        if not self.ready:
            asks = tuple(one for one in self.family if one.asks)
            self.ready = [Responses(self.meaning, asks, self.scales, self.eps)]

    @property
    def responses(self) -> Responses:
        """The policy's responses at nodes, from the first situations on."""
        return self.ready[0]

    def _singles(self) -> list[tuple[str, ...]]:
        return [(one.name,) for one in self.family]

    def _new(self, names: tuple[str, ...]) -> Fit:
        family = tuple(one for one in self.family if one.name in names)
        number = sum(1 << place for place, one in enumerate(self.family) if one.name in names)
        return Fit(family, self.scales, self.responses, self.seed * 1000 + number)

    def _fit(self, names: tuple[str, ...]) -> Fit:
        """Return the fit of a set of changes to all answers so far."""
        assert self.answers is not None
        rounds = 1 if names in self.fits else ROUNDS
        fit = self.fits.setdefault(names, self._new(names))
        fit.learn(self.answers, self.response, rounds)
        return fit

    def _compare(self) -> None:
        """Fit no change, each single change, and the best single change with each other one."""
        assert self.answers is not None
        if self.fits:
            fits = list(self.fits.values())
            draws = draw_hypotheses(fits, self._odds(fits), self.random)
            places = np.concatenate([fit.places(thetas) for fit, thetas in draws])
            self.responses.add_nodes(places, FRESH, self.random)
        self.response = self.responses.respond(self.answers.obs)
        self._fit(())
        for names in self._singles():
            self._fit(names)
        path: list[tuple[str, ...]] = [()]
        for size in range(1, 1 + (min(LARGEST, len(self.family)) if self.asked >= LEAST else 1)):
            wider = [self._named({*path[-1], one.name}) for one in self.family if one.name not in path[-1]]
            scores = [self._score(self._fit(names) if size > 1 else self.fits[names]) for names in wider]
            path.append(wider[int(np.argmax(scores))])
            if size > 1 and self._score(self.fits[path[-1]]) <= self._score(self.fits[path[-2]]):
                break
        self._choose(max(path, key=lambda names: self._score(self.fits[names])))

    def _settle(self) -> None:
        """Choose again among the sets that differ from the chosen one by one change, with enough samples each."""
        near = {self._named({one.name} ^ set(self.chosen)) for one in self.family} | {self.chosen}
        current = self._current()
        for names in near & set(current):
            self.fits[names].refine(SETTLED * (1 + self.fits[names].unknowns), SETTLING)
        self._choose(max(current, key=lambda names: self._score(self.fits[names])))

    def _current(self) -> list[tuple[str, ...]]:
        """Return the sets of changes that were fitted to all answers."""
        return [names for names, fit in self.fits.items() if fit.answers is self.answers]

    def _choose(self, best: tuple[str, ...]) -> None:
        gain = self._score(self.fits[best]) - self._score(self.fits[()])
        self.chosen = best if gain > (SURE if _explains(self.fits[best]) else LOOSE) - DOUBT else ()

    def _named(self, names: set[str]) -> tuple[str, ...]:
        """Return names in the order of the family."""
        return tuple(one.name for one in self.family if one.name in names)

    def _score(self, fit: Fit) -> float:
        return fit.evidence - DOUBT * len(fit.family)

    def _odds(self, fits: list[Fit]) -> Floats:
        """Return the log odds of the fits with the most answers; before the first answer all odds are equal."""
        known = [0 if fit.answers is None else len(fit.answers.obs) for fit in fits]
        if not max(known):
            return np.zeros(len(fits))
        return np.array([self._score(fit) if n == max(known) else -np.inf for fit, n in zip(fits, known, strict=True)])

    @property
    def best(self) -> Fit | None:
        """The fit of the chosen changes; None before the first answer."""
        return self.fits[self.chosen] if self.asked else None

    def policy(self) -> Any:
        """The policy corrected by the most likely changes so far."""
        best = self.best
        if best is None or not best.corrects:
            return self.base
        return Calibrated(self.base, jnp.asarray(best.interval()[0], jnp.float32), best.family)

    def result(self) -> Result:
        """Return the result of all answers. Raises UserError for too few answers."""
        if self.asked < HELD_OUT:
            raise UserError(f"{self.asked} answers are too few for calibration: give at least {HELD_OUT}")
        self._settle()
        best, none = self.fits[self.chosen], self.fits[()]
        before, after = none.predict_held_out(), best.predict_held_out()
        gain = after - before
        holds = bool(best.family) and gain.mean() > 0
        refused: tuple[str, ...] = ()
        confirmed = self.confirmed
        if holds and confirmed and confirmed[0] <= AGREE * confirmed[1]:
            refused = tuple(one.name for one in best.family if not one.of_teacher)
            holds = not refused
        if not holds:
            self.chosen, best, after = (), none, before
        rho, width = (best.nuisance @ GRID)[:2]
        corrected = [one.name for one in best.family if not one.of_teacher]
        explained = best.family or (_explains(best) and not refused)
        verdict = CHANGED if corrected else (UNCHANGED if explained else UNEXPLAINED)
        evidence = {names: self.fits[names].evidence - none.evidence for names in self._current()}
        apart = float(self.space.to_unit(width * self.eps * np.log(3), np))
        more = self._more(best) if corrected else None
        estimates = tuple(estimate for one in self.family for estimate in self._estimates(one))
        held = (float(before.mean()), float(after.mean()))
        judged = evidence, held, confirmed, refused
        return Result(verdict, tuple(corrected), estimates, *judged, float(rho), apart, more, self.policy())

    def _estimates(self, distortion: Distortion) -> list[Estimate]:
        names = self._named({*self.chosen, distortion.name})
        fit = self.fits[names if names in self._current() else (distortion.name,)]
        rows = zip(unknowns_of(fit.family), *fit.interval(), strict=True)
        changed = distortion.name in self.chosen
        own = [one.name for one in distortion.unknowns]
        return [
            Estimate(one.name, one.unit, float(mean), float(low), float(high), changed)
            for one, mean, low, high in rows
            if one.name in own
        ]

    def _more(self, fit: Fit) -> int:
        """Return the number of labels until corrected actions are known within eps / 2."""
        weight = fit.weight[:, None, None]
        offset = np.clip(fit.offset, -20, 20)
        spread = np.sqrt((weight * np.square(offset - (weight * offset).sum(0))).sum(0))
        ratio = float(np.median(spread)) / 0.5
        return max(0, int(np.ceil(self.asked * (ratio**2 - 1))))


def _explains(fit: Fit) -> bool:
    """Return whether most answers are about the fit's actions, and near them."""
    rho, width = (fit.nuisance @ GRID)[:2]
    return bool(rho <= MOSTLY and width <= APART)


Situations = Callable[[PRNGKeyArray, Any, int], tuple[Any, Any]]  # (key, policy, count) -> states, observations
Asked = Callable[[PRNGKeyArray, Any, Any, Any], Any]  # (key, states, observations, actions) -> answers (n, cues)


def calibrate(
    policy: Any,
    family: Sequence[Distortion],
    situations: Situations,
    teacher: Asked,
    labels: int,
    key: PRNGKeyArray,
    *,
    space: Space,
    eps_deg: float,
) -> Result:
    """Ask a teacher in batches and estimate the changes. No reward is used.

    Held-out answers judge. Where teacher and policy differ widely, the last fifth of the labels asks whether the
    corrected policy is nearer to what the teacher means: model-free, so that it holds where no change of the family
    describes the answers.

    Args:
        policy: a policy, or any function of a batch of observations.
        family: the possible changes.
        situations: gives states and observations (count, obs) that a policy meets.
        teacher: gives answers (n, cues), -1, 0, 1 or `UNSAID`; NaN where it did not answer.
        labels: number of questions.
        key: key of all random numbers.
        space: space of the actions.
        eps_deg: strength of an answer, in the space's unit.

    Raises:
        UserError: settings that make no sense, or too few labels.
    """
    k_seed, key = jax.random.split(key)
    calibration = Calibration(policy, family, space, eps_deg, int(jax.random.randint(k_seed, (), 0, 1 << 20)))
    left, last = labels, labels // CONFIRMING
    while left:
        k_where, k_answer, key = jax.random.split(key, 3)
        confirms = left == last and calibration.is_far
        count = last if confirms else min(BATCH, left - last if left > last else left)
        ask, learn, met = calibration.questions, calibration.learn, CHOICE * count
        if confirms:  # another number of situations makes a `Walk` start new environments
            ask, learn, met = calibration.confirmations, calibration.confirm, max(MET, CHOICE * count)
        states, obs = situations(k_where, calibration.policy(), met)
        asked = ask(np.asarray(obs), count)
        states = jax.tree.map(lambda leaf, index=asked.index: leaf[index], states)
        obs = np.asarray(obs)[asked.index]
        answers = np.asarray(teacher(k_answer, states, jnp.asarray(obs), jnp.asarray(asked.action)))
        there = np.isfinite(answers).any(-1)
        learn(obs[there], asked.action[there], answers[there], asked.doubt[there])
        left -= count
    return calibration.result()
