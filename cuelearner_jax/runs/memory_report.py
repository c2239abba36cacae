"""Estimate the memory that lanes need, before anything is computed."""

from __future__ import annotations

from typing import Any

import jax
import numpy as np

from cuelearner_jax.asking import label_slots
from cuelearner_jax.devices import portions
from cuelearner_jax.environment import spaces_of
from cuelearner_jax.errors import UserError
from cuelearner_jax.guides.base import Footprint
from cuelearner_jax.loop import TrainState
from cuelearner_jax.runs.lanes import LaneGroup
from cuelearner_jax.storage.room import free_bytes

FLOAT = 4  # bytes
METRICS = 16  # most metrics of an evaluation's step
COPIES = 3  # of environments while stepping, and of worlds: training, evaluation, and during generation


def state_bytes(tree: Any) -> int:
    """Return the memory of a tree of arrays or shapes [bytes]."""
    return sum(int(np.prod(leaf.shape)) * leaf.dtype.itemsize for leaf in jax.tree.leaves(tree))


def memory_report(group: LaneGroup) -> str:
    """Return one line on the memory that the lanes need per device. Raises UserError if more than is free."""
    block = group.shapes_of(group.cut[:1])[0]  # the blocks have equal shapes
    count, width = group.cut.shape
    lanes, devices = len(group.seeds), group.mesh.size
    guide = group.guidance.footprint(group.env)
    kept = {option: count * size // devices for option, size in _at_rest(block, guide).items()}
    examined = group.at_once if jax.default_backend() == "cpu" else min(group.at_once, portions().agents)
    worked = {option: size * group.at_once for option, size in _training(group, block, guide).items()}
    worked |= {option: size * examined for option, size in _evaluating(group, block, guide).items()}
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


def _at_rest(block: TrainState, layers: Footprint) -> dict[str, int]:
    """Return the memory that a block keeps [bytes], by the option that determines it."""
    agent, guide = block.agent, block.guide
    parts = {
        "--agent.replay-capacity": (agent.replay, agent.guided),
        "--labels": (guide.labels, guide.stored),
        "--sizes.num-envs": (agent.env, agent.obs, block.arbiter),
        "--sizes.candidates": (guide.env, guide.obs),
        layers.option: guide.model,
    }
    found = {option: state_bytes(part) for option, part in parts.items()}
    return {**found, "the networks of --agent": state_bytes(block) - sum(found.values())}


def _training(group: LaneGroup, block: TrainState, guide: Footprint) -> dict[str, int]:
    """Return one lane's further memory in each kind of work [bytes], by option; the kinds alternate."""
    sizes, schedule = group.config.sizes, group.config.schedule
    agent = group.config.agent.make(sizes.frame, spaces_of(group.env), group.config.bootstraps)
    needed = {option: FLOAT * number for option, number in agent.working(sizes.num_envs, portions().actions).items()}
    needed["--schedule.eval-every"] = 3 * FLOAT * (schedule.eval_every // sizes.num_envs)
    if group.largest_budget:
        obs = state_bytes(block.guide.obs) // (block.key.shape[0] * sizes.candidates)
        seen = COPIES * (obs + FLOAT * guide.inputs)
        needed["--sizes.fit-batch-size"] = (
            sizes.ensemble * sizes.fit_batch_size * (3 * FLOAT * sum(guide.layers) + seen)
        )
        needed["--sizes.fit-steps"] = 2 * FLOAT * sizes.fit_steps
        slots = label_slots(group.largest_budget, sizes)
        widest = FLOAT * sizes.ensemble * max(guide.layers)
        if guide.searched:
            option, count = guide.searched
            needed[option] = 4 * widest * min(sizes.num_envs * count, max(portions().actions, count))
        needed[guide.option] = 4 * widest * sizes.num_envs
        needed["--labels and --sizes.labels-per-round"] = slots * (2 * widest + FLOAT * guide.inputs)
        situation = state_bytes((block.guide.env, block.guide.obs)) // block.key.shape[0]
        needed["--sizes.candidates"] = COPIES * situation + 2 * sizes.candidates * widest
    return needed


def _evaluating(group: LaneGroup, block: TrainState, guide: Footprint) -> dict[str, int]:
    """Return the memory of one lane's evaluations [bytes], by option."""
    schedule = group.config.schedule
    lanes = block.key.shape[0] * group.config.sizes.candidates
    situation = state_bytes((block.guide.env, block.guide.obs)) // lanes
    return {
        "--schedule.eval-envs": schedule.eval_envs * (COPIES * situation + 2 * FLOAT * max(guide.layers)),
        "--schedule.eval-steps": METRICS * FLOAT * (schedule.eval_steps // schedule.eval_envs),
    }
