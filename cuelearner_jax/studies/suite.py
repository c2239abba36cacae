"""The suite: worlds x kinds of guidance x label budgets x teachers; each cell is a request in a folder of its own.

`suite.toml` beside this file says what is run. A cell holds all label budgets and seeds of one kind and one teacher.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from cuelearner_jax import config as configuration
from cuelearner_jax.adaptation import by_model
from cuelearner_jax.environment import actions_of, offers, view_of
from cuelearner_jax.evaluate import group_means
from cuelearner_jax.guides import registry as guidances
from cuelearner_jax.guides.base import HeuristicGuide, NoGuide
from cuelearner_jax.policies import Common
from cuelearner_jax.run_config import RunConfig
from cuelearner_jax.runs.grid import Grid
from cuelearner_jax.runs.order import Order
from cuelearner_jax.runs.policy_sources import LaneChoice, PolicySource
from cuelearner_jax.runs.run_folders import Block
from cuelearner_jax.storage import results
from cuelearner_jax.storage import table as tables
from cuelearner_jax.storage.folders import CONFIG
from cuelearner_jax.storage.provenance import provenance
from cuelearner_jax.studies import evaluate, train
from cuelearner_jax.studies.adapt import AdaptRequest, subject_of
from cuelearner_jax.task import shape_of

TABLE = Path(__file__).with_suffix(".toml")
USES = BOOTSTRAP, ADAPT = "bootstrap", "adapt"
ACTS = NoGuide, HeuristicGuide  # kinds without labels that act in place of a finished policy, or as it does


class World(NamedTuple):
    """A world of the suite."""

    name: str
    use: str  # of labels, one of `USES`
    start: str  # preset of the training, or changed world
    metric: str
    ends: tuple[float, float]  # values of the metric that score 0 and 1
    config: RunConfig
    source: PolicySource  # the policy to adapt; to bootstrap, the task alone
    sizes: Mapping[str, Any]  # to adapt: sizes of the guide, other than the defaults of `cuelearner adapt`
    bound: float | None  # to adapt, judged by episodes: the largest correction, in the space's unit


class Cell(NamedTuple):
    """All lanes of a world under one kind of guidance and one teacher."""

    world: World
    teacher: str
    faults: dict[str, Any]  # fields of `TeacherFaults`; the bias is in eps
    kind: str
    labels: tuple[int, ...]
    seeds: int

    @property
    def name(self) -> str:
        """The folder of the cell, below the suite's."""
        return f"{self.world.use}/{self.world.name}/{self.teacher}/{self.kind}"

    def obstacle(self) -> str | None:
        """Return the rule by which the cell is left out, in words; None: the cell makes sense."""
        guide, world = guidances.find(self.kind), self.world
        env = shape_of(world.source.task, world.config.task)
        cues, is_adapted = actions_of(env).cues, world.use == ADAPT
        absent = [need for need in guide.needs if not offers(env, need)]
        is_base = guide is HeuristicGuide and world.source.default_policy == HeuristicGuide.name
        names_cues = len(cues) > 1 and (guide.form is None or guide.form.by_eps)
        rules = {
            f"{self.kind} corrects finished policies only": guide.adapts_only and not is_adapted,
            f"{self.kind} needs actions with cues": guide.needs_cues and not cues,
            f"{self.kind} needs worlds with {', '.join(absent)}": absent,
            f"{self.kind} asks nothing about a finished policy": is_adapted and not guide.asks and guide not in ACTS,
            f"the policy to adapt is {self.kind} itself": is_adapted and is_base,
            "kinds without labels meet no teacher, so they run once": self.faults and not guide.asks,
            "one cue at a time is no fault where actions have one, or answers name none": "says" in self.faults
            and not names_cues,
        }
        return next((words for words, holds in rules.items() if holds), None)

    def config(self) -> RunConfig:
        """Return the configuration with the teacher's faults."""
        scalars = self.world.config.scalars
        bias = {name: value * scalars.eps_deg for name, value in self.faults.items() if name == "teacher_bias_deg"}
        return replace(self.world.config, scalars=replace(scalars, **self.faults | bias))

    def run(self, out: Path) -> None:
        """Run the cell in its folder below `out`, or go on where it stopped. Raises what `train.run` raises."""
        if self.world.use == BOOTSTRAP:
            grid = Grid((self.kind,), tuple(range(self.seeds)), self.labels)
            folder = out / self.name
            train.run(Order(self.world.source.task, self.config(), grid, folder, resume=(folder / CONFIG).exists()))
        else:
            tables.write(out / self.name / results.PARQUET, self._adapted(), fresh=True)

    def _adapted(self) -> pa.Table:
        """Return the rows of adapted policies on validation episodes, or of policies that no label corrects."""
        source, config, guide = self.world.source, self.config(), guidances.find(self.kind)
        subject = subject_of(source, config.task, LaneChoice())._replace(origin={})
        env = source.task.environment(config.task, "validation")
        none = np.zeros(self.seeds, int)
        block, spent = Block(self.kind, np.arange(self.seeds), none, none, 0, subject.bases, none > 0), none
        if guide is HeuristicGuide:
            block = block._replace(policy=Common(source.alone(HeuristicGuide.name, view_of(env))))
        elif guide.asks:
            result = self._request(config).run(subject).result
            lanes, spent = result.lanes, result.judgement.rewarded_steps
            bounds = np.zeros(lanes.number)
            block = Block(self.kind, lanes.seed, lanes.budget, bounds, 0, result.policy(view_of(env)), result.failed)
        rows, episodes = [], 0
        for one in evaluate.run(source, evaluate.EvaluateRequest(task=config.task), ready=(env, [block])):
            own = block.budgets == one.labels
            columns = {"labels": block.budgets[own], "seed": one.seeds, "step": none, "rewarded_steps": spent[own]}
            columns |= {results.FAILED: block.failed[own], **one.metrics}
            columns |= {f"{name}_each": group_means(each) for name, each in one.each.items()}
            episodes = next(iter(one.each.values())).shape[-1]
            rows += [{name: column[lane].tolist() for name, column in columns.items()} for lane in range(self.seeds)]
        described = {"world": self.world.name, "teacher": self.teacher, "bound": self.world.bound}
        described |= {
            "sizes": dict(self.world.sizes),
            "task": configuration.to_json(config.task),
            "scalars": vars(config.scalars),
        }
        constants = {"run": self.world.name, "task": source.task.name, "guidance": self.kind, "split": "validation"}
        constants |= {"config_hash": configuration.digest(described), **provenance()}
        rows = [{"episodes": episodes, **constants, **tables.plain(row)} for row in rows]
        return results.SCHEMA.table({name: [row[name] for row in rows] for name in rows[0]})

    def _request(self, config: RunConfig) -> AdaptRequest:
        kind, sizes = self.kind, replace(by_model.SIZES, frame=config.sizes.frame, **self.world.sizes)
        by_answers = guidances.find(kind).by_evidence  # judged by answers, and within no bound
        by, bound = (None, None) if by_answers else (self.world.metric, self.world.bound)
        scalars = by_model.settling(config.scalars, None)
        request = AdaptRequest.of(self.world.source.task, config, None, kind, by, scalars=scalars)
        bounds = () if bound is None else (bound,)
        return replace(request, labels=self.labels, bound_deg=bounds, seeds=f"0:{self.seeds}", sizes=sizes)


def cells_of(table: dict[str, Any], scale: dict[str, Any], worlds: list[World], kinds: list[str]) -> list[Cell]:
    """Return all cells of a scale, also those that make no sense (`Cell.obstacle`)."""
    faults = {teacher: table["teachers"][teacher] for teacher in scale["teachers"]}
    labels = {name: tuple(scale["fault_labels"] if own else scale["labels"]) for name, own in faults.items()}
    return [
        Cell(world, teacher, own, kind, labels[teacher], scale["seeds"])
        for world in worlds
        for kind in kinds
        for teacher, own in faults.items()  # innermost, since another teacher mostly compiles nothing
    ]


def is_done(out: Path, cell: Cell) -> bool:
    """Whether all results of a cell are there."""
    return next((out / cell.name).rglob(results.PARQUET), None) is not None


def collect(out: Path, worlds: list[World]) -> pa.Table:
    """Return the rows of all finished cells below `out`, also of kinds that this call does not run.

    A row is a lane and evaluation. `score` is its world's metric between `ends`; `rewarded_steps` are those of the
    training so far, or of judging a correction.
    """
    parts = []
    for world in worlds:
        for file in sorted((out / world.use / world.name).rglob(results.PARQUET)):
            rows = results.read(file)
            columns = {"task": world.name, "preset": world.start, "use": world.use, "metric": world.metric}
            columns["teacher"] = file.relative_to(out / world.use / world.name).parts[0]
            columns["folder"] = str(file.parent.relative_to(out))
            for name, value in columns.items():
                rows = rows.drop_columns([name] if name in rows.column_names else [])
                rows = rows.append_column(name, pa.repeat(pa.scalar(value), rows.num_rows))
            if world.use == BOOTSTRAP:
                rows = rows.append_column("rewarded_steps", pc.cast(rows["step"], pa.float64()))
            for name, metric in (("score", world.metric), ("score_each", f"{world.metric}_each")):
                scores = _scores(rows[metric].combine_chunks(), world.ends)
                rows = rows.drop_columns([name] if name in rows.column_names else []).append_column(name, scores)
            parts.append(rows)
    return pa.concat_tables(parts, promote_options="permissive")


def _scores(values: Any, ends: tuple[float, float]) -> Any:
    """Return Arrow's array of numbers, or of lists of them, on the scale whose `ends` are 0 and 1; null stays null."""
    if pa.types.is_list(values.type):
        return pa.ListArray.from_arrays(values.offsets, _scores(values.values, ends))
    return pa.array((values.to_numpy(zero_copy_only=False) - ends[0]) / (ends[1] - ends[0]), from_pandas=True)
