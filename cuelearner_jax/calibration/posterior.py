"""The posterior of a family's unknowns: weighted samples, by adaptive importance sampling (AMIS).

The policy is a black box and jumps from one action to another as the unknowns change, so nothing is differentiated.
Samples of earlier rounds stay, weighted by the mixture of all proposals (Cornuet et al., 2012); new answers only change
their likelihood. The mean weight is the family's evidence, by which families are compared.
"""

from __future__ import annotations

from itertools import product
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Float
from scipy.special import gammaln, logsumexp, stdtrit

from cuelearner_jax.calibration.families import Family, unknowns_of
from cuelearner_jax.calibration.likelihood import GRID, LOG_PRIOR, log_chance, log_chances
from cuelearner_jax.calibration.meaning import in_portions
from cuelearner_jax.calibration.response import Response, Responses

Floats = np.ndarray
PRIOR_FREEDOM, KERNEL_FREEDOM = 5, 5  # degrees of freedom of Student's t, whose heavy tails allow for large changes
SAMPLES = 96  # samples of a round for each unknown
PORTION = 32  # samples weighed in one call
ENOUGH, MORE = 6.0, 4  # least effective samples for each unknown and one; most extra rounds for these
ANEW = 0.15  # share of a round's samples drawn from the prior
# rounds from the prior and from a prior with scales smaller by this factor; these rounds are kept
FIRST, CLOSER = 2, 0.1
KEPT = 4  # later rounds that are kept
HELD_OUT = 5  # every fifth answer is held out in turn


class Answers(NamedTuple):
    """Relative answers as evidence, one row each."""

    obs: Float[Floats, "n obs"]
    action: Float[Floats, "n action"]  # asked about
    answer: Float[Floats, "n cues"]  # -1, 0 or 1
    told: Float[Floats, "n cues"]  # 1 where the answer says something of a cue, else 0
    doubt: Float[Floats, " n"]  # probability that the situation is one of a tie, see `questions.ties`


def log_student(x: Float[Floats, "*n unknowns"], freedom: float) -> Float[Floats, "*n"]:
    """Return the logarithm of the joint density of independent Student's t: one logarithm a row, which is the cost."""
    norm = gammaln((freedom + 1) / 2) - gammaln(freedom / 2) - 0.5 * np.log(freedom * np.pi)
    return x.shape[-1] * norm - (freedom + 1) / 2 * np.log(np.prod(1 + np.square(x) / freedom, -1))


class Prior(NamedTuple):
    """Student's t with each unknown's scale, truncated to the possible sizes."""

    scale: Float[Floats, " unknowns"]
    most: Float[Floats, " unknowns"]

    def draw(self, random: np.random.Generator, count: int) -> Floats:
        """Return samples (count, unknowns), evenly spread."""
        if not len(self.scale):
            return np.zeros((count, 0))
        # imported here, since SciPy's module takes seconds to load and a stored policy does not need it
        from scipy.stats import qmc

        even = qmc.Halton(len(self.scale), rng=random).random(count)
        return stdtrit(PRIOR_FREEDOM, np.clip(even, 1e-4, 1 - 1e-4)) * self.scale

    def log_density(self, theta: Floats) -> Floats:
        """Return the logarithm of the density of rows (n,)."""
        return log_student(theta / self.scale, PRIOR_FREEDOM) - np.log(self.scale).sum()

    def closer(self) -> Prior:
        """Return the prior with much smaller scales."""
        return self._replace(scale=self.scale * CLOSER)

    def allows(self, theta: Floats) -> Floats:
        """Return which rows (n,) are possible."""
        return np.asarray((np.abs(theta) <= self.most).all(-1))


class Kernels(NamedTuple):
    """A mixture of Student's t around centres, with one shape, and a share of the prior: no region is excluded."""

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
        each = log_student(away, KERNEL_FREEDOM) + np.log(np.abs(np.diag(inverse))).sum()
        near = logsumexp(each, axis=1) - np.log(len(self.centres))
        return np.logaddexp(np.log1p(-ANEW) + near, np.log(ANEW) + self.prior.log_density(theta))


class Round(NamedTuple):
    """The samples of one round, their proposal, and their likelihoods."""

    number: int
    proposal: Kernels | Prior
    theta: Float[Floats, "samples unknowns"]
    offset: Float[Floats, "samples n cues"]  # from asked actions to the ones that the teacher would call right [eps]
    log_likelihood: Float[Floats, "samples grid"]  # including the prior of the grid


class Fit:
    """Weighted samples of the posterior of a family's unknowns.

    Args:
        family: the possible changes; empty: no change.
        scales: prior scales of the unknowns, in their units.
        responses: the policy.
        seed: seed of the samples.
    """

    def __init__(self, family: Family, scales: dict[str, float], responses: Responses, seed: int) -> None:
        self.asks = tuple(one for one in family if one.asks)
        self.family = (*self.asks, *(one for one in family if not one.asks))
        self.responses, self.random = responses, np.random.default_rng(seed)
        self.changes = len(unknowns_of(self.asks))  # number of unknowns that change the observation; they come first
        self.columns = [responses.names.index(one.name) for one in unknowns_of(self.asks)]
        self.prior = _prior(self.family, scales)
        self.rounds: list[Round] = []
        self.count = 0  # of the rounds so far
        # log densities of a round's samples, under a round's proposal
        self.densities: dict[tuple[int, int], Floats] = {}
        self.answers: Answers | None = None

    @property
    def unknowns(self) -> int:
        """Number of unknowns."""
        return len(unknowns_of(self.family))

    @property
    def corrects(self) -> bool:
        """Return whether a change of the family is corrected."""
        return any(not one.of_teacher for one in self.family)

    def learn(self, answers: Answers, response: Response, rounds: int = 1) -> None:
        """Take all answers so far and the policy's responses in their situations; add rounds of samples."""
        self.answers, self.response = answers, response
        self.rounds = [self._round(*one[:3]) for one in self.rounds]
        if self.rounds:
            self._weigh()
        for _ in range(max(rounds if self.unknowns else 0, 1 - len(self.rounds))):
            self._add()
        self.refine(ENOUGH * (1 + self.unknowns), MORE)

    def refine(self, enough: float, most: int) -> None:
        """Add rounds of samples until enough are effective, up to a largest number."""
        for _ in range(most if self.unknowns else 0):
            if self.effective >= enough:
                return
            self._add()

    def draw(self, random: np.random.Generator, count: int) -> Float[Floats, "count unknowns"]:
        """Return samples of the posterior; before the first answer, of the prior."""
        if self.answers is None:
            return random.permutation(self.prior.draw(random, count))
        return self.theta[random.choice(len(self.theta), count, p=self.weight)]

    def places(self, theta: Float[Floats, "n unknowns"]) -> Float[Floats, "n all"]:
        """Return the samples' coordinates among the nodes of `responses`."""
        found = np.zeros((len(theta), len(self.responses.names)))
        found[:, self.columns] = theta[:, : self.changes] / self.responses.scale[self.columns]
        return found

    def right(self, theta: Floats, response: Response) -> tuple[Floats, Floats]:
        """Return the actions (samples, n, action) that the teacher would call right, and their spread [eps]."""
        meaning, (mean, spread) = self.responses.meaning, response.at(self.places(theta))
        meant = meaning.moved(response.centre, mean * self.responses.eps)
        return meaning.right(self.family, theta, meant), spread

    def _offsets(self, theta: Floats) -> tuple[Floats, Floats]:
        """Return mean and spread of the vectors from asked actions to the right ones [eps]."""
        assert self.answers is not None
        right, spread = self.right(theta, self.response)
        none = np.zeros((len(theta), 0))
        return self.responses.meaning.offsets((), none, right, self.answers.action) / self.responses.eps, spread

    def _round(self, number: int, proposal: Kernels | Prior, theta: Floats) -> Round:
        offset, spread = self._offsets(theta)
        return Round(number, proposal, theta, offset, self._log_each(offset, spread, summed=True))

    def _add(self) -> None:
        proposal = self._proposal()
        self.count += 1
        drawn = self._round(self.count, proposal, proposal.draw(self.random, SAMPLES * self.unknowns or 1))
        self.rounds = [*self.rounds[:FIRST], *self.rounds[FIRST:][1 - KEPT :], drawn]
        self._weigh()

    def _proposal(self) -> Kernels | Prior:
        """Return the next proposal: first the prior, then near no change, then near the posterior so far."""
        if len(self.rounds) < FIRST or not self.unknowns:
            return self.prior if not self.rounds else self.prior.closer()
        enough = min(0.25 * len(self.log_weight), ENOUGH * (1 + self.unknowns))
        # While few samples carry all the weight, the next proposal is centred on the best ones. By density alone
        # kernels narrow with each round, as most samples lie where they were; by weight alone they follow far samples.
        weight = self.weight
        if self.effective < enough:
            weight = temper((self.log_weight + self.log_density) / 2, enough)
        size = self.unknowns
        centres = self.theta[self.random.choice(len(self.theta), 32, p=weight)]
        away = self.theta - weight @ self.theta
        width = (1 / np.square(weight).sum()) ** (-1 / (size + 4))
        spread = (away * weight[:, None]).T @ away * width**2 + np.diag(np.square(1e-3 * self.prior.scale))
        return Kernels(centres, np.linalg.cholesky(spread), self.prior)

    def _weigh(self) -> None:
        """Compute the weights of all samples under all answers."""
        self.theta, self.offset, self.log_likelihood = map(np.concatenate, list(zip(*self.rounds, strict=True))[2:])
        prior, drawn = self._log_densities()
        self.log_origin = prior - drawn
        self.log_density = logsumexp(self.log_likelihood, axis=1) + prior
        self.log_weight = self.log_density - drawn

    def _log_each(self, offset: Floats, spread: Floats, summed: bool) -> Floats:
        """Return log probabilities of each answer (samples, n, grid), or of all answers with the grid's prior."""
        assert self.answers is not None
        count = offset.shape[1]
        step = 1 << max(6, (count - 1).bit_length() - 2)  # few sizes, so that few programs are compiled
        size = -(-count // step) * step
        answer, told, doubt = (
            np.pad(np.asarray(rows, np.float32), [(0, size - count)] + [(0, 0)] * (rows.ndim - 1))
            for rows in self.answers[2:]
        )
        padded = [np.pad(part, ((0, 0), (0, size - count), (0, 0))) for part in (offset, spread)]
        program = _summed if summed else _each
        found = in_portions(lambda *rows: program(*rows, answer, told, doubt), PORTION, *padded)
        return found + LOG_PRIOR if summed else found[:, :count]

    def _log_densities(self) -> tuple[Floats, Floats]:
        """Return each sample's log density: under the prior, and under the mixture of all proposals."""
        if not self.unknowns:
            return np.zeros(len(self.theta)), np.zeros(len(self.theta))
        counts, known = np.array([len(one.theta) for one in self.rounds]), {}
        for one, other in product(self.rounds, repeat=2):  # few pairs are new, and these densities are expensive
            key = one.number, other.number
            known[key] = self.densities[key] if key in self.densities else one.proposal.log_density(other.theta)
        self.densities = known
        drawn = np.concatenate(list(known.values())).reshape(len(counts), -1)
        drawn += np.log(counts / counts.sum())[:, None]
        prior = np.where(self.prior.allows(self.theta), self.prior.log_density(self.theta), -np.inf)
        return prior, logsumexp(drawn, axis=0)

    @property
    def evidence(self) -> float:
        """Log probability of all answers, if this family is what changed."""
        return float(logsumexp(self.log_weight) - np.log(len(self.log_weight)))

    @property
    def weight(self) -> Float[Floats, " samples"]:
        """Posterior weights of the samples; they add up to one."""
        return np.exp(self.log_weight - logsumexp(self.log_weight))

    @property
    def effective(self) -> float:
        """Effective number of samples."""
        return float(1 / np.square(self.weight).sum())

    @property
    def nuisance(self) -> Float[Floats, " grid"]:
        """Posterior of the grid of `likelihood`; before the first answer, its prior."""
        if self.answers is None:
            return np.exp(LOG_PRIOR)
        joint = self.log_likelihood + self.log_origin[:, None]
        return np.exp(logsumexp(joint, axis=0) - logsumexp(joint))

    @property
    def noise(self) -> tuple[float, float]:
        """Share of answers about something else, and typical distance between teacher and policy [eps]; both means."""
        rho, width = (self.nuisance @ GRID)[:2]
        return float(rho), float(width)

    def predict_held_out(self) -> Float[Floats, " n"]:
        """Return the log probability of each answer, given the other four fifths of the answers."""
        log_each = self._log_each(*self._offsets(self.theta), summed=False)
        count = log_each.shape[1]
        found = np.zeros(count)
        joint = self.log_likelihood + self.log_origin[:, None]
        for fold in range(min(HELD_OUT, count)):
            held = np.arange(fold, count, HELD_OUT)
            rest = joint - log_each[:, held].sum(1, dtype=np.float64)
            rest = rest - logsumexp(rest)
            found[held] = [logsumexp(rest + log_each[:, label]) for label in held]
        return found

    def interval(self, share: float = 0.95) -> tuple[Floats, Floats, Floats]:
        """Return posterior mean, lower and upper end (unknowns,) of each unknown."""
        weight = self.weight
        ends = [[_quantile(column, weight, 0.5 + side * share / 2) for column in self.theta.T] for side in (-1, 1)]
        return weight @ self.theta, np.array(ends[0]), np.array(ends[1])


def _prior(family: Family, scales: dict[str, float]) -> Prior:
    unknowns = unknowns_of(family)
    return Prior(np.array([scales[one.name] for one in unknowns]), np.array([one.most for one in unknowns]))


@jax.jit
def _each(*rows: Any) -> Any:
    return log_chances(*rows)


@jax.jit
def _summed(*rows: Any) -> Any:
    return log_chance(*rows)


def temper(log_weight: Floats, enough: float) -> Floats:
    """Return weights that add up to one, flattened until so many samples are effective."""
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
