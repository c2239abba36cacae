"""The memory that lanes need, told before anything is made."""

from __future__ import annotations

from typing import Any

import jax
import numpy as np

from cuelearner_jax.agent.choice import looked_at
from cuelearner_jax.asking import label_slots
from cuelearner_jax.devices import portions
from cuelearner_jax.errors import UserError
from cuelearner_jax.runs.free_memory import free_bytes
from cuelearner_jax.runs.lanes import LaneGroup
from cuelearner_jax.types import TrainState

FLOAT = 4  # bytes
METRICS = 16  # of an evaluation's step, at most
COPIES = 3  # of environments while they step, and of worlds: of training, of evaluation, and while they are made


def state_bytes(tree: Any) -> int:
    """Memory of a tree of arrays or shapes [bytes]."""
    return sum(int(np.prod(leaf.shape)) * leaf.dtype.itemsize for leaf in jax.tree.leaves(tree))


def memory_report(group: LaneGroup) -> str:
    """One line on the memory that the lanes need on each device. Raises UserError if it is more than there is."""
    block = group.shapes_of(group.cut[:1])[0]  # the blocks are alike
    count, width = group.cut.shape
    lanes, devices = len(group.seeds), group.mesh.size
    kept = {option: count * size // devices for option, size in _at_rest(block).items()}
    examined = group.at_once if jax.default_backend() == "cpu" else min(group.at_once, portions().agents)
    worked = {option: size * group.at_once for option, size in _training(group, block).items()}
    worked |= {option: size * examined for option, size in _evaluating(group, block).items()}
    worlds = {"--task": COPIES * state_bytes(jax.eval_shape(lambda env: env, group.env))}
    at_rest, working = sum(kept.values()), max(worked.values()) + worlds["--task"]
    each = f" on each of {devices} devices" if devices > 1 else ""
    available = free_bytes()
    limit = f", {available / 1e9:.1f} GB are free" if available else ""
    if available and at_rest + working > available:
        fitting = int((available - working) // (at_rest / (count * width)))
        largest = max([*kept.items(), *worked.items(), *worlds.items()], key=lambda part: part[1])[0]
        remedy = f"train at most {fitting} at once, or lower {largest}" if fitting > 0 else f"lower {largest}"
        raise UserError(
            f"{lanes} lanes need {(at_rest + working) / 1e9:.1f} GB{each}, {available / 1e9:.1f} GB are free: {remedy}"
        )
    return (
        f"{group.guidance.name}: {lanes} lanes, {at_rest * devices / (count * width) / 1e6:.1f} MB a seed at rest, "
        f"{(at_rest + working) / 1e9:.2f} GB in all while training{each}{limit}"
    )


def _at_rest(block: TrainState) -> dict[str, int]:
    """What a block keeps [bytes], by the option that decides it."""
    agent, guide = block.agent, block.guide
    parts = {
        "--sizes.replay-capacity": agent.replay,
        "--labels": guide.labels,
        "--sizes.num-envs": (agent.env, agent.obs, agent.guided),
        "--sizes.candidates": (guide.env, guide.obs),
        "--sizes.feedback-layers": guide.model,
    }
    found = {option: state_bytes(part) for option, part in parts.items()}
    return {**found, "--sizes.q-layers": state_bytes(block) - sum(found.values())}


def _training(group: LaneGroup, block: TrainState) -> dict[str, int]:
    """What one lane takes beside that in each kind of work, of which one is done at a time [bytes], by option."""
    sizes, schedule = group.config.sizes, group.config.schedule
    looked = looked_at(sizes)
    # Activations of the widest pass: the argmax while acting, that inside targets, or a batch with its gradient.
    rows = {
        "--sizes.directions": min(sizes.num_envs * looked, max(portions().actions, looked)),
        "--sizes.batch-size": 3 * sizes.batch_size * len(sizes.q_layers),
    }
    if group.config.bootstraps:
        targets = sizes.batch_size * sizes.target_directions * (2 if sizes.n_step > 1 else 1)
        rows["--sizes.target-directions"] = targets
    needed = {option: 4 * FLOAT * _widest(group) * number for option, number in rows.items()}
    needed["--sizes.n-step"] = 8 * FLOAT * sizes.batch_size * sizes.n_step
    needed["--schedule.eval-every"] = 3 * FLOAT * (schedule.eval_every // sizes.num_envs)
    if group.largest_budget:
        obs = state_bytes(block.guide.obs) // (block.key.shape[0] * sizes.candidates)
        layers = FLOAT * sum(sizes.feedback_layers)
        needed["--sizes.fit-batch-size"] = sizes.ensemble * sizes.fit_batch_size * (3 * layers + COPIES * obs)
        needed["--sizes.fit-steps"] = 2 * FLOAT * sizes.fit_steps
        slots = label_slots(group.largest_budget, sizes)
        valued = min(sizes.num_envs * sizes.guide_directions, max(portions().actions, sizes.guide_directions))
        needed["--sizes.guide-directions"] = 4 * FLOAT * _widest(group) * valued * sizes.ensemble
        needed["--sizes.replay-steps"] = FLOAT * sizes.replay_steps * sizes.fit_batch_size
        widest = FLOAT * sizes.ensemble * max(sizes.feedback_layers)
        needed["--labels and --sizes.labels-per-round"] = slots * 2 * widest
        situation = state_bytes((block.guide.env, block.guide.obs)) // block.key.shape[0]
        needed["--sizes.candidates"] = COPIES * situation + 2 * sizes.candidates * widest
    return needed


def _evaluating(group: LaneGroup, block: TrainState) -> dict[str, int]:
    """The same of evaluations."""
    schedule = group.config.schedule
    lanes = block.key.shape[0] * group.config.sizes.candidates
    situation = state_bytes((block.guide.env, block.guide.obs)) // lanes
    return {
        "--schedule.eval-envs": schedule.eval_envs * (COPIES * situation + 2 * FLOAT * _widest(group)),
        "--schedule.eval-steps": METRICS * FLOAT * (schedule.eval_steps // schedule.eval_envs),
    }


def _widest(group: LaneGroup) -> int:
    return max(*group.config.sizes.q_layers, *group.config.sizes.feedback_layers)
