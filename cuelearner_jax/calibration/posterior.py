"""What answers tell about a family's unknowns: weighted samples, by adaptive importance sampling (AMIS).

The policy is a black box and jumps from one action to another as the unknowns change, so nothing is differentiated.
Samples of earlier rounds stay, weighted by the mixture of all proposals (Cornuet et al., 2012); new answers only change
their likelihood. The mean weight is the family's evidence, by which families are compared.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.special import logsumexp
from scipy.stats import qmc, t

from cuelearner_jax.calibration.families import Family, unknowns_of
from cuelearner_jax.calibration.likelihood import GRID, LOG_PRIOR, log_chances
from cuelearner_jax.calibration.meaning import CHEAP, Meaning, in_portions

Floats = np.ndarray
PRIOR_FREEDOM, KERNEL_FREEDOM = 5, 5  # of Student's t: changes may be larger than thought
SEEING = 24  # samples of a round for each unknown that changes what is seen; the policy is asked about each
ACTING = 16  # samples of the other unknowns with each of them; the policy is not asked again
ALONE = 256  # samples of a round where no unknown changes what is seen
ENOUGH, MORE = 6.0, 4  # samples that must count, for each unknown and one; rounds that are added for these at most
ANEW = 0.15  # share of the samples of a round that are drawn from the prior again
FIRST, CLOSER = 2, 0.1  # rounds of the prior, and of one with so much smaller changes: they stay
KEPT = 4  # later rounds that stay
HELD_OUT = 5  # every fifth answer is held out in turn


class Answers(NamedTuple):
    """Relative answers as evidence; rows."""

    obs: Float[Floats, "n obs"]
    action: Float[Floats, "n action"]  # asked about
    answer: Float[Floats, "n cues"]  # -1, 0 or 1
    told: Float[Floats, "n cues"]  # 1 where something was said of a cue, else 0
    doubt: Float[Floats, " n"]  # probability that the situation is one of a tie, see `questions.ties`


class Prior(NamedTuple):
    """Student's t of each unknown's scale; what makes sense is a part of it."""

    scale: Float[Floats, " unknowns"]
    most: Float[Floats, " unknowns"]

    def draw(self, random: np.random.Generator, count: int) -> Floats:
        """Return samples (count, unknowns), evenly spread."""
        if not len(self.scale):
            return np.zeros((count, 0))
        even = qmc.Halton(len(self.scale), rng=random).random(count)
        return t.ppf(np.clip(even, 1e-4, 1 - 1e-4), PRIOR_FREEDOM) * self.scale

    def log_density(self, theta: Floats) -> Floats:
        """Return the logarithm of the density of rows (n,)."""
        return t.logpdf(theta / self.scale, PRIOR_FREEDOM).sum(-1) - np.log(self.scale).sum()

    def closer(self) -> Prior:
        """Return the same of changes that are much smaller."""
        return self._replace(scale=self.scale * CLOSER)

    def allows(self, theta: Floats) -> Floats:
        """Return which rows (n,) make sense."""
        return np.asarray((np.abs(theta) <= self.most).all(-1))


class Kernels(NamedTuple):
    """A mixture of Student's t round centres, with one shape, and a share of the prior: nothing is ever given up."""

    centres: Float[Floats, "kernels unknowns"]
    shape: Float[Floats, "unknowns unknowns"]  # lower triangle
    prior: Prior

    def draw(self, random: np.random.Generator, count: int) -> Floats:
        """Return samples (count, unknowns)."""
        size = self.centres.shape[1]
        noise = random.standard_t(KERNEL_FREEDOM, (count, size)) @ self.shape.T
        near = self.centres[random.integers(len(self.centres), size=count)] + noise
        return np.where(random.random((count, 1)) < ANEW, self.prior.draw(random, count), near)

    def log_density(self, theta: Floats) -> Floats:
        """Return the logarithm of the density of rows (n,)."""
        inverse = np.linalg.inv(self.shape)
        away = (theta[:, None] - self.centres[None]) @ inverse.T
        each = t.logpdf(away, KERNEL_FREEDOM).sum(-1) + np.log(np.abs(np.diag(inverse))).sum()
        near = logsumexp(each, axis=1) - np.log(len(self.centres))
        return np.logaddexp(np.log1p(-ANEW) + near, np.log(ANEW) + self.prior.log_density(theta))


class Round(NamedTuple):
    """Samples of one round, and where they were drawn."""

    proposals: tuple[Kernels | Prior, Kernels | Prior]  # of what changes the observation, of the rest
    seeing: Float[Floats, "seeing unknowns"]
    acting: Float[Floats, "seeing acting unknowns"]
    meant: Float[Floats, "seeing labels action"]
    offset: Float[Floats, "samples labels cues"]  # from asked actions to those that the teacher would call right [eps]
    log_each: Float[Floats, "samples labels grid"]  # logarithm of each answer's probability

    def thetas(self) -> Floats:
        """Return all samples (seeing * acting, unknowns)."""
        wide = np.broadcast_to(self.seeing[:, None], (*self.acting.shape[:2], self.seeing.shape[1]))
        both = np.concatenate([wide, self.acting], -1)
        return both.reshape(both.shape[0] * both.shape[1], both.shape[2])


class Fit:
    """Samples of a family's unknowns, weighted by answers.

    Args:
        family: what may have changed; empty: nothing.
        scales: of its unknowns, in their units.
        meaning: the policy.
        eps: strength of an answer, as `space.log` counts.
        seed: of the samples.
    """

    def __init__(self, family: Family, scales: dict[str, float], meaning: Meaning, eps: float, seed: int) -> None:
        self.sees = tuple(one for one in family if one.sees is not None)
        self.rest = tuple(one for one in family if one.sees is None)
        self.family, self.meaning, self.eps = (*self.sees, *self.rest), meaning, eps
        self.random = np.random.default_rng(seed)
        self.changes = len(unknowns_of(self.sees))  # unknowns that change what is seen; they come first
        priors = [_prior(part, scales) for part in (self.sees, self.rest)]
        self.priors = (priors[0], priors[1])
        self.rounds: list[Round] = []
        self.answers: Answers | None = None
        self.asked_policy = 0  # rows that the policy was asked about

    @property
    def unknowns(self) -> int:
        """Number of unknowns."""
        return len(unknowns_of(self.family))

    def learn(self, answers: Answers, rounds: int = 1) -> None:
        """Take the answers so far, of which those known before come first, and add rounds of samples."""
        before = 0 if self.answers is None else len(self.answers.obs)
        self.answers = answers
        if len(answers.obs) > before:
            fresh = Answers(*(rows[before:] for rows in answers))
            self.rounds = [self._extended(one, fresh) for one in self.rounds]
        if self.rounds:
            self._weigh()
        for _ in range(max(rounds if self.unknowns else 0, 1 - len(self.rounds))):
            self._add(self._proposals())
            self._weigh()
        self.refine(ENOUGH * (1 + self.unknowns), MORE)

    def refine(self, enough: float, most: int) -> None:
        """Add rounds of samples until the weights leave enough of them, at most so many."""
        for _ in range(most if self.unknowns else 0):
            if self.effective >= enough:
                return
            self._add(self._proposals())
            self._weigh()

    def draw(self, random: np.random.Generator, count: int) -> Float[Floats, "count unknowns"]:
        """Return samples of the posterior; before the first answer, of the prior."""
        if self.answers is None:
            parts = [random.permutation(prior.draw(random, count)) for prior in self.priors]
            return np.concatenate(parts, -1)
        return self.theta[random.choice(len(self.theta), count, p=self.weight)]

    def _extended(self, one: Round, answers: Answers) -> Round:
        """A round with what its samples make of more answers."""
        self.asked_policy += len(one.seeing) * len(answers.obs)
        meant = self.meaning.actions(self.sees, one.seeing, answers.obs)
        thetas = one.thetas()
        every = np.repeat(meant, one.acting.shape[1], 0)
        offset = self.meaning.offsets(self.family, thetas, every, answers.action) / self.eps
        number, count, cues = offset.shape
        rows = [np.tile(part, (number, *[1] * (part.ndim - 1))) for part in answers[2:]]
        log_each = in_portions(log_chances, CHEAP, offset.reshape(-1, cues), *rows)
        log_each = log_each.reshape(number, count, -1)
        grown = zip(one[3:], (meant, offset, log_each), strict=True)
        return Round(*one[:3], *(np.concatenate(pair, 1) for pair in grown))

    def _add(self, proposals: tuple[Kernels | Prior, Kernels | Prior]) -> None:
        assert self.answers is not None
        changes, others = self.changes, self.unknowns - self.changes
        copies = (ACTING if changes else ALONE) if others else 1
        seeing = proposals[0].draw(self.random, SEEING * changes or 1)
        acting = self.random.permutation(proposals[1].draw(self.random, len(seeing) * copies))
        acting = acting.reshape(len(seeing), copies, others)
        empty = np.zeros((len(seeing), 0, self.meaning.space.size))
        samples, cues = len(seeing) * copies, len(self.meaning.space.cues)
        offset, log_each = np.zeros((samples, 0, cues)), np.zeros((samples, 0, len(GRID)), np.float32)
        drawn = Round(proposals, seeing, acting, empty, offset, log_each)
        self.rounds = [*self.rounds[:FIRST], *self.rounds[FIRST:][1 - KEPT :], self._extended(drawn, self.answers)]

    def _proposals(self) -> tuple[Kernels | Prior, Kernels | Prior]:
        """Where to draw next: the prior, then close to no change, then near what the answers so far leave likely."""
        if len(self.rounds) < FIRST:
            return self.priors if not self.rounds else (self.priors[0].closer(), self.priors[1].closer())
        enough = min(0.25 * len(self.log_weight), ENOUGH * (1 + self.unknowns))
        # As long as few samples have all of the weight, the best are where to look, however they were found.
        weight = self.weight if self.effective >= enough else tempered(self.log_density, enough)
        columns = (self.theta[:, : self.changes], self.theta[:, self.changes :])
        found = [self._kernels(theta, prior, weight) for theta, prior in zip(columns, self.priors, strict=True)]
        return found[0], found[1]

    def _kernels(self, theta: Floats, prior: Prior, weight: Floats) -> Kernels | Prior:
        size = theta.shape[1]
        if not size:
            return prior
        centres = theta[self.random.choice(len(theta), 32, p=weight)]
        away = theta - weight @ theta
        width = (1 / np.square(weight).sum()) ** (-1 / (size + 4))
        spread = (away * weight[:, None]).T @ away * width**2 + np.diag(np.square(1e-3 * prior.scale))
        return Kernels(centres, np.linalg.cholesky(spread), prior)

    def _weigh(self) -> None:
        """Weights of all samples under all answers."""
        assert self.answers is not None
        self.theta = np.concatenate([one.thetas() for one in self.rounds])
        self.offset = np.concatenate([one.offset for one in self.rounds])  # [eps]
        self.log_each = np.concatenate([one.log_each for one in self.rounds])
        self.log_likelihood = self.log_each.sum(1, dtype=np.float64) + LOG_PRIOR  # (samples, grid)
        prior, drawn = self._log_densities()
        self.log_origin = prior - drawn
        self.log_density = logsumexp(self.log_likelihood, axis=1) + prior
        self.log_weight = self.log_density - drawn

    def _log_densities(self) -> tuple[Floats, Floats]:
        """Logarithm of the density of each sample: under the prior, and in the mixture of all proposals."""
        columns = (self.theta[:, : self.changes], self.theta[:, self.changes :])
        counts = [one.acting.shape[0] * one.acting.shape[1] for one in self.rounds]
        if not self.unknowns:
            return np.zeros(len(self.theta)), np.zeros(len(self.theta))
        drawn = [
            sum(q.log_density(part) for q, part in zip(one.proposals, columns, strict=True) if part.shape[1])
            + np.log(count / sum(counts))
            for one, count in zip(self.rounds, counts, strict=True)
        ]
        prior = sum(p.log_density(part) for p, part in zip(self.priors, columns, strict=True) if part.shape[1])
        possible = [p.allows(part) for p, part in zip(self.priors, columns, strict=True)]
        return np.where(np.all(possible, axis=0), prior, -np.inf), logsumexp(np.array(drawn), axis=0)

    @property
    def evidence(self) -> float:
        """Logarithm of the probability of all answers, if this family is what changed."""
        return float(logsumexp(self.log_weight) - np.log(len(self.log_weight)))

    @property
    def weight(self) -> Float[Floats, " samples"]:
        """Posterior weights of the samples; they add up to one."""
        return np.exp(self.log_weight - logsumexp(self.log_weight))

    @property
    def effective(self) -> float:
        """Number of samples that the weights leave."""
        return float(1 / np.square(self.weight).sum())

    @property
    def nuisance(self) -> Float[Floats, " grid"]:
        """Posterior of the grid of `likelihood`; before the first answer, their prior."""
        if self.answers is None:
            return np.exp(LOG_PRIOR)
        joint = self.log_likelihood + self.log_origin[:, None]
        return np.exp(logsumexp(joint, axis=0) - logsumexp(joint))

    def predicted(self) -> Float[Floats, " n"]:
        """Return the logarithm of the probability of each answer, given those of the other four fifths."""
        count = self.log_each.shape[1]
        found = np.zeros(count)
        joint = self.log_likelihood + self.log_origin[:, None]
        for fold in range(min(HELD_OUT, count)):
            held = np.arange(fold, count, HELD_OUT)
            rest = joint - self.log_each[:, held].sum(1, dtype=np.float64)
            rest = rest - logsumexp(rest)
            found[held] = [logsumexp(rest + self.log_each[:, label]) for label in held]
        return found

    def interval(self, share: float = 0.95) -> tuple[Floats, Floats, Floats]:
        """Return mean, lower and upper end (unknowns,) of the posterior of each unknown."""
        weight = self.weight
        ends = [[_quantile(column, weight, 0.5 + side * share / 2) for column in self.theta.T] for side in (-1, 1)]
        return weight @ self.theta, np.array(ends[0]), np.array(ends[1])


def _prior(family: Family, scales: dict[str, float]) -> Prior:
    unknowns = unknowns_of(family)
    return Prior(np.array([scales[one.name] for one in unknowns]), np.array([one.most for one in unknowns]))


def tempered(log_weight: Floats, enough: float) -> Floats:
    """Return weights that add up to one, flattened until so many samples count."""
    low, high = 0.0, 1.0
    for step in range(24):
        power = 1.0 if step == 0 else (low + high) / 2
        weight = np.exp(power * (log_weight - log_weight.max()))
        weight /= weight.sum()
        if 1 / np.square(weight).sum() >= enough:
            low = power
            if step == 0:
                return weight
        else:
            high = power
    return weight


def _quantile(values: Floats, weight: Floats, share: float) -> float:
    order = np.argsort(values)
    return float(np.interp(share, np.cumsum(weight[order]) - weight[order] / 2, values[order]))
