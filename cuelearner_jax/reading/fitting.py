"""Fit hypotheses about what changed to answers, and choose among them.

Hypotheses are nested: nothing; the action shifted; shifted and mixed; what is seen as well; with entries of the
observation mixed; and the simplest and the best of these with a Gaussian process. Each is linearised at its own
estimate `ROUNDS` times. They are compared by how well each answer is predicted from all others.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Bool, Float

from cuelearner_jax.devices import each_lane
from cuelearner_jax.reading import linear, posterior
from cuelearner_jax.reading.families import Family
from cuelearner_jax.reading.likelihood import Habits, curvature, log_likelihood, predictive_log_likelihood
from cuelearner_jax.reading.linear import PARTS, SCALE, Acts, Change, ObservationFrame, RelativeLabels
from cuelearner_jax.reading.policy import Correction, corrected
from cuelearner_jax.reading.posterior import TAU, Data, Hyper, ModelParts, Posterior
from cuelearner_jax.spaces import Space
from cuelearner_jax.types import Actions, Number, Observations

ROUNDS = 3  # linearisations of each fit
TRUST = 1.0  # largest step of a weight at one linearisation, in standard deviations of its prior's middle
HYPOTHESES: tuple[tuple[str, ...], ...] = (
    (),
    ("shift",),
    ("shift", "gain"),
    ("seen", "shift"),
    ("seen", "shift", "gain"),
    ("seen", "mixed", "shift", "gain"),
)
ENTRIES = 3  # largest number of unknowns that a fit starts from
TRIED = (-8.0, -4.0, -2.0, -1.0, 1.0, 2.0, 4.0, 8.0)  # shifts of an unknown that are tried, in its steps
WITH_PROCESS = 2  # hypotheses that are tried with the process: the first and the best
WORTH = 3.0  # nats by which a hypothesis must predict better than "nothing changed": a factor of 20
# Logarithm of the width that a fit starts from: answers about actions far from the right one then still say which way
# it lies, where a narrow width would take them for answers about something else.
WIDE = 2.5
_NEVER = -30.0  # logarithm of an amplitude that is no process
PORTION = 2**24  # largest number of entries of the observations that the policy is asked about at once
THETA = Change(0, *3 * [None])  # pyright: ignore[reportArgumentType]  # axes of one estimate with several theta


class Hypothesis(struct.PyTreeNode):
    """Parts, estimate and hyperparameters of one hypothesis, from which the next fit starts."""

    parts: ModelParts
    change: Change
    hyper: Hyper


class Fit(struct.PyTreeNode):
    """A fitted hypothesis; stacked, all of them."""

    hypothesis: Hypothesis
    posterior: Posterior
    data: Data
    frame: ObservationFrame
    score: Float[Array, ""]  # sum over answers of log p(answer | all others) [nats]


@partial(jax.jit, static_argnums=(0, 1, 2))
def unfitted(space: Space, family: Family, obs_size: int) -> tuple[Hypothesis, Hypothesis]:
    """Return the hypotheses before any answer, stacked: those without the process, and those with it."""
    kinds = jnp.array(linear.groups(space, family, obs_size))
    cues, zero = len(space.cues), jnp.zeros(())
    hyper = Hyper(
        groups=jnp.zeros(len(PARTS)),
        sizes=jnp.zeros(len(kinds)),
        amplitude=jnp.zeros(cues),
        amplitudes=zero,
        length=zero,
        lengths=jnp.zeros(obs_size + space.size),
        tau=zero,
        width=jnp.float32(WIDE),
        lapse=zero,
        actions=space.size,
    )
    change = linear.no_change(space, family, obs_size)

    def one(names: tuple[str, ...], process: bool) -> Hypothesis:
        in_use = jnp.array([float(part in names) for part in PARTS])[kinds]
        return Hypothesis(ModelParts(in_use, process), change, hyper)

    stack = lambda each: jax.tree.map(lambda *leaves: jnp.stack(leaves), *each)  # noqa: E731
    return stack([one(names, False) for names in HYPOTHESES]), stack([one((), True)] * WITH_PROCESS)


@dataclass(frozen=True)
class Reader:
    """Reads labels about a policy."""

    space: Space  # of the actions, with cues
    family: Family  # what the world declares or the user names; empty: any entry of the observation may shift
    acts: Acts  # the policy, NaN where it has no action; plain Python, or traced with everything else
    eps: Number  # strength of an answer, in the unit of `space.log`
    # size of each unknown of the family that changes actions by a usual correction; None without a family
    step: Float[Array, " unknowns"] | None = None
    process: bool = True  # whether corrections may depend on the situation in ways that no parameter describes

    def read(self, labels: RelativeLabels, plain: Hypothesis, smooth: Hypothesis) -> Fit:
        """Return all hypotheses fitted to labels, stacked in the order of `HYPOTHESES`, those with the process last."""
        frame, steady = self._frame(labels)
        plain = self._start(frame, labels, plain)
        labels = labels._replace(valid=labels.valid & steady)
        first = self._fit(frame, labels, plain)
        return _together(first, self._fit(frame, labels, _first_and_best(first, smooth)) if self.process else None)

    def _ask(self, obs: Float[Array, "*k n obs"]) -> Float[Array, "*k n action"]:
        return self.acts(obs.reshape(-1, obs.shape[-1])).reshape(*obs.shape[:-1], -1)

    def _frame(self, labels: RelativeLabels) -> tuple[ObservationFrame, Bool[Array, " n"]]:
        """Return the units of the linear model, and the labels about which the policy answers steadily."""
        frame = linear.frame_of(self.family, labels, self.step)
        whole = self._probe(frame, _one(linear.no_change(self.space, self.family, labels.obs.shape[-1])), labels.obs)[0]
        if not self.family:
            frame = linear.frame_of((), labels, None, linear.influence(self.space, labels, whole))
        return frame, ~linear.jumps(self.space, whole, self.eps).any(-1)

    def _start(self, frame: ObservationFrame, labels: RelativeLabels, plain: Hypothesis) -> Hypothesis:
        """Return where fits start: where they were, or at shifts of few entries that explain the answers much better.

        Slopes lead to the nearest optimum alone, and near its goal a policy may turn by any angle. So shifts of one
        entry after another are tried on the policy itself.
        """
        change, worth = linear.no_change(self.space, self.family, labels.obs.shape[-1]), jnp.zeros(())
        for _ in range(ENTRIES):
            tried = _moves(self.family, frame, change)
            change, worth = _best(tried, self._worth(labels, tried))
        own = self._worth(labels, plain.change.replace(theta=plain.change.theta[:, None]))[:, 0]
        return plain.replace(change=_replace_worse(plain.change, own, change, worth))

    def _worth(self, labels: RelativeLabels, changes: Change) -> Float[Array, "h k"]:
        """Return the log likelihood of labels by stacked estimates, each with several theta, without the process."""
        before = _undone_each(self.family, changes, labels.obs)
        return _worth(self.space, self.family, changes, labels, before, self._ask(before), self.eps)

    def _fit(self, frame: ObservationFrame, labels: RelativeLabels, hypothesis: Hypothesis) -> Fit:
        own = self._ask(labels.obs)
        rows = self._data(frame, labels, own, hypothesis.change)
        posteriors = _unread(rows, hypothesis.hyper)
        for _ in range(ROUNDS):
            posteriors, hypothesis = _update(rows, frame, hypothesis, posteriors)
            rows = self._data(frame, labels, own, hypothesis.change)
        return _scored(rows, frame, hypothesis, posteriors)

    def _data(self, frame: ObservationFrame, labels: RelativeLabels, own: Array, change: Change) -> Data:
        """Return the linear models at stacked estimates; `own`: what the policy does about the observations."""
        whole = self._probe(frame, change, labels.obs)
        return _data(self.space, self.family, frame, change, labels, own, whole, self.eps)

    def _probe(self, frame: ObservationFrame, changes: Change, obs: Observations) -> Float[Array, "h k n action"]:
        """Return what actions at `linear.sides` of stacked estimates mean. The policy is asked in portions of sides."""
        sides, whole = _sides(frame, changes), []
        count = min(sides.shape[1], -(-sides.shape[0] * sides.shape[1] * obs.size // PORTION))
        for thetas in jnp.array_split(sides, count, 1):
            before = _undone_each(self.family, changes.replace(theta=thetas), obs)
            whole.append(_meant_each(self.family, thetas, before, self._ask(before)))
        return jnp.concatenate(whole, 1)

    def act(self, fitted: Fit, obs: Observations) -> Actions:
        """Return corrected actions by one fit."""
        before = linear.undone(self.family, fitted.hypothesis.change, obs)
        return _act(self.space, self.family, fitted, obs, before, self._ask(jnp.stack([obs, before])), self.eps)

    def predict(
        self, fitted: Fit, labels: RelativeLabels
    ) -> tuple[Float[Array, "n cues"], Float[Array, "n cues"], Float[Array, "n cues"]]:
        """Return what one fit says about labels: mean and variance of the change to the right action, and log p.

        Changes are in units of `SCALE` eps; log p [nats] is of the answer about each cue, 0 where nothing was said.
        """
        frame, change = fitted.frame, fitted.hypothesis.change
        whole, own = self._probe(frame, _one(change), labels.obs)[0], self._ask(labels.obs)
        return _predicted(self.space, self.family, fitted, labels, own, whole, self.act(fitted, labels.obs), self.eps)

    def ratio(self, fits: Fit, labels: RelativeLabels) -> Float[Array, ""]:
        """Return log((1 + r) / 2), r = p(answers | best hypothesis) / p(answers | nothing changed)."""
        best, nothing = (self.predict(pick(fits, number), labels)[2].sum() for number in (best_of(fits), 0))
        return jnp.logaddexp(best - nothing, 0.0) - math.log(2)

    def spread(self, fitted: Fit, obs: Observations) -> Float[Array, "n cues"]:
        """Return the standard deviation of the right action along each cue, in the unit of `space.log`."""
        zeros = jnp.zeros((len(obs), len(self.space.cues)))
        labels = RelativeLabels(obs, self.act(fitted, obs), zeros, jnp.ones(len(obs), bool))
        return SCALE * self.eps * jnp.sqrt(self.predict(fitted, labels)[1])


@jax.jit
def correction(fitted: Fit, eps: Any) -> Correction:
    """Return what is needed to act by a fit."""
    change, hyper, situations = fitted.hypothesis.change, fitted.posterior.hyper, fitted.data.inputs
    alpha = posterior.amplitudes(hyper)[None] ** 2 * fitted.posterior.alpha
    return Correction(change, fitted.frame, situations, alpha, posterior.lengths(hyper), jnp.float32(SCALE * eps))


@jax.jit
def again(fitted: Fit) -> tuple[Hypothesis, Hypothesis]:
    """Return where the next `Reader.read` starts: the hypotheses of this one."""
    count = len(HYPOTHESES)
    of = lambda part: jax.tree.map(lambda leaf: leaf[part], fitted.hypothesis)  # noqa: E731
    plain, smooth = of(slice(0, count)), of(slice(count, None))
    wide = lambda hyper: hyper.replace(width=jnp.full_like(hyper.width, WIDE), lapse=jnp.zeros_like(hyper.lapse))  # noqa: E731
    hyper = wide(plain.hyper.replace(amplitudes=jnp.zeros(count)))
    smooth = smooth.replace(hyper=wide(smooth.hyper))
    return Hypothesis(ModelParts(plain.parts.weights, False), plain.change, hyper), smooth


@jax.jit
def best_of(fitted: Fit) -> Array:
    """Return the number of the hypothesis that predicts best; 0, nothing, where the others are not `WORTH` better."""
    score = jnp.nan_to_num(fitted.score, nan=-jnp.inf)
    best = jnp.argmax(score)
    return jnp.where(score[best] < score[0] + WORTH, 0, best)


@jax.jit
def pick(stacked: Any, number: Any) -> Any:
    """Return the part of a number, or of several, of a stacked tree such as a `Fit`."""
    return jax.tree.map(lambda leaf: leaf[number], stacked)


@partial(jax.jit, static_argnames=("space", "family"))
def _act(space: Space, family: Family, fitted: Fit, obs: Array, before: Array, actions: Array, eps: Any) -> Array:
    return corrected(space, family, correction(fitted, eps), obs, before, actions[0], actions[1])


@partial(jax.jit, static_argnames=("space", "family"))
def _predicted(
    space: Space, family: Family, fitted: Fit, labels: RelativeLabels, own: Array, whole: Array, action: Array, eps: Any
) -> tuple[Array, Array, Array]:
    rows = linear.data(space, family, fitted.frame, fitted.hypothesis.change, labels, own, whole, eps)
    parts, hyper = fitted.hypothesis.parts, fitted.posterior.hyper
    _, variance = posterior.predict(fitted.posterior, fitted.data, parts, rows.features, rows.inputs)
    mean = space.log(labels.action, action) / (SCALE * eps)
    return mean, variance, predictive_log_likelihood(mean, variance, rows.answers, posterior.habits(hyper, 1 / SCALE))


@partial(jax.jit, static_argnames="family")
def _moves(family: Family, frame: ObservationFrame, change: Change) -> Change:
    """Return an estimate with its theta, and with another shift of an unknown: a family's, or an entry that matters."""
    size = len(frame.step)
    entries = jnp.arange(size) if family else frame.mixed
    each = jnp.eye(size)[entries] * frame.step[None]
    several = (jnp.array(TRIED)[:, None, None] * each[None]).reshape(len(TRIED) * len(entries), size)
    return _one(change.replace(theta=change.theta[None] + jnp.concatenate([jnp.zeros((1, size)), several])))


@jax.jit
def _best(tried: Change, worth: Array) -> tuple[Change, Array]:
    """Return an estimate with the best theta, and its worth. The best of many must beat the first and chance."""
    best = jnp.argmax(worth[0].at[1:].add(-WORTH - math.log(worth.size)))
    return pick(tried, 0).replace(theta=tried.theta[0, best]), worth[0, best]


@jax.jit
def _replace_worse(changes: Change, own: Array, change: Change, worth: Array) -> Change:
    """Return the estimates of all hypotheses with their own worth, in which another estimate replaces worse ones."""
    better = (worth > own + WORTH) & jnp.array(["seen" in names for names in HYPOTHESES])
    return jax.tree.map(lambda own, other: jax.vmap(jnp.where, (0, None, 0))(better, other, own), changes, change)


@partial(jax.jit, static_argnames=("space", "family"))
def _worth(
    space: Space, family: Family, changes: Change, labels: RelativeLabels, before: Array, actions: Array, eps: Any
) -> Array:
    answers = linear.answers_of(space, labels, eps)
    usual = Habits(jnp.float32(TAU / SCALE), jnp.float32(1 / SCALE), jnp.float32(0.1))

    def one(change: Change, before: Array, action: Array) -> Array:
        base = linear.meant(family, change.theta, before, action)
        own = space.exp(base, SCALE * eps * (linear.basis(space, base) @ change.action.T))
        worth = log_likelihood(space.log(labels.action, own) / (SCALE * eps), answers, usual).sum()
        return jnp.where(jnp.isnan(worth), -jnp.inf, worth)  # NaN: the policy has no action there

    return jax.vmap(jax.vmap(one, (THETA, 0, 0)))(changes, before, actions)


# Of stacked estimates, the first two with several theta each, and of what the policy does about each
_undone_each = jax.jit(jax.vmap(jax.vmap(linear.undone, (None, THETA, None)), (None, 0, None)), static_argnums=0)
_meant_each = jax.jit(jax.vmap(jax.vmap(linear.meant, (None, 0, 0, 0)), (None, 0, 0, 0)), static_argnums=0)
_sides = jax.jit(jax.vmap(linear.sides, (None, 0)))
_one = partial(jax.tree.map, lambda leaf: leaf[None])
_data = jax.jit(jax.vmap(linear.data, (None, None, None, 0, None, None, 0, None)), static_argnums=(0, 1))
_unread = jax.jit(jax.vmap(posterior.unread))


@jax.jit
def _update(
    rows: Data, frame: ObservationFrame, hypothesis: Hypothesis, posteriors: Posterior
) -> tuple[Posterior, Hypothesis]:
    """Infer each hypothesis, and move its estimate. Where the result is not finite, a hypothesis stays as it was.

    In single precision a process of large amplitude has no Cholesky factor at hundreds of answers.
    """

    def one(rows: Data, hypothesis: Hypothesis, before: Posterior) -> tuple[Posterior, Hypothesis]:
        posteriors = posterior.infer(rows, hypothesis.parts, jnp.float32(1 / SCALE), before)
        at = linear.weights_of(frame, hypothesis.change)
        weights = hypothesis.parts.weights * (at + jnp.clip(posteriors.mean - at, -TRUST, TRUST))
        change = linear.change_of(frame, weights, hypothesis.change)
        after = posteriors, Hypothesis(hypothesis.parts, change, posteriors.hyper)
        is_finite = jnp.isfinite(jnp.concatenate([leaf.ravel() for leaf in jax.tree.leaves(after)])).all()
        return jax.tree.map(partial(jnp.where, is_finite), after, (before, hypothesis))

    return each_lane(one)(rows, hypothesis, posteriors)


@jax.jit
def _scored(rows: Data, frame: ObservationFrame, hypothesis: Hypothesis, posteriors: Posterior) -> Fit:
    """Return fits with the sum of log p(answer | all others) of each, by the cavity of each answer's site."""

    def one(rows: Data, hypothesis: Hypothesis, posteriors: Posterior) -> Array:
        _, variance = posterior.predict(posteriors, rows, hypothesis.parts, rows.features, rows.inputs)
        # at the estimate itself, of which the linear model is only a tangent
        mean = rows.offset + rows.features @ linear.weights_of(frame, hypothesis.change)
        if hypothesis.parts.process:
            mean = mean + posterior.process(posteriors, rows.inputs, rows.inputs)
        habits = posterior.habits(posteriors.hyper, 1 / SCALE)
        slope, _ = curvature(mean, variance, rows.answers, habits)
        cavity = variance / jnp.maximum(1 - variance * posteriors.precision, 0.05)
        return predictive_log_likelihood(mean - cavity * slope, cavity, rows.answers, habits).sum()

    score = each_lane(one)(rows, hypothesis, posteriors)
    frames = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (len(score), *leaf.shape)), frame)
    return Fit(hypothesis, posteriors, rows, frames, score)


@jax.jit
def _first_and_best(first: Fit, smooth: Hypothesis) -> Hypothesis:
    """Return where fits with the process start: the first hypothesis, and the one that predicts best."""
    best = jnp.argmax(jnp.nan_to_num(first.score, nan=-jnp.inf))
    two = jnp.stack([jnp.zeros_like(best), best])
    start = jax.tree.map(lambda leaf: leaf[two], first.hypothesis)
    return Hypothesis(ModelParts(start.parts.weights, True), start.change, smooth.hyper)


@jax.jit
def _together(first: Fit, second: Fit | None) -> Fit:
    """Return all fits, stacked; those without the process have one of no amplitude."""
    never = lambda hyper: hyper.replace(amplitudes=jnp.full_like(hyper.amplitudes, _NEVER))  # noqa: E731
    hypothesis, posteriors = first.hypothesis, first.posterior
    hypothesis = hypothesis.replace(parts=ModelParts(hypothesis.parts.weights, True), hyper=never(hypothesis.hyper))
    first = first.replace(hypothesis=hypothesis, posterior=posteriors.replace(hyper=never(posteriors.hyper)))
    if second is None:
        return first
    return jax.tree.map(lambda one, other: jnp.concatenate([one, other]), first, second)
