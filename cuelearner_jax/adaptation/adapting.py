"""Adaptation from the first question to the judged policies: what the command, the face and experiments call."""

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
from cuelearner_jax.adaptation import judging, program
from cuelearner_jax.adaptation.judging import Judged
from cuelearner_jax.adaptation.program import Adapting, Lanes
from cuelearner_jax.config import GuideSizes, Scalars
from cuelearner_jax.devices import BY_LANE, SHARED, lane_mesh, place
from cuelearner_jax.environment import Environment, actions_of
from cuelearner_jax.errors import UserError
from cuelearner_jax.evaluate import Rolled, Tell, untold
from cuelearner_jax.guides.base import Guide
from cuelearner_jax.policies import Guided, Policy, PolicyBlock, lanes_in, named
from cuelearner_jax.spaces import DIRECTIONS, Space
from cuelearner_jax.types import Label, Teacher

# Seconds a fit on a CPU. The paper's networks are `GuideSizes()`.
SIZES = GuideSizes(feedback_layers=(128, 128), fit_steps=400, fit_batch_size=64)
REACH_QUANTILE = 0.95  # of the distances between labelled actions and a policy's own: how far labels reach from it
BOUND = 1 / 4  # of the space's reach (45 deg): where nobody says how far corrections may lead
PASSES = 20  # of which one turn by eps: a pass that turns by less has settled


@dataclass(frozen=True)
class Judging:
    """How policies are compared with their bases, and how often on the way."""

    env: Environment | None  # the changed world with the episodes of `split`; None: there is no simulator
    num_envs: int = 100
    steps: int = 10_000  # that the environments share
    by: str = "reward"  # a metric, or "labels"
    every: int = 0  # labels between two measurements on the way (0: at the end alone)
    split: str = "tuning"
    bounds: tuple[float, ...] = ()  # shares of a lane's bound within which its policy is tried as well


@dataclass(frozen=True)
class Adaptation:
    """What is to be adapted, to what, and how."""

    guidance: Guide
    sizes: GuideSizes  # that the guidance was made with
    scalars: Scalars
    env: Environment  # the changed world, in which is asked
    bases: PolicyBlock  # a block of base policies, or `Common`
    lanes: Lanes
    judging: Judging


@dataclass(frozen=True)
class Adapted:
    """What adaptation has led to. Where a lane's model is not used, its policy is its base."""

    asked: Adaptation
    block: Adapting
    judged: Judged
    curve: list[dict[str, Any]]  # a row a measurement: "asked" (lanes,) labels so far, and metrics (lanes,) by name

    @property
    def labels(self) -> Label:
        """All lanes' labels (lanes, slots, ...), as NumPy arrays."""
        return jax.device_get(self.block.guide.labels)

    def policy(self, env: Any) -> Guided:
        """The lanes' policies in a world (see `program.adapted`)."""
        of = self.asked
        return program.adapted(of.guidance, of.sizes, env, of.scalars, of.bases, self.block)


def check_amounts(space: Space, bounds: Sequence[float], scalars: Scalars) -> str:
    """Whether bounds and the strength of labels go together.

    Args:
        space: of the actions, in whose unit the numbers are.
        bounds: of the lanes.
        scalars: of refinement.

    Returns:
        What may be meant otherwise, or nothing.

    Raises:
        UserError: what cannot be, or could teach nothing.
    """
    eps, given = scalars.eps_deg, " ".join(f"{bound:g}" for bound in bounds)
    if not all(math.isfinite(bound) and 0 < bound <= space.reach for bound in bounds):
        raise UserError(f"bound_deg is {given}: give a number above 0 and up to {space.reach:g} ({space.unit})")
    if len(set(bounds)) < len(bounds):
        raise UserError(f"bound_deg is {given}: give each bound once")
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


def reach(space: Space, policy: Policy, obs: Any, action: Any) -> float:
    """How far from a policy's own actions labels lie: the distance of 95% of them, in the space's unit.

    Args:
        space: of the actions.
        policy: the policy.
        obs: of the labels (labels, obs).
        action: asked about (labels, action).
    """
    away = _distances(space, policy, jnp.asarray(obs), jnp.asarray(action))
    user_code.check_actions(away, named(policy))
    return float(space.to_unit(np.quantile(np.asarray(away), REACH_QUANTILE), np))


@partial(jax.jit, static_argnames="space")
def _distances(space: Space, policy: Any, obs: Array, action: Array) -> Array:
    return space.distance(policy.act(jax.random.key(0), None, obs), action)


def plain_scalars(space: Space) -> Scalars:
    """Default scalars in a space's unit: as much of its reach as they are of a half turn."""
    names = ("eps_deg", "tau_deg", "tau_max_deg", "scalar_within_deg", "nearest_aim_deg")
    share = space.reach / DIRECTIONS.reach
    return replace(Scalars(), **{name: getattr(Scalars, name) * share for name in names})


def settling(scalars: Scalars, eps_deg: float | None) -> Scalars:
    """Scalars with answers of that strength (None: as they are), and a threshold that is small beside it."""
    eps = scalars.eps_deg if eps_deg is None else eps_deg
    return replace(scalars, eps_deg=eps, tau_deg=min(scalars.tau_deg, eps / PASSES))


def adapt(
    asked: Adaptation,
    teacher: Teacher | None = None,
    labels: Label | None = None,
    mesh: Mesh | None = None,
    watch: Callable[[str], Tell] = lambda what: untold,
) -> Adapted:
    """Asks, fits and judges all lanes.

    Args:
        asked: see `Adaptation`.
        teacher: who answers in rounds; None where labels are given.
        labels: rows (lanes, slots, ...) in place of questions, fitted at once.
        mesh: devices that share the lanes (default: all of this process's).
        watch: by what is being done, who is told how far it is.

    Raises:
        UserError: policies cannot be judged as asked.
    """
    mesh = mesh or lane_mesh()
    count = asked.lanes.number
    filled = np.minimum(np.arange(-(-count // mesh.size) * mesh.size), count - 1)  # the last is repeated, and dropped
    work = replace(asked, lanes=asked.lanes.rows(filled))
    env, bases = place(mesh, asked.env, SHARED), place(mesh, asked.bases, SHARED)
    block = place(mesh, program.begin(work.guidance, work.sizes, env, work.lanes), BY_LANE)
    measure = _Measuring(work, mesh, watch)
    if labels is not None:
        rows = place(mesh, jax.tree.map(lambda leaf: jnp.asarray(leaf)[filled], labels), BY_LANE)
        block = program.take_labels(work.guidance, work.sizes, env, work.scalars, bases, rows, block, mesh)
    else:
        assert teacher is not None  # asked for where no labels are given
        asks: Teacher = place(mesh, teacher, SHARED)
        number = program.rounds(work.lanes, work.sizes)
        tell = watch("labels")
        for done in range(number):
            tell(done, number)
            measure(block, done * work.sizes.labels_per_round)
            block = jax.block_until_ready(
                program.ask_round(work.guidance, work.sizes, env, asks, work.scalars, bases, block, mesh)
            )
            if block.failed.all():
                program.blame(env, bases, asks, block)
        tell(number, number)
    judged, block = measure.judged(block)
    curve = [{name: values[:count] for name, values in row.items()} for row in measure.curve]
    block = jax.tree.map(lambda leaf: leaf[:count], judging.kept(block, judged.used))
    cut = Judged(judged.by, *(column[:count] for column in judged[1:]))
    return Adapted(asked, block, cut, curve)


class _Measuring:
    """What policies are worth, on the way and in the end."""

    def __init__(self, work: Adaptation, mesh: Mesh, watch: Callable[[str], Tell]) -> None:
        self.work, self.mesh, self.watch = work, mesh, watch
        self.curve: list[dict[str, np.ndarray]] = []

    def __call__(self, block: Adapting, asked: int) -> None:
        """Adds a row if one is due."""
        every = self.work.judging.every
        if every and asked % every == 0:
            self._add(block)

    def judged(self, block: Adapting) -> tuple[Judged, Adapting]:
        """What is used of the finished lanes, and these within the bounds that are used."""
        work, how = self.work, self.work.judging
        if how.by == judging.LABELS:
            found = judging.judged_by_labels(work.guidance, work.sizes, work.env, work.scalars, block)
        if how.env is not None:
            after = self._add(block)
        if how.by == judging.LABELS:
            return found, block
        judging.check_metric(how.by, after)
        bases = self._measured(work.bases, "the policy as it was")
        own = self._played(bases)
        played = self._played(after) + (own if len(own) == 1 else own[work.lanes.base])
        block, after, more = self._narrowed(block, after)
        usable = ~np.asarray(block.failed) & np.asarray(block.guide.model.fitted)
        within = judging.within(actions_of(work.env), block)
        return judging.judged(how.by, work.lanes, bases, after, usable, within, played + more), block

    def _played(self, rolled: Rolled) -> np.ndarray:
        """The rewarded steps (lanes,) of a roll-out."""
        how = self.work.judging
        assert how.env is not None
        return judging.steps_played(how.env, how.by, rolled, how.steps)

    def _narrowed(self, block: Adapting, after: Rolled) -> tuple[Adapting, Rolled, np.ndarray]:
        """Lanes within the share of their bounds with which they are worth most, what they are worth so, and the
        rewarded steps (lanes,) that it took to know."""
        how, bound, played = self.work.judging, block.bound, np.zeros(self.work.lanes.number, int)
        for share in how.bounds:
            tried = block.replace(bound=share * block.bound)
            found = self._measured(self._policy(tried), f"the adapted policy within {share:g} of its bound")
            played = played + self._played(found)
            better = np.asarray(found.means[how.by] > after.means[how.by])
            after = jax.tree.map(
                lambda new, old, better=better: np.where(better.reshape(-1, *[1] * (new.ndim - 1)), new, old),
                found,
                after,
            )
            bound = jnp.where(jnp.asarray(better), tried.bound, bound)
        return block.replace(bound=bound), after, played

    def _add(self, block: Adapting) -> Rolled:
        found = self._measured(self._policy(block), "the adapted policy")
        asked, failed = np.asarray(block.guide.asked), np.asarray(block.failed)
        self.curve.append({"asked": asked, "failed": failed, **found.means})
        return found

    def _policy(self, block: Adapting) -> Guided:
        work, env = self.work, self.work.judging.env
        assert env is not None
        return program.adapted(work.guidance, work.sizes, env, work.scalars, work.bases, block)

    def _measured(self, policy: PolicyBlock, what: str) -> Rolled:
        how = self.work.judging
        assert how.env is not None
        mesh = None if lanes_in(policy) is None else self.mesh
        if policy is self.work.bases:
            mesh = None  # there may be another number of them
        return judging.measured(how.env, policy, how.num_envs, how.steps, how.split, mesh, self.watch(what))
