"""Adaptation from the first question to the judged policies: what the command, the face and experiments call.

found = adapt(Adaptation(guide, sizes, scalars, env, bases), lanes, Judging(tuning_env), teacher)
found.judged.used, found.policy(env)
"""

from __future__ import annotations

import math
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
from cuelearner_jax.adaptation.judging import Judge, Judged, Judging
from cuelearner_jax.adaptation.lanes import Adaptation, Lanes, LaneState, ask_round, begin, blame, rounds, take_labels
from cuelearner_jax.calibration import Result
from cuelearner_jax.config import GuideSizes, Scalars
from cuelearner_jax.devices import BY_LANE, SHARED, lane_mesh, place
from cuelearner_jax.errors import UserError
from cuelearner_jax.evaluate import Tell, untold
from cuelearner_jax.policies import Policy, named
from cuelearner_jax.spaces import DIRECTIONS, Space
from cuelearner_jax.types import Label, Teacher

# Seconds a fit on a CPU. The paper's networks are `GuideSizes()`.
SIZES = GuideSizes(feedback_layers=(128, 128), fit_steps=400, fit_batch_size=64)
REACH_QUANTILE = 0.95  # of the distances between labelled actions and a policy's own: how far labels reach from it
BOUND = 1 / 4  # of the space's reach (45 deg): where nobody says how far corrections may lead
PASSES = 20  # of which one turn by eps: a pass that turns by less has settled


@dataclass(frozen=True)
class Adapted:
    """What adaptation has led to. Where a lane's model is not used, its policy is its base."""

    of: Adaptation
    lanes: Lanes
    block: Any  # `LaneState`, or `calibrated.Evidence`
    judged: Judged
    curve: list[dict[str, Any]]  # a row a measurement: "asked" (lanes,) labels so far, and metrics (lanes,) by name
    results: tuple[Result, ...] = ()  # of calibration, a lane each: what changed

    @property
    def labels(self) -> Label:
        """All lanes' labels (lanes, slots, ...), as NumPy arrays."""
        return jax.device_get(self.block.labels)

    @property
    def failed(self) -> np.ndarray:
        """Lanes (lanes,) whose model is no longer finite."""
        return np.asarray(self.block.failed)

    def policy(self, env: Any) -> Any:
        """The lanes' policies in a world."""
        return self.of.policy(self.block, env)


def adapt(
    of: Adaptation,
    lanes: Lanes,
    how: Judging,
    teacher: Teacher | None = None,
    labels: Label | None = None,
    mesh: Mesh | None = None,
    watch: Callable[[str], Tell] = lambda what: untold,
) -> Adapted:
    """Asks, fits and judges all lanes.

    Args:
        of: what lanes share: the kind of guidance, the world, the base policies.
        lanes: what is adapted.
        how: policies are judged.
        teacher: who answers in rounds; None where labels are given.
        labels: rows (lanes, slots, ...) in place of questions, fitted at once.
        mesh: devices that share the lanes (default: all of this process's).
        watch: by what is being done, who is told how far it is.

    Raises:
        UserError: policies cannot be judged as asked.
    """
    mesh, count = mesh or lane_mesh(), lanes.number
    filled = np.minimum(np.arange(-(-count // mesh.size) * mesh.size), count - 1)  # the last is repeated, and dropped
    judge = Judge(of, lanes.rows(filled), how, mesh, watch)
    if labels is not None:
        labels = jax.tree.map(lambda leaf: jnp.asarray(leaf)[filled], labels)
    block = learned(of, lanes.rows(filled), teacher, labels, mesh, watch, judge.measure_if_due)
    judged, block = judge.judged(block)
    model = block.guide.model  # one that is not used leaves actions alone
    block = block.replace(
        guide=block.guide.replace(model=model.replace(fitted=model.fitted & jnp.asarray(judged.used)))
    )
    block = jax.tree.map(lambda leaf: leaf[:count], block)
    curve = [{name: values[:count] for name, values in row.items()} for row in judge.curve]
    return Adapted(of, lanes, block, Judged(judged.by, *(column[:count] for column in judged[1:])), curve)


def learned(
    of: Adaptation,
    lanes: Lanes,
    teacher: Teacher | None,
    labels: Label | None = None,
    mesh: Mesh | None = None,
    watch: Callable[[str], Tell] = lambda what: untold,
    before_round: Callable[[LaneState, int], None] = lambda block, asked: None,
) -> LaneState:
    """Lanes with a model of a teacher's answers, or of given labels; arguments as `adapt` has them.

    `before_round` gets the lanes and the number of questions so far. Raises UserError if all lanes failed for their
    policy or their teacher.
    """
    mesh = mesh or lane_mesh(jax.local_devices()[:1])
    placed = of.replace(env=place(mesh, of.env, SHARED), bases=place(mesh, of.bases, SHARED))
    block = place(mesh, begin(of, lanes), BY_LANE)  # as it lies: whoever has begun it before has compiled it
    if labels is not None:
        return take_labels(placed, place(mesh, labels, BY_LANE), block, mesh)
    assert teacher is not None  # asked for where no labels are given
    asks, number, tell = place(mesh, teacher, SHARED), rounds(lanes, of.sizes), watch("labels")
    for done in range(number):
        tell(done, number)
        before_round(block, done * of.sizes.labels_per_round)
        block = jax.block_until_ready(ask_round(placed, asks, block, mesh))
        if block.failed.all():
            blame(placed, asks, block)
    tell(number, number)
    return block


def check_amounts(space: Space, bounds: Sequence[float], scalars: Scalars) -> str:
    """Return what may be meant otherwise of bounds and the strength of labels, in the space's unit; or nothing.

    Raises UserError for what cannot be, or could teach nothing.
    """
    eps, given = scalars.eps_deg, " ".join(f"{bound:g}" for bound in bounds)
    if not all(math.isfinite(bound) and 0 < bound <= space.reach for bound in bounds):
        raise UserError(f"bound_deg is {given}: give a number above 0 and up to {space.reach:g} ({space.unit})")
    if len(set(bounds)) < len(bounds):
        raise UserError(f"bound_deg is {given}: give each bound once")
    if eps < space.grain:
        raise UserError(f"scalars.eps_deg is {eps:g} {space.unit}: give at least {space.grain:g}, the smallest change")
    if eps > min(bounds):
        raise UserError(
            f"labels of {eps:g} {space.unit} say nothing within a bound of {min(bounds):g}: give a smaller "
            "scalars.eps_deg, about a tenth of the bound"
        )
    if scalars.tau_deg >= eps:
        raise UserError(
            f"scalars.tau_deg is {scalars.tau_deg:g} and a pass moves an action by {eps:g}, after which refinement "
            f"would stop: give scalars.tau_deg {eps / PASSES:g}"
        )
    if scalars.k_max * eps >= max(bounds):
        return ""
    return (
        f"{scalars.k_max} passes of {eps:g} {space.unit} do not reach the bound of {max(bounds):g}: "
        f"scalars.k_max {math.ceil(max(bounds) / eps)} would"
    )


def usual_bound(space: Space) -> float:
    """How far corrections may lead where nobody says how far, in the space's unit: a quarter of its reach."""
    return max(BOUND * space.reach, space.grain)


def reach(space: Space, policy: Policy, obs: Any, action: Any) -> float:
    """The distance within which 95% of actions (labels, action) lie from a policy's own, in the space's unit."""
    away = _distances(space, policy, jnp.asarray(obs), jnp.asarray(action))
    user_code.check_actions(away, named(policy))
    return float(space.to_unit(np.quantile(np.asarray(away), REACH_QUANTILE), np))


@partial(jax.jit, static_argnames="space")
def _distances(space: Space, policy: Any, obs: Array, action: Array) -> Array:
    return space.distance(policy.act(jax.random.key(0), None, obs), action)


def plain_scalars(space: Space) -> Scalars:
    """Default scalars in a space's unit: as much of its reach as they are of a half turn, eps at least its grain."""
    names = ("eps_deg", "tau_deg", "tau_max_deg", "scalar_within_deg", "nearest_aim_deg")
    share = space.reach / DIRECTIONS.reach
    scalars = replace(Scalars(), **{name: getattr(Scalars, name) * share for name in names})
    return replace(scalars, eps_deg=max(scalars.eps_deg, space.grain)) if space.grain else scalars


def settling(scalars: Scalars, eps_deg: float | None) -> Scalars:
    """Scalars with answers of that strength (None: as they are), and a threshold that is small beside it."""
    eps = scalars.eps_deg if eps_deg is None else eps_deg
    return replace(scalars, eps_deg=eps, tau_deg=min(scalars.tau_deg, eps / PASSES))
