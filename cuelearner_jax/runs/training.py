"""Training of one kind of guidance, from the first label to the last step; and what a checkpoint holds of it."""

from __future__ import annotations

import time
from collections.abc import Iterator
from fnmatch import fnmatchcase
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from cuelearner_jax.asking import blame, label_slots
from cuelearner_jax.devices import SHARED, place
from cuelearner_jax.environment import Environment, view_of
from cuelearner_jax.evaluate import episodes
from cuelearner_jax.loop import Clock, TrainState, start_clock
from cuelearner_jax.policies import Agent, Guided, PolicyNode, asked_from
from cuelearner_jax.runs.lanes import LaneGroup
from cuelearner_jax.storage import label_files, results
from cuelearner_jax.storage.checkpoint import Checkpoints
from cuelearner_jax.types import Label, Teacher


def items(blocks: list[TrainState], clock: Clock, wall: float) -> dict[str, Any]:
    """Return a run's state as checkpoint items; acting needs only the first, the last gives the cut of lanes."""
    return {
        "policy": [{"params": block.agent.params, "guidance": block.guide.model} for block in blocks],
        "rest": [
            block.replace(agent=block.agent.replace(params=None), guide=block.guide.replace(model=None), failed=None)
            for block in blocks
        ],
        "failed": [block.failed for block in blocks],
        "clock": {
            "clock": clock,
            "wall_s": np.float32(wall),
            "cut": np.array([len(blocks), blocks[0].key.shape[0]], np.int32),
        },
    }


def restore_clock(store: Checkpoints) -> tuple[Clock, float, int, int]:
    """Return the newest checkpoint's clock, seconds of training, number of blocks and lanes of a block."""
    like = {"clock": jax.eval_shape(start_clock), "wall_s": np.float32(0), "cut": np.zeros(2, np.int32)}
    arrays = store.restore({"clock": like})["clock"]
    return arrays["clock"], float(arrays["wall_s"]), *arrays["cut"].tolist()


def ambiguous_names(step: Any) -> list[str]:
    """Return the metrics and outcomes of an environment's step that have the name of another column of results."""
    names, columns = [*step.metrics, *step.outcome], {"reward", "finished", *results.MEANINGS} - {"*"}
    return [name for name in names if names.count(name) > 1 or any(fnmatchcase(name, one) for one in columns)]


class Training:
    """The state of a group of lanes in training, and its next stretches.

    Between two stretches `clock`, `blocks` and `wall` are the whole state.
    """

    def __init__(self, group: LaneGroup, eval_env: Environment, split: str) -> None:
        """Start at the beginning. `eval_env`, `split`: world and episodes of evaluations, see `evaluate.SPLITS`."""
        self.group, self.split = group, split
        self.eval_env = place(group.mesh, eval_env, SHARED)
        self.clock: Clock = place(group.mesh, start_clock(), SHARED)
        self.blocks: list[TrainState] = []
        self.wall = 0.0  # seconds of labelling and training so far

    def restore(self, store: Checkpoints) -> None:
        """Continue from the newest checkpoint, in this group's cut of the lanes. Raises as `Checkpoints.restore`."""
        group, (clock, self.wall, count, size) = self.group, restore_clock(store)
        self.clock = place(group.mesh, clock, SHARED)
        cut = np.minimum(np.arange(count * size), len(group.seeds) - 1).reshape(count, size)
        shapes = items(group.shapes_of(cut), jax.eval_shape(start_clock), 0.0)
        arrays = store.restore({name: shapes[name] for name in ("policy", "rest", "failed")})
        blocks = [
            rest.replace(
                agent=rest.agent.replace(params=policy["params"]),
                guide=rest.guide.replace(model=policy["guidance"]),
                failed=mask,
            )
            for policy, rest, mask in zip(arrays["policy"], arrays["rest"], arrays["failed"], strict=True)
        ]
        self.blocks = group.recut(blocks)

    @property
    def step(self) -> int:
        """Environment steps of each lane so far."""
        return int(self.clock.step)

    @property
    def round(self) -> int:
        """Label rounds so far."""
        return int(self.clock.round)

    @property
    def labelled(self) -> bool:
        """Whether all questions have been asked."""
        return not self.group.guidance.asks or self.round >= self.group.rounds

    @property
    def failed(self) -> np.ndarray:
        """Mask (lanes,) of lanes that are no longer finite; they keep their last finite state."""
        return self.group.columns([{"failed": block.failed} for block in self.blocks])["failed"]

    def label_rounds(self, teacher: Teacher) -> Iterator[int]:
        """Ask a simulated teacher for all labels, round by round; yield the number of rounds so far."""
        while not self.labelled:
            start = time.perf_counter()
            self.clock, self.blocks = self.group.label_round(teacher, self.clock, self.blocks)
            self.wall += time.perf_counter() - start
            if self.failed.all():
                blame(self.group.env, teacher, jax.tree.map(lambda leaf: leaf[0], self.blocks[0].guide))
            yield self.round

    def take(self, file: label_files.LabelFile) -> None:
        """Take a file's labels in place of questions, and fit once."""
        group = self.group
        slots = label_slots(group.largest_budget, group.config.sizes)
        rows = [label_files.for_lanes(file, *lanes, slots) for lanes in group.blocks()]
        self.blocks = group.take_labels(jax.tree.map(jnp.asarray, rows), self.blocks)
        self.clock = place(group.mesh, self.clock.replace(round=jnp.asarray(group.rounds, jnp.int32)), SHARED)

    def guides(self, before: int) -> dict[str, Any]:
        """Return the columns of an evaluation of the guides alone after the rounds since `before`.

        Scalars, or one entry for each lane whose guide is due, see `LaneGroup.due_guides`. Empty: none is due.
        """
        group, rounds = self.group, self.round
        due = group.due_guides(rounds, before)
        if not due.any():
            return {}
        own = {"round": rounds, "step": self.step, "wall_s": self.wall}
        each = {"seed": group.seeds, "labels": group.budgets, "asked": group.label_counts(rounds)}
        each |= {"failed": self.failed.astype(float), **self.guide_alone()}
        return {**own, **{name: values[due] for name, values in each.items()}}

    def labels(self) -> tuple[np.ndarray, Label]:
        """Return seeds (lanes,) and labels (lanes, slots, ...) of the largest budget's lanes.

        Lanes of smaller budgets hold the first of these labels.
        """
        group = self.group
        labels = [jax.device_get(block.guide.labels) for block in self.blocks]
        rows = jax.tree.map(lambda *leaves: np.concatenate(leaves)[: len(group.seeds)], *labels)
        largest = group.budgets == group.largest_budget
        return group.seeds[largest], jax.tree.map(lambda leaf: leaf[largest], rows)

    def stretches(self) -> Iterator[dict[str, Any]]:
        """Train to the end; yield the columns of each evaluation: before the first step and after every stretch."""
        group, schedule = self.group, self.group.config.schedule
        if self.step == 0:
            yield {**self.evaluation(), **self.guide_alone()}
        iterations = schedule.eval_every // group.config.sizes.num_envs
        while self.step < schedule.total_steps:
            start = time.perf_counter()
            self.clock, self.blocks, metrics = group.train(self.clock, self.blocks, iterations)
            self.wall += time.perf_counter() - start
            columns = group.columns([{f"train_{name}": v for name, v in block.items()} for block in metrics])
            yield {**self.evaluation(), **self._of_finite(columns)}

    def evaluation(self) -> dict[str, Any]:
        """Return the columns of one evaluation of all agents: scalars, or (lanes,) with NaN for failed lanes."""
        group, view = self.group, view_of(self.eval_env)
        own = {"seed": group.seeds, "labels": group.budgets, "step": self.step, "wall_s": self.wall}
        own |= {"failed": self.failed.astype(float), "episodes": group.config.schedule.eval_envs}
        return {**own, **self._evaluate(lambda lane: Agent(lane.agent.params, group.config.agent_in(view), view))}

    def policies(self, view: Any) -> PolicyNode:
        """The finished policies of all lanes as they stand, for a world of that view."""
        params = [lane.agent.params for lane in self.blocks]
        whole = jax.tree.map(lambda *leaves: np.concatenate([np.asarray(leaf) for leaf in leaves]), *params)
        return Agent(whole, self.group.config.agent_in(view), view)

    def guide_alone(self) -> dict[str, np.ndarray]:
        """Return metrics (lanes,) of the actions that questions begin with, under guidance; without that, of chance."""
        group, base = self.group, asked_from(self.group.env, self.group.config.sizes)

        def guide(lane: TrainState) -> PolicyNode:
            return Guided(base, lane.guide.model, view_of(self.eval_env), group.config.scalars, group.guidance)

        return {f"guide_{name}": values for name, values in self._evaluate(guide).items() if values.ndim == 1}

    def _evaluate(self, policy_of: Any) -> dict[str, np.ndarray]:
        schedule, key = self.group.config.schedule, episodes(self.split)
        size = (schedule.eval_envs, schedule.eval_steps)
        return self._of_finite(self.group.evaluate(policy_of, self.eval_env, key, *size, self.blocks))

    def _of_finite(self, columns: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
        """Replace failed lanes' metrics (lanes, ...) by NaN, so that they never enter a mean unnoticed."""
        return {name: np.where(self.failed, np.nan, values.T).T for name, values in columns.items()}


def mean_of_finite(values: np.ndarray) -> str:
    """Format the mean of a metric (lanes,) over the finite lanes, for a progress bar."""
    there = values[np.isfinite(values)]
    return f"{there.mean():.3f}" if len(there) else "-"
