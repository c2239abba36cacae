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

from collections.abc import Sequence
from copy import copy
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from cuelearner_jax.calibration import confirmation
from cuelearner_jax.calibration.families import Distortion, check_family, unknowns_of
from cuelearner_jax.calibration.meaning import Meaning
from cuelearner_jax.calibration.policy import Calibrated
from cuelearner_jax.calibration.posterior import HELD_OUT, Answers, Fit
from cuelearner_jax.calibration.questions import Questions, choose, draw_hypotheses, ties
from cuelearner_jax.calibration.response import Responses
from cuelearner_jax.calibration.result import CHANGED, UNCHANGED, UNEXPLAINED, Estimate, Result
from cuelearner_jax.calibration.scales import scales_of
from cuelearner_jax.errors import UserError
from cuelearner_jax.policies import in_space, policy_of
from cuelearner_jax.spaces import Space, is_answered

Floats = np.ndarray
Given = Array | np.ndarray  # accepted arrays
BATCH = 10  # questions between two fits
LOOKS = 6  # nodes at which the policy is asked in each situation to choose from
FRESH = 3  # nodes after each batch
ROUNDS = 4  # rounds of samples for a set without samples
LEAST = 20  # answers before two changes at once are considered
DOUBT = 2.0  # least evidence for each change [nats]
SURE = 3.0  # least evidence for all changes, against no change [nats]
LOOSE = 5.0  # least evidence where answers differ much from the corrected policy [nats]
LARGEST = 3  # most changes at once
SETTLED, SETTLING = 10.0, 12  # effective samples for each unknown and one in the end; most rounds for these
MOSTLY = 0.75  # share of answers about something else, above which the verdict is UNEXPLAINED
APART = 2.5  # [eps]: larger typical distance between teacher and policy gives the verdict UNEXPLAINED


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
        """Return questions whose answers tell whether the corrected policy is nearer to what the teacher means.

        The policy is corrected by the most likely changes, however little evidence there is. Give situations that were
        not asked about before.
        """
        obs = np.asarray(obs, np.float32)
        if (fit := self._candidate()) is None:
            return self.questions(obs, count)
        chosen = confirmation.halfway(self.meaning, fit, obs, count, self.eps, self.random)
        return chosen._replace(doubt=ties(self.meaning, (), np.zeros(0), obs[chosen.index], self.eps))

    def confirm(
        self,
        obs: Float[Given, "n obs"],
        action: Float[Given, "n action"],
        answer: Float[Given, "n cues"],
        doubt: Float[Given, " n"] | None = None,
    ) -> None:
        """Count the answers to `confirmations` that are for the corrected policy, then learn from them too.

        Without enough answers for the corrected policy, `result` refuses the changes.
        """
        if (fit := self._candidate()) is not None:
            obs, action = (np.asarray(rows, np.float32) for rows in (obs, action))
            self.confirmed = confirmation.counts(self.meaning, fit, obs, action, answer)
        self.learn(obs, action, answer, doubt)

    def cross_confirm(self) -> None:
        """Confirm by the answers so far, where none was asked for that: a file's, or those of the labelling page.

        Each fifth of the answers, in their order, is counted for or against changes that are fitted to the others. As
        `confirm`, without asking: fewer answers count, since few are about actions between both policies.
        """
        assert self.answers is not None
        rows, found = np.arange(self.asked), np.zeros(2, int)
        for judging in np.array_split(rows, confirmation.EVERY):
            other = self.copy(np.random.default_rng(self.seed))
            other.answers, other.fits = None, {}
            other.learn(*(part[np.delete(rows, judging)] for part in (*self.answers[:3], self.answers.doubt)))
            if (fit := other._candidate()) is not None:
                found += confirmation.counts(self.meaning, fit, *(part[judging] for part in self.answers[:3]))
        self.confirmed = int(found[0]), int(found[1])

    @property
    def is_far(self) -> bool:
        """Whether teacher and corrected policy still differ so widely that answers should confirm a change."""
        fit = self._candidate()
        return fit is not None and confirmation.is_far(fit)

    def _candidate(self) -> Fit | None:
        """Return the most likely fit that corrects the policy."""
        fits = [self.fits[names] for names in self._current() if self.fits[names].corrects]
        return max(fits, key=self._score, default=None)

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
        if holds and confirmed and confirmation.refuses(confirmed):
            refused = tuple(one.name for one in best.family if not one.of_teacher)
            holds = not refused
        if not holds:
            self.chosen, best, after = (), none, before
        rho, width = best.noise
        corrected = [one.name for one in best.family if not one.of_teacher]
        explained = best.family or (_explains(best) and not refused)
        verdict = CHANGED if corrected else (UNCHANGED if explained else UNEXPLAINED)
        evidence = {names: self.fits[names].evidence - none.evidence for names in self._current()}
        apart = float(self.space.to_unit(width * self.eps * np.log(3), np))
        more = self._more(best) if corrected else None
        estimates = tuple(estimate for one in self.family for estimate in self._estimates(one))
        held = (float(before.mean()), float(after.mean()))
        judged = evidence, held, confirmed, refused
        return Result(verdict, tuple(corrected), estimates, *judged, rho, apart, more, self.policy())

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
    rho, width = fit.noise
    return rho <= MOSTLY and width <= APART
