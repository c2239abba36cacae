"""Train one group of lanes into a run's folder, resuming where the folder stands."""

from __future__ import annotations

from contextlib import nullcontext
from threading import Event
from typing import Any

import numpy as np
from rich.progress import Progress

from cuelearner_jax import config as configuration
from cuelearner_jax.environment import Environment, actions_of
from cuelearner_jax.runs.failures import name_lanes
from cuelearner_jax.runs.grid import config_hash, run_key
from cuelearner_jax.runs.lanes import LaneGroup
from cuelearner_jax.runs.order import Order
from cuelearner_jax.runs.training import Training, items, mean_of_finite
from cuelearner_jax.storage import label_files, provenance, results, tracking
from cuelearner_jax.storage import table as tables
from cuelearner_jax.storage.checkpoint import Checkpoints
from cuelearner_jax.storage.table import TableWriter
from cuelearner_jax.terminal import Interrupted, console
from cuelearner_jax.types import Teacher

ROUNDS_A_CHUNK = 10  # label rounds between two checkpoints


class Runner:
    """Writes a `Training`'s labels, rows and checkpoints to disk."""

    def __init__(
        self, group: LaneGroup, env: Environment, order: Order, config: dict[str, Any], stopping: Event, bars: Progress
    ) -> None:
        """Prepare without starting. `env`: of evaluations. `config`: of config.json. `stopping`: set by Ctrl-C."""
        self.training = Training(group, env, order.split)
        self.group, self.order, self.contents = group, order, config
        self.stopping, self.bars = stopping, bars
        self.name = group.guidance.name
        self.folder = order.out / self.name
        self.key = run_key(config, self.name)
        self.failed = np.zeros(len(group.seeds), bool)  # lanes whose failure has been reported

    def run(self, teacher: Teacher | None, labels: label_files.LabelFile | None, ahead: float = 0) -> None:
        """Train to the end, with a file's labels or the teacher's. Raises Interrupted once everything is saved.

        `ahead`: how many times as much work comes after this group.
        """
        if (self.folder / results.PARQUET).exists():
            self._check_rows(self.group.config.schedule.total_steps)
            console.print(f"{self.name}: finished before, left as it is")
            return
        asks = self.group.guidance.asks
        total, self._ahead = self.group.config.schedule.total_steps, ahead
        self._bar = self.bars.add_task(self.name, total=total, note="preparing")
        with Checkpoints(self.folder / "checkpoints", run=self.key) as store:
            self._restore(store)
            about, order = {"run": self.key}, self.order
            constants = {"run": order.out.name, "task": order.task.name, "guidance": self.name, "split": order.split}
            constants |= {"config_hash": config_hash(self.contents), **provenance.provenance()}
            constants |= self.contents.get("setting", {})
            with (
                TableWriter(self.folder, results.SCHEMA, constants, about) as writer,
                TableWriter(self.folder, results.GUIDES, constants, about) if asks else nullcontext() as guides,
                tracking.open_tracker(order.track, self.folder, self.contents, self.training.step) as log,
            ):
                if guides is not None:
                    self._label(store, guides, teacher, labels)
                self._train(store, writer, log)
        if asks:
            tables.finish(self.folder, results.GUIDES)
        tables.finish(self.folder, results.SCHEMA)  # last, since a kind with finished results counts as finished

    def _restore(self, store: Checkpoints) -> None:
        """Restore the newest checkpoint, or start afresh; drop the rows after it."""
        last_step = last_round = -1
        if store.latest() is None:
            self.training.blocks = self.group.start()
        else:
            self.training.restore(store)
            self.failed = self.training.failed
            last_step = self.training.step or -1  # a checkpoint of labels alone precedes the rows of step 0
            last_round = self.training.round
        self._check_rows(last_step)
        tables.truncate(self.folder, results.SCHEMA, keep=lambda row: row["step"] <= last_step)
        tables.truncate(self.folder, results.GUIDES, keep=lambda row: row["round"] <= last_round)

    def _check_rows(self, step: int) -> None:
        """Raise UserError unless the folder's tables are of this run, and hold the rows of each lane up to a step."""
        evaluations = step // self.group.config.schedule.eval_every + 1
        results.check_complete(self.folder, step, len(self.group.seeds) * evaluations, self.key)

    def _save(self, store: Checkpoints) -> None:
        now = self.training
        store.save(now.round + now.step, items(now.blocks, now.clock, now.wall))

    def _stop_on_signal(self, store: Checkpoints) -> None:
        if self.stopping.is_set():
            self._save(store)
            step = self.training.step
            raise Interrupted(f"stopped at step {step} of {self.name}; go on with the same command and --resume")

    def _tell_failed(self, when: str) -> None:
        new, group = self.training.failed & ~self.failed, self.group
        if new.any():
            names = name_lanes(group.seeds[new], group.budgets[new])
            outcome = "kept at the last finite state, marked as failed"
            console.print(f"{self.name}: {names} no longer finite {when}: {outcome}")
        self.failed = self.training.failed

    def _label(
        self, store: Checkpoints, guides: TableWriter, teacher: Teacher | None, labels: label_files.LabelFile | None
    ) -> None:
        """Take the labels of a file, or ask for missing ones; write the label file anew, since a kill may tear it."""
        now, asks = self.training, not self.training.labelled
        if asks:
            bar = self.bars.add_task(f"{self.name}: labels", total=self.group.rounds, note="", completed=now.round)
            if labels is not None:
                now.take(labels)
                self._tell_failed("after its labels")
                if row := now.guides(before=0):
                    guides.append(**row)
            else:
                assert teacher is not None  # `teacher` may be None only where a file was given
                for number in now.label_rounds(teacher):
                    self.bars.update(bar, completed=number)
                    self._tell_failed(f"after {number * self.group.config.sizes.labels_per_round} labels")
                    if row := now.guides(before=number - 1):
                        guides.append(**row)
                    if number % ROUNDS_A_CHUNK == 0:
                        self._save(store)
                    self._stop_on_signal(store)
        self._write_labels()
        if asks:
            self._save(store)

    def _write_labels(self) -> None:
        form, config = self.group.guidance.form, self.group.config
        assert form is not None
        task = {"name": self.order.task.name, **configuration.to_json(config.task)}
        seeds, labels = self.training.labels()
        eps, space = config.scalars.eps_deg if form.by_eps else None, actions_of(self.group.env)
        file, more = self.folder / label_files.PARQUET, {"meaning": form.meaning(space), "run": self.key}
        label_files.write(file, task, form.name, space, eps, seeds, labels, **more)

    def _train(self, store: Checkpoints, writer: TableWriter, log: tracking.Log | None) -> None:
        now, schedule = self.training, self.group.config.schedule
        self.bars.reset(self._bar, completed=now.step, begun=now.step, ahead=self._ahead, note="")
        is_to_act = self.group.guidance.moves and schedule.guidance_until and not self.group.config.sizes.store_labelled
        never_acts = is_to_act and now.step == 0
        for row in now.stretches():
            writer.append(**row)
            never_acts &= not np.any(row.get("train_guided_share", 0))
            if log is not None:
                log(now.step, tracking.means(row))
            self._tell_failed(f"at step {now.step:,}")
            if now.step == 0:
                continue
            self.bars.update(self._bar, completed=now.step, note=f"reward {mean_of_finite(row['reward'])}")
            if now.step % schedule.checkpoint_every == 0 or now.step >= schedule.total_steps:
                self._save(store)
            self._stop_on_signal(store)
        if never_acts:
            until = f"before step {schedule.guidance_until:,}, where guidance ends"
            console.print(f"{self.name}: no guided episode began {until}: it never acted")
