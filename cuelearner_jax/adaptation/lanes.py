"""The lanes of an adaptation, each a (base policy, seed, label budget, bound), asked and fitted together.

A lane asks about what its base policy does, then about what its model so far makes of that (DAgger), never farther from
the base than its bound, and fits a new model after each round. Lanes differ by arrays alone: budgets are masks over
labels, bounds are traced, and several base policies are one pytree with a leading axis. So any number of them is one
compiled program: side by side on an accelerator, one by one on a CPU (`devices.each_lane`), shared out over a mesh.

    of = Adaptation(guide, sizes, scalars, env, bases)    # settings of all lanes
    lanes = product(bases=8, seeds=(0,), budgets=(100, 250, 500), bounds_deg=(60.0, 180.0))
    block = begin(of, lanes)
    for _ in range(rounds(lanes, sizes)):
        block = ask_round(of, teacher, block, mesh)    # or once: take_labels(of, labels, block, mesh)
    policy = of.policy(block)    # a block for `evaluate.rollout_lanes`
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from operator import index
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax.sharding import Mesh
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from cuelearner_jax import asking
from cuelearner_jax.asking import GuideState
from cuelearner_jax.config import GuideSizes, Scalars
from cuelearner_jax.devices import BY_LANE, SHARED, each_lane, over_lanes
from cuelearner_jax.environment import Environment, actions_of, view_of
from cuelearner_jax.guides.base import Guide
from cuelearner_jax.policies import Guided, PolicyNode
from cuelearner_jax.types import Label, Teacher


class Lanes(NamedTuple):
    """The lanes of an adaptation as arrays, one row a lane."""

    base: np.ndarray  # (lanes,) int: which of the base policies
    seed: np.ndarray  # (lanes,) int: seed of all random numbers
    budget: np.ndarray  # (lanes,) int: label budget
    bound_deg: np.ndarray  # (lanes,) float: largest distance from the base's actions [deg]

    @property
    def number(self) -> int:
        """The number of lanes."""
        return len(self.seed)


def product(
    bases: int, seeds: Sequence[int], budgets: Sequence[int], bounds_deg: Sequence[float], one_each: bool = False
) -> Lanes:
    """Return the lanes of every combination; `one_each`: pair each base policy with a seed of its own."""
    pairs = [*enumerate(seeds)] if one_each else [(base, seed) for base in range(bases) for seed in seeds]
    rows = [(*pair, budget, bound) for bound in bounds_deg for budget in budgets for pair in pairs]
    base, seed, budget, bound = zip(*rows, strict=True)
    whole = lambda column: np.array([*map(index, column)], np.int32)  # noqa: E731  # refuses fractions
    return Lanes(whole(base), whole(seed), whole(budget), np.array(bound, np.float32))


def side_by_side(policies: Sequence[Any]) -> Any:
    """Stack single policies of one structure into a block; leaves that are `BY_LANE` get a row for each policy."""

    def stacked(axis: Any, *parts: Any) -> Any:
        if axis is None:
            return parts[0]
        return jax.tree.map(lambda *leaves: jnp.stack([jnp.asarray(leaf) for leaf in leaves]), *parts)

    return jax.tree.map(stacked, policies[0].axes, *policies, is_leaf=lambda axis: axis is None)


class LaneState(struct.PyTreeNode):
    """The state of one lane; in a block every leaf has a leading axis of lanes."""

    guide: GuideState
    base: Int[Array, ""]  # number of its base policy
    bound: Float[Array, ""]  # in the unit of the space's `log`
    key: PRNGKeyArray
    failed: Bool[Array, ""]  # True once the model stopped being finite; the lane then keeps its last finite state

    @property
    def corrects(self) -> Bool[Array, "*lanes"]:
        """Whether the lane has a fitted model."""
        return self.guide.model.fitted

    @property
    def labels(self) -> Label:
        """The labels so far."""
        return self.guide.labels


class Adaptation(struct.PyTreeNode):
    """The kind of guidance, the world and the base policies that all lanes of an adaptation share."""

    guidance: Guide = struct.field(pytree_node=False)  # a guide that asks for labels
    sizes: GuideSizes = struct.field(pytree_node=False)  # sizes that the guide was made with
    scalars: Scalars  # settings of refinement, of fitting and of a simulated teacher's faults
    env: Environment  # the changed world
    bases: PolicyNode  # leaves that are `BY_LANE` in its `axes` have a row for each base; or `policies.Common`

    def policy(self, block: LaneState, env: Any = None) -> Guided:
        """Return every lane's policy: its base's actions under its model, within its bound.

        `env`: where the policy is to act (default: the world of the questions).
        """
        base, view = self.bases.lane(block.base), view_of(self.env if env is None else env)
        return Guided(base, block.guide.model, view, self.scalars, self.guidance, block.bound, self.sizes)

    def drop_unused(self, block: LaneState, in_use: Bool[Array, " lanes"]) -> LaneState:
        """Return the lanes, without a fitted model where it is not used: actions are then unchanged."""
        model = block.guide.model
        return block.replace(guide=block.guide.replace(model=model.replace(fitted=model.fitted & in_use)))


def rounds(lanes: Lanes, sizes: GuideSizes) -> int:
    """Return the number of rounds until the largest budget is asked for."""
    return asking.label_slots(int(lanes.budget.max()), sizes) // sizes.labels_per_round


@partial(jax.jit, static_argnames=("guidance", "sizes", "slots"))
def _begin(guidance: Guide, sizes: GuideSizes, slots: int, env: Any, columns: Any) -> LaneState:
    def one(base: Array, seed: Array, budget: Array, bound: Array) -> LaneState:
        k_model, k_env, k_lane = jax.random.split(jax.random.key(seed), 3)
        guide = asking.start(guidance, env, slots, budget, k_model, k_env, sizes)
        return LaneState(guide, base, bound, k_lane, jnp.array(False))

    return each_lane(one)(*columns)


def begin(of: Adaptation, lanes: Lanes) -> LaneState:
    """Return lanes that have asked nothing yet. Their number must divide among the devices of the mesh used later."""
    bound = actions_of(of.env).from_unit(lanes.bound_deg)
    columns = (*(jnp.asarray(column) for column in (lanes.base, lanes.seed, lanes.budget)), bound)
    return _begin(of.guidance, of.sizes, rounds(lanes, of.sizes) * of.sizes.labels_per_round, of.env, columns)


@partial(jax.jit, static_argnames="mesh")
def ask_round(of: Adaptation, teacher: Any, block: LaneState, mesh: Mesh) -> LaneState:
    """Ask a simulated teacher one round of questions in every lane, then fit each lane's model (`asking.label_round`).

    A lane whose budget is used up does not change. `mesh`: devices that share the lanes.
    """

    def of_device(of: Adaptation, teacher: Any, block: LaneState) -> LaneState:
        def one(lane: LaneState) -> LaneState:
            own = asking.Inquiry(of.guidance, of.env, of.scalars, of.bases.lane(lane.base), lane.bound)
            return asking.with_guide(lane, asking.label_round(own, of.sizes, teacher, lane.guide, lane.key))

        return each_lane(one)(block)

    return over_lanes(mesh, of_device, (SHARED, SHARED, BY_LANE), BY_LANE)(of, teacher, block)


@partial(jax.jit, static_argnames="mesh")
def take_labels(of: Adaptation, labels: Label, block: LaneState, mesh: Mesh) -> LaneState:
    """Fit every lane once to given labels (lanes, slots, ...), as the last round of questions would.

    A kind that fits from scratch then has the same model as a lane that asked these questions. A kind that goes on
    learning (deep COACH) is corrected by all labels in one go, with other random numbers.
    """

    def of_device(of: Adaptation, labels: Label, block: LaneState) -> LaneState:
        def one(labels: Label, lane: LaneState) -> LaneState:
            if of.guidance.sees_base:  # files do not keep the base policy's actions: ask it again
                labels = labels.replace(base=of.bases.lane(lane.base).act(lane.key, None, labels.obs))
            guide = lane.guide.replace(labels=labels, asked=lane.guide.budget)
            last = (lane.guide.budget - 1) // of.sizes.labels_per_round  # number of the last round
            return asking.with_guide(lane, asking.fit(of.guidance, of.env, of.scalars, guide, lane.key, last))

        return each_lane(one)(labels, block)

    return over_lanes(mesh, of_device, (SHARED, BY_LANE, BY_LANE), BY_LANE)(of, labels, block)


def blame(of: Adaptation, teacher: Teacher | None, block: LaneState) -> None:
    """Raise UserError if the first lane failed because of its policy or its teacher (see `asking.blame`)."""
    lane = jax.tree.map(lambda leaf: leaf[0], block)
    asking.blame(of.env, teacher, lane.guide, of.bases.lane(lane.base), lane.key)
