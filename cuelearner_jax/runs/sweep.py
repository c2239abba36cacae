"""A grid of runs in one process: kinds of guidance in turn, their lanes (seeds x label budgets) vmapped, resumable."""

from __future__ import annotations

import dataclasses
import json
import math
import signal
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from cuelearner_jax import config as configuration
from cuelearner_jax.config import RunConfig
from cuelearner_jax.devices import SHARED, lane_mesh, place
from cuelearner_jax.environment import Environment
from cuelearner_jax.errors import UserError
from cuelearner_jax.evaluate import episodes, evaluate_agents, evaluate_guides
from cuelearner_jax.guidance import registry as guidances
from cuelearner_jax.records import label_files, results
from cuelearner_jax.records.checkpoint import Checkpoints, checkpoints
from cuelearner_jax.runs.grid import Grid, check_folder, check_grid, claimed, describe, prepare_folder
from cuelearner_jax.runs.lanes import Group, items, memory_report, restore
from cuelearner_jax.runs.shards import Shard
from cuelearner_jax.task import Task, shape_of
from cuelearner_jax.train import label_slots, start_clock
from cuelearner_jax.types import Teacher

ROUNDS_A_CHUNK = 10  # label rounds between two checkpoints

console = Console(stderr=True, highlight=False, soft_wrap=True)


class Interrupted(Exception):
    """The user asked to stop; everything is saved."""

    status = 130  # that a command ends with


def run(
    task: Task,
    config: RunConfig,
    grid: Grid,
    out: Path,
    *,
    resume: bool = False,
    overwrite: bool = False,
    labels_from: Path | None = None,
    shard: Shard | None = None,
    split: str = "validation",
) -> None:
    """Trains every lane of the grid and leaves the results in `out`, measured on the episodes of `split`.

    With `shard`, trains its share of the seeds alone, in its own folder below `out`, from wherever that stands.

    Raises:
        UserError: bad configuration, a folder in use, too little memory; nothing has been changed then.
        Interrupted: Ctrl-C; everything is saved.
    """
    plan = planned(
        task, config, grid, out, resume=resume, overwrite=overwrite, labels_from=labels_from, shard=shard, split=split
    )
    grid, out, labels, described = plan.grid, plan.out, plan.labels, plan.described
    kinds = [guidances.make(kind, config.sizes, shape_of(task, config.task).obs_size) for kind in grid.guidance]
    mesh = lane_mesh()
    env = place(mesh, task.environment(config.task), SHARED)
    for kind in kinds:
        console.print(memory_report(Group(config, env, kind, grid)))
    asked = any(kind.asks for kind in kinds) and labels is None
    teacher = place(mesh, task.make_teacher(config.task, env), SHARED) if asked else None
    examined = task.environment(config.task, split)
    with claimed(out), interruptible() as stopping, progress_bars() as bars:
        prepare_folder(out, described, overwrite and not plan.resume)
        for kind in kinds:
            _Runner(Group(config, env, kind, grid), examined, task, out, stopping, bars).run(teacher, labels)


class Plan(NamedTuple):
    """What a run will do, found to make sense; nothing has been written."""

    grid: Grid
    out: Path
    described: dict[str, Any]
    labels: label_files.LabelFile | None
    resume: bool

    @property
    def finished(self) -> bool:
        """Is there nothing left to do?"""
        return self.done == 1

    @property
    def done(self) -> float:
        """Share of the steps that have been taken, as its results say."""
        folders = [self.out / kind for kind in self.grid.guidance]
        total = self.described["total_steps"]
        shares = [1 if (f / results.PARQUET).exists() else 0.99 * results.last_step(f) / total for f in folders]
        return sum(shares) / len(shares)


def planned(
    task: Task,
    config: RunConfig,
    grid: Grid,
    out: Path,
    *,
    resume: bool = False,
    overwrite: bool = False,
    labels_from: Path | None = None,
    shard: Shard | None = None,
    split: str = "validation",
) -> Plan:
    """What `run` does with the same arguments. Raises UserError for what it would refuse, but for too little memory."""
    configuration.check(config)
    check_grid(grid)
    if shard:
        shard.check_sweep(out)
        grid, out = dataclasses.replace(grid, seeds=shard.seeds(grid.seeds)), shard.folder(out)
        resume = resume or (not overwrite and (out / "config.json").is_file())
    labels = read_labels(labels_from, task, config, grid) if labels_from else None
    described = describe(task, config, grid, split, labels_from, shard)
    check_folder(out, described, resume, overwrite)
    return Plan(grid, out, described, labels, resume)


def read_labels(path: Path, task: Task, config: RunConfig, grid: Grid) -> label_files.LabelFile:
    """A label file that fits the task and the grid. Raises UserError if it does not."""
    file = label_files.read(path)
    env = shape_of(task, config.task)
    if file.task.get("name") != task.name or file.labels.obs.shape[1] != env.obs_size:
        raise UserError(
            f"{path} holds labels of {file.task.get('name')} with {file.labels.obs.shape[1]} observations, "
            f"this run is {task.name} with {env.obs_size}: give labels of the same task"
        )
    asking = [kind for kind in grid.guidance if guidances.make(kind, config.sizes, env.obs_size).asks]
    if not asking:
        raise UserError("--labels-from needs a guidance that uses labels: add --guidance relative")
    if asking != [file.guidance]:
        raise UserError(f"{path} holds {file.guidance} labels, the run uses {', '.join(asking)}: give fitting labels")
    if not math.isclose(file.eps_deg, config.scalars.eps_deg, rel_tol=1e-6):
        raise UserError(
            f"{path} holds labels of {file.eps_deg:g} degrees, the run's are of {config.scalars.eps_deg:g}: "
            f"give --scalars.eps-deg {file.eps_deg:g}, or other labels"
        )
    for kind in asking:
        seeds, budgets = grid.lanes(guidances.make(kind, config.sizes, env.obs_size))
        label_files.for_lanes(file, seeds, budgets, label_slots(int(budgets.max()), config.sizes))
    return file


@contextmanager
def interruptible() -> Iterator[threading.Event]:
    """An event that the first Ctrl-C sets; a second one stops at once, losing what was not saved."""
    stopping = threading.Event()

    def stop(number: int, frame: Any) -> None:
        if stopping.is_set():
            raise KeyboardInterrupt
        stopping.set()
        console.print("stopping after this stretch of steps (Ctrl-C again: at once)")

    if threading.current_thread() is not threading.main_thread():
        yield stopping
        return
    before = signal.signal(signal.SIGINT, stop)
    try:
        yield stopping
    finally:
        signal.signal(signal.SIGINT, before)


@contextmanager
def progress_bars() -> Iterator[Progress]:
    """Progress bars on standard error."""
    columns = (
        TextColumn("{task.description:<12}"),
        BarColumn(),
        MofNCompleteColumn(),
        TextColumn("{task.fields[note]}"),
        TimeRemainingColumn(),
    )
    with Progress(*columns, console=console) as bars:
        yield bars


class _Runner:
    """Runs one group: labels, then training, with evaluation, rows and checkpoints between jitted stretches."""

    def __init__(
        self, group: Group, examined: Environment, task: Task, out: Path, stopping: threading.Event, bars: Progress
    ) -> None:
        self.group, self.task, self.stopping, self.bars = group, task, stopping, bars
        self.mesh = group.mesh
        self.examined = place(self.mesh, examined, SHARED)  # the environment of evaluations
        self.out = out
        self.folder = out / group.guidance.name
        self.split = json.loads((out / "config.json").read_text())["split"]
        self.clock, self.blocks, self.wall = place(self.mesh, start_clock(), SHARED), [], 0.0

    def run(self, teacher: Teacher | None, labels: label_files.LabelFile | None) -> None:
        """From wherever the group stands to its end."""
        if (self.folder / results.PARQUET).exists():
            console.print(f"{self.group.guidance.name}: finished before, left as it is")
            return
        with checkpoints(self.folder / "checkpoints") as saved:
            self._restore(saved)
            with results.ResultsWriter(self.folder, **self._constants()) as writer:
                self._label(saved, teacher, labels)
                self._train(saved, writer)
        results.finish(self.folder)

    def _constants(self) -> dict[str, Any]:
        config = json.loads((self.out / "config.json").read_text())
        for name in ("grid", "shard"):  # do not change what a lane learns
            config.pop(name, None)
        config["task"].pop("from", None)  # nor does where the task's code lies
        return {
            "run": self.out.name,
            "task": self.task.name,
            "guidance": self.group.guidance.name,
            "split": self.split,
            "config_hash": configuration.digest(config),
            **results.provenance(),
        }

    def _items(self) -> dict[str, Any]:
        return items(self.blocks, self.clock, self.wall)

    def _restore(self, saved: Checkpoints) -> None:
        """The newest checkpoint, or a fresh start; rows past it are dropped."""
        if saved.latest() is None:
            self.blocks = self.group.start()
            results.truncate_after(self.folder, -1)
            return
        found = restore(self.group, saved, "policy", "rest")
        blocks = [rest.replace(**policy) for policy, rest in zip(found["policy"], found["rest"], strict=True)]
        self.blocks = self.group.recut(blocks)
        self.clock, self.wall = place(self.mesh, found["clock"]["clock"], SHARED), float(found["clock"]["wall_s"])
        # A checkpoint of the labels alone comes before the rows of step 0.
        results.truncate_after(self.folder, int(self.clock.step) if int(self.clock.step) else -1)

    def _save(self, saved: Checkpoints) -> None:
        saved.save(int(self.clock.round) + int(self.clock.step), self._items())

    def _stop_if_asked(self, saved: Checkpoints) -> None:
        if self.stopping.is_set():
            self._save(saved)
            raise Interrupted(
                f"stopped at step {int(self.clock.step)} of {self.group.guidance.name}; "
                "go on with the same command and --resume"
            )

    def _label(self, saved: Checkpoints, teacher: Teacher | None, labels: label_files.LabelFile | None) -> None:
        """Asks the teacher, or takes the labels of a file."""
        group, rounds = self.group, self.group.rounds
        labelled = int(self.clock.round) >= rounds
        if not group.guidance.asks or (labelled and (self.folder / "labels.parquet").exists()):
            return
        bar = self.bars.add_task(
            f"{group.guidance.name}: labels", total=rounds, note="", completed=int(self.clock.round)
        )
        if labels is not None and not labelled:
            self._take(labels)
        while int(self.clock.round) < rounds:
            started = time.perf_counter()
            done = group.each(
                lambda block: group.program.label_round(group.env, teacher, group.config.scalars, self.clock, block),
                self.blocks,
            )
            self.clock, self.blocks = jax.block_until_ready(done[0][0]), [block for _, block in done]
            self.wall += time.perf_counter() - started
            self.bars.update(bar, completed=int(self.clock.round))
            if int(self.clock.round) % ROUNDS_A_CHUNK == 0:
                self._save(saved)
            self._stop_if_asked(saved)
        self._write_labels()
        self._save(saved)

    def _take(self, file: label_files.LabelFile) -> None:
        """Labels from a file instead of a teacher, fitted once."""
        group = self.group
        slots = label_slots(group.largest_budget, group.config.sizes)
        for index, (seeds, budgets) in enumerate(group.blocks()):
            rows = jax.tree.map(jnp.asarray, label_files.for_lanes(file, seeds, budgets, slots))
            self.blocks[index] = group.program.take_labels(group.env, group.config.scalars, rows, self.blocks[index])
        taken = self.clock.replace(round=jnp.asarray(group.rounds, jnp.int32))
        self.clock = place(self.mesh, taken, SHARED)

    def _write_labels(self) -> None:
        group = self.group
        labels = [jax.device_get(block.asking.labels) for block in self.blocks]
        rows = jax.tree.map(lambda *leaves: np.concatenate(leaves)[: len(group.seeds)], *labels)
        largest = group.budgets == group.largest_budget  # the other lanes hold the first of these
        rows = jax.tree.map(lambda leaf: leaf[largest], rows)
        task = {"name": self.task.name, **configuration.to_json(group.config.task)}
        eps, seeds = group.config.scalars.eps_deg, group.seeds[largest]
        label_files.write(self.folder / "labels.parquet", task, group.guidance.name, eps, seeds, rows)

    def _train(self, saved: Checkpoints, writer: results.ResultsWriter) -> None:
        group, schedule = self.group, self.group.config.schedule
        bar = self.bars.add_task(
            group.guidance.name, total=schedule.total_steps, note="", completed=int(self.clock.step)
        )
        if int(self.clock.step) == 0:
            writer.append(**self._row({}), **self._guide_alone())
        iterations = schedule.eval_every // group.config.sizes.num_envs
        while int(self.clock.step) < schedule.total_steps:
            started = time.perf_counter()
            done = group.each(
                lambda block: group.program.train(
                    group.env, group.config.scalars, schedule, self.clock, block, iterations
                ),
                self.blocks,
            )
            self.clock, self.blocks = jax.block_until_ready(done[0][0]), [block for _, block, _ in done]
            metrics = [measured for _, _, measured in done]
            self.wall += time.perf_counter() - started
            row = self._row(group.lanes([{f"train_{k}": v for k, v in block.items()} for block in metrics]))
            writer.append(**row)
            self.bars.update(bar, completed=int(self.clock.step), note=f"reward {np.mean(row['reward']):.3f}")
            if int(self.clock.step) % schedule.checkpoint_every == 0 or int(self.clock.step) >= schedule.total_steps:
                self._save(saved)
            self._stop_if_asked(saved)

    def _row(self, extra: dict[str, np.ndarray]) -> dict[str, Any]:
        """The columns of one evaluation of all lanes."""
        group, schedule = self.group, self.group.config.schedule
        measured = group.each(
            lambda block: evaluate_agents(
                self.examined,
                block.params,
                episodes(self.split),
                mesh=self.mesh,
                sizes=group.config.sizes,
                num_envs=schedule.eval_envs,
                steps=schedule.eval_steps,
            ),
            self.blocks,
        )
        own = {"seed": group.seeds, "labels": group.budgets, "step": int(self.clock.step), "wall_s": self.wall}
        return {**own, **group.lanes(measured), **extra}

    def _guide_alone(self) -> dict[str, np.ndarray]:
        """Metrics of uniform actions under guidance; for unguided lanes that is chance."""
        group, schedule = self.group, self.group.config.schedule
        measured = group.each(
            lambda block: evaluate_guides(
                self.examined,
                block.guidance,
                episodes(self.split),
                group.config.scalars,
                mesh=self.mesh,
                guidance=group.guidance,
                num_envs=schedule.eval_envs,
                steps=schedule.eval_steps,
            ),
            self.blocks,
        )
        return {f"guide_{name}": values for name, values in group.lanes(measured).items()}
