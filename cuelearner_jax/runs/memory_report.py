"""The memory that lanes need, told before anything is made."""

from __future__ import annotations

from typing import Any

import jax
import numpy as np

from cuelearner_jax.agent.choice import looked_at
from cuelearner_jax.devices import portions
from cuelearner_jax.errors import UserError
from cuelearner_jax.runs.free_memory import free_bytes
from cuelearner_jax.runs.lanes import LaneGroup


def state_bytes(tree: Any) -> int:
    """Memory of a tree of arrays or shapes [bytes]."""
    return sum(int(np.prod(leaf.shape)) * leaf.dtype.itemsize for leaf in jax.tree.leaves(tree))


def memory_report(group: LaneGroup) -> str:
    """One line on the memory that the lanes need on each device. Raises UserError if it is more than there is."""
    shapes = group.shapes()
    sizes, lanes, devices = group.config.sizes, len(group.seeds), group.mesh.size
    padded = sum(len(seeds) for seeds, _ in group.blocks())
    kept = sum(state_bytes(block) for block in shapes) // devices
    # Activations of the widest pass: the argmax while acting, that inside targets, or a batch with its gradient.
    widest = max(*sizes.q_layers, *sizes.feedback_layers)
    looked = looked_at(sizes)
    rows = max(
        min(sizes.num_envs * looked, max(portions().actions, looked)), 3 * sizes.batch_size * len(sizes.q_layers)
    )
    if group.config.bootstraps:
        rows = max(rows, sizes.batch_size * sizes.target_directions * (2 if sizes.n_step > 1 else 1))
    working = 4 * 4 * widest * rows * group.at_once
    each = f" on each of {devices} devices" if devices > 1 else ""
    available = free_bytes()
    limit = f", {available / 1e9:.1f} GB are free" if available else ""
    if available and kept + working > available:
        fitting = max(int((available - working) // (kept / padded)), 0)
        raise UserError(
            f"{lanes} lanes need {(kept + working) / 1e9:.1f} GB{each}, {available / 1e9:.1f} GB are free: "
            f"train at most {fitting} at once, or lower --sizes.replay-capacity"
        )
    return (
        f"{group.guidance.name}: {lanes} lanes, {kept * devices / padded / 1e6:.1f} MB a seed at rest, "
        f"{(kept + working) / 1e9:.2f} GB in all while training{each}{limit}"
    )
