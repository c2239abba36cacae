"""What a reading found, in numbers with intervals and in words.

Entries of the observation that the policy cannot tell apart are told as one: only their sum or difference is known.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from cuelearner_jax.environment import Quantity
from cuelearner_jax.reading import linear, posterior
from cuelearner_jax.reading.families import Family, unknowns_of
from cuelearner_jax.reading.fitting import Fit
from cuelearner_jax.reading.linear import SCALE
from cuelearner_jax.spaces import DIRECTIONS, Box, Space

Floats = np.ndarray
NORMAL, SIDES = 1.96, np.array([-1, 0, 1])  # half width of a 95% interval, in standard deviations, and its places
ALIKE = 0.98  # correlation of the effects of two entries that the policy cannot tell apart
ALIKE_SITUATION = 0.5  # correlation of the process from which a situation is near a labelled one
HARMONICS = ("cos of", "sin of", "cos of twice", "sin of twice")
SMALL = 0.25  # effect on actions from which an estimate is told, in eps
PER_CENT = 100.0


class Estimate(NamedTuple):
    """The estimate of one change after all answers, in its unit."""

    name: str
    unit: str
    mean: float
    low: float  # ends of the 95% interval
    high: float

    def words(self) -> str:
        """Describe the estimate in one line."""
        return f"{self.name}: {self.mean:.4g} [{self.low:.4g}, {self.high:.4g}] {self.unit}"


class Result(NamedTuple):
    """The verdict of a reading."""

    used: bool  # whether the answers show that the corrected policy is better
    changed: bool  # whether any change explains the answers better than none
    evidence: float  # log of the product of p(answers | corrected) / p(answers | as it was), each predicted [nats]
    estimates: tuple[Estimate, ...]
    mixed: float  # typical correction of entries of the observation that are seen mixed, in the space's unit; 0: none
    depends: float  # typical correction that depends on the situation, in the space's unit; 0: none
    near: float | None  # share of the situations met that are like labelled ones, which corrections may depend on
    wrong: float  # share of answers about something else
    policy: Any  # the corrected policy
    open_ended: tuple[str, ...] = ()  # cues of which all answers name the same way, in words

    def words(self) -> list[str]:
        """Describe the result, line by line."""
        if not self.changed:
            return ["The answers ask for no change."]
        lines = [one.words() for one in self.estimates]
        if self.mixed:
            lines += [f"entries of the observation are seen mixed, which moves actions by {self.mixed:.3g} typically"]
        if self.depends:
            near = f", near labels, where {self.near:.0%} of the situations met lie" if self.near is not None else ""
            lines.append(f"beyond that, corrections depend on the situation: {self.depends:.3g} typically{near}")
        if self.wrong > 0.1:
            lines.append(f"{self.wrong:.0%} of the answers seem to be about something else")
        return [*lines, *(f"{words}: none says where to stop, so intervals may be wrong" for words in self.open_ended)]

    def to_json(self) -> dict[str, Any]:
        """Return JSON values, without the policy."""
        values = {name: value for name, value in self._asdict().items() if name != "policy"}
        return {**values, "estimates": [one._asdict() for one in self.estimates]}


def describe_fit(
    fitted: Fit, space: Space, family: Family, eps: float, observation: Sequence[Quantity], walk: Float[Floats, "m z"]
) -> tuple[tuple[Estimate, ...], float, float, float | None, float]:
    """Return the entries of `Result` from `estimates` to `wrong`.

    `eps` is in the unit of `space.log`. `observation`: slices of the observation; empty: entries have numbers alone.
    `walk`: situations that the policy met, as `linear.inputs` has them.
    """
    weights = np.asarray(linear.weights_of(fitted.frame, fitted.hypothesis.change), np.float64)
    root = np.asarray(fitted.posterior.root, np.float64) * np.asarray(fitted.hypothesis.parts.weights)[:, None]
    x = np.asarray(fitted.data.features, np.float64)
    valid = np.asarray(fitted.data.answers.valid).any(-1)
    effect = x[valid].reshape(-1, x.shape[-1])
    unknowns = len(fitted.hypothesis.change.theta)
    names = _names(family, unknowns, observation)
    step = np.asarray(fitted.frame.step, np.float64)
    estimates = _changes_of_observation(weights[:unknowns], root[:unknowns], effect[:, :unknowns], names, family, step)
    own = slice(len(weights) - linear.terms(*fitted.hypothesis.change.action.shape).shape[1], None)
    estimates += _of_action(weights[own], root[own], effect[:, own], space, eps)
    hyper, inputs = fitted.posterior.hyper, fitted.data.inputs
    more = np.asarray(posterior.process(fitted.posterior, inputs, inputs))[valid]
    mix = effect[:, unknowns : own.start] @ weights[unknowns : own.start]
    sizes = [SCALE * np.sqrt((each**2).mean()) if len(each) else 0.0 for each in (mix, more)]  # [eps]
    mixed, depends = (float(space.to_unit(eps * size, np)) if size > SMALL else 0.0 for size in sizes)
    near = None
    if len(walk) and valid.any():
        alike = posterior.correlation(posterior.lengths(hyper), jnp.asarray(walk), inputs[valid])
        near = float((alike.max(1) >= ALIKE_SITUATION).mean())
    return tuple(estimates), mixed, depends, near, float(posterior.habits(hyper, 1 / SCALE).lapse)


def _names(family: Family, count: int, observation: Sequence[Quantity]) -> list[tuple[str, str]]:
    if family:
        return [(one.name, one.unit) for one in unknowns_of(family)]
    names = [(f"obs[{number}]", "") for number in range(count)]
    if len(observation) > 1 and sum(part.size for part in observation) == count:
        several = lambda part, entry: f"{part.name}[{entry}]" if part.size > 1 else part.name  # noqa: E731
        names = [(several(part, entry), part.unit) for part in observation for entry in range(part.size)]
        names = [(name, "" if unit == "1" else unit) for name, unit in names]
    return names


def _changes_of_observation(
    mean: Float[Floats, " u"],
    root: Float[Floats, "u p"],
    effect: Float[Floats, "n u"],
    names: list[tuple[str, str]],
    family: Family,
    step: Float[Floats, " u"],
) -> list[Estimate]:
    """Return changes of what is seen; unknowns of proportional effects are one."""
    length = np.linalg.norm(effect, axis=0)
    remaining = [k for k in np.argsort(-np.abs(mean) * length) if length[k] > 1e-6 and root[k].any()]
    estimates = []
    while remaining:
        largest = remaining[0]
        alike = [k for k in remaining if abs(effect[:, largest] @ effect[:, k]) >= ALIKE * length[largest] * length[k]]
        remaining = [k for k in remaining if k not in alike]
        first, members = min(alike), np.sort(alike)
        share = effect[:, first] @ effect[:, members] / (length[first] ** 2)
        value, deviation = share @ mean[members], float(np.linalg.norm(share @ root[members]))
        if not _matters(value, deviation, length[first] / math.sqrt(max(len(effect), 1))):
            continue
        parts = [("" if not k else " + " if share[k] > 0 else " - ") + names[m][0] for k, m in enumerate(members)]
        name, unit = "".join(parts), names[first][1]
        low, mid, high = sorted(step[first] * (value + NORMAL * deviation * SIDES))
        if family and unknowns_of(family)[first].is_log:
            low, mid, high = PER_CENT * np.expm1(np.array([low, mid, high]) / PER_CENT)
        is_seen = not family or [one.sees or one.effect[1] for one in family for _ in one.unknowns][first]
        name += " seen aside" if is_seen and unit != "degrees" else ""
        estimates.append(Estimate(name, unit, mid, low, high))
    return estimates


def _matters(value: float, deviation: float, effect: float) -> bool:
    """Return whether an estimate differs from zero, and changes actions."""
    return bool(abs(value) > NORMAL * deviation and abs(value) * effect > SMALL / SCALE)


def _of_action(
    mean: Float[Floats, " w"], root: Float[Floats, "w p"], effect: Float[Floats, "n w"], space: Space, eps: float
) -> list[Estimate]:
    """Return changes of the action: the shift of each cue, and of a box the share of each entry in it."""
    estimates, typical = [], np.linalg.norm(effect, axis=0) / math.sqrt(max(len(effect), 1))
    numbers = linear.terms(len(space.cues), linear.basis_size(space)).T
    for (cue, term), value, row, size in zip(numbers, mean, root, typical, strict=True):
        deviation = float(np.linalg.norm(row))
        if not _matters(value, deviation, float(size)):
            continue
        name, unit = f"action: {space.cues[cue].name}", space.unit
        factor, start = float(space.to_unit(SCALE * eps, np)), 0.0
        if term and isinstance(space, Box):
            factor, unit, start = 2 * SCALE * eps * PER_CENT, "percent", PER_CENT if term - 1 == cue else 0.0
            name += ": gain" if term - 1 == cue else f": share of {space.cues[term - 1].name}"
        elif term and space == DIRECTIONS:
            name += f", times {HARMONICS[term - 1]} the action's angle"
        elif term:
            name += f", times entry {term} of the action"
        low, mid, high = start + factor * (value + NORMAL * deviation * SIDES)
        estimates.append(Estimate(name, unit, mid, low, high))
    return estimates
