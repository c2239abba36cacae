"""Shared parts of the experiments on adaptation: pieces of a study, base agents and recorded tables.

A piece is one method in one changed world, over all base agents of a run folder and all its budgets (or steps), in
lanes of one program. Its rows go to FOLDER/TASK/WORLD/PIECE/adaptation.jsonl while it runs, .parquet once it is done.
"""

from __future__ import annotations

import argparse
import dataclasses
import shutil
from collections.abc import Mapping, Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from _adaptation_methods import METHODS, Row
from _pieces import chosen, list_pieces

from cuelearner_jax.adaptation import by_model
from cuelearner_jax.adaptation.lanes import side_by_side
from cuelearner_jax.cli import main as cuelearner
from cuelearner_jax.errors import UserError
from cuelearner_jax.evaluate import episodes, rollout_lanes
from cuelearner_jax.policies import Agent
from cuelearner_jax.run_config import RunConfig
from cuelearner_jax.runs.trained import PolicySource, several
from cuelearner_jax.storage import table as tables
from cuelearner_jax.storage.provenance import provenance
from cuelearner_jax.task import Task
from cuelearner_jax.tasks import registry

SCHEMA = tables.Schema(
    stem="adaptation",
    mark="base",
    required=("task", "world", "method", "variant", "split", "base", "labels", "steps"),
    strings=("task", "world", "method", "variant", "split", "commit", "versions", "hardware", "command"),
    integers=("base", "label_seed", "labels", "steps"),
    remedy="is damaged: delete its folder and run the piece again",
)
UNCHANGED = "unchanged"  # the world that the base agents were trained in

SMALL: Mapping[str, Any] = {  # what every method has at the scale smoke
    "sizes.feedback_layers": (16,),
    "sizes.labels_per_round": 5,
    "sizes.fit_steps": 20,
    "sizes.fit_batch_size": 5,
    "agent.replay_capacity": 400,
    "schedule.learn_after": 20,
}
MODEST: Mapping[str, Any] = {  # models that 2 cores fit in seconds, as `cuelearner adapt` has them
    "sizes.feedback_layers": by_model.SIZES.feedback_layers,
    "sizes.fit_steps": by_model.SIZES.fit_steps,
    "sizes.fit_batch_size": by_model.SIZES.fit_batch_size,
}


class Piece(NamedTuple):
    """One method in one world."""

    world: str  # a scenario of the task's, or `UNCHANGED`
    method: str  # a key of `METHODS`
    variant: str = ""  # of its settings, where there are several
    bound_deg: float = 180.0
    labels: tuple[int, ...] = ()  # budgets
    settings: Mapping[str, Any] = {}  # "sizes.…" and "scalars.…" of the guide or of the learning agent, "task.…";
    # "guidance" where the kind is another than the method's
    rates: tuple[float, ...] = ()  # of fine-tuning: its step sizes,
    noises_deg: tuple[float, ...] = ()  # and its noises
    steps: int = 0  # of fine-tuning
    every: int = 0  # of them between two measurements
    split: str = "validation"  # of the episodes; settings are chosen on "tuning"
    seeds: int = 1  # of labels, fits and fine-tuning, for each base agent
    judge_by: str = (
        "reward"  # a model that is worse by this on tuning episodes is not used; "labels": no reward is seen
    )
    judge_bounds: tuple[float, ...] = ()  # shares of the bound within which the model is tried too
    robot: str | None = None  # what acts there, where that is changed
    ways: bool = False  # keep some ways that are walked before and after, for a picture?
    minutes: int = 10  # of an H100 or H200, a guess
    serves: str = ""  # which figure

    @property
    def place(self) -> str:
        """The changed world's name in tables."""
        if self.robot is None:
            return self.world
        return self.robot if self.world == UNCHANGED else f"{self.world}_{self.robot}"

    @property
    def path(self) -> str:
        """The piece's folder and name on the command line."""
        name = f"{self.method}-{self.variant}" if self.variant else self.method
        return f"{'tuning/' if self.split == 'tuning' else ''}{self.place}/{name}"

    @property
    def lanes(self) -> int:
        """Number of lanes per base agent."""
        return self.seeds * max(1, len(self.labels)) * max(1, len(self.rates)) * max(1, len(self.noises_deg))


class Scale(NamedTuple):
    """How much of every piece is run."""

    about: str
    envs: int  # of an evaluation
    steps: int  # of each of them
    tuning_bases: int = 4  # the first of the run; settings are chosen on them, and the others are reported
    seeds: int | None = None  # of labels, at most so many
    labels: Mapping[int, int] | None = None  # budgets that are kept, and what they become
    settings: Mapping[str, Any] = {}
    tuned_steps: tuple[int, int] | None = None  # steps of fine-tuning, and between two measurements
    directions: int | None = None  # among which base agents choose, in place of their own number
    train: Sequence[str] = ()  # options of `cuelearner sweep` for base agents where none are given


class Study(NamedTuple):
    """The pieces of one task."""

    task: str
    pieces: tuple[Piece, ...]
    scales: Mapping[str, Scale]


@lru_cache(maxsize=4)
def environment(task: str, world: Any, split: str, robot: str | None = None) -> Any:
    """Return a world's environment; cached, since a thousand halls take a while."""
    return registry.find(task).on(robot).environment(world, split)


class Bench(NamedTuple):
    """The base agents and world of a piece."""

    task: Task
    config: RunConfig  # of the base agents' run
    agents: Agent  # a block
    seeds: np.ndarray  # (bases,)
    world: Any  # a configuration
    piece: Piece
    envs: int
    steps: int
    folder: Path  # of what is written

    def env(self, split: str) -> Any:
        """The world of a split: what is asked and learned in is "training"."""
        return environment(self.task.name, self.world, split, self.piece.robot)

    def measured(self, policy: Any, split: str | None = None) -> Row:
        """Metrics (lanes,) of a block of policies on the episodes of a split (default: the piece's)."""
        split = split or self.piece.split
        return rollout_lanes(self.env(split), policy, episodes(split), self.envs, self.envs * self.steps).means

    def set(self, group: str, values: Any) -> Any:
        """A group of a configuration with the piece's settings of that name; tuples for lists."""
        own = {name.partition(".")[2]: value for name, value in self.piece.settings.items() if name.startswith(group)}
        known = {field.name for field in dataclasses.fields(values)}
        return dataclasses.replace(values, **{name: value for name, value in own.items() if name in known})

    def scalars(self) -> Any:
        """The base agents' scalars with labels of the scenario's strength, refined within the bound."""
        eps = None if self.piece.world == UNCHANGED else self.task.scenario(self.piece.world).eps_deg
        own = by_model.settling(self.config.scalars, self.piece.settings.get("scalars.eps_deg", eps))
        reached = int(np.ceil(self.piece.bound_deg / own.eps_deg)) + 2  # passes of which each turns by eps
        own = dataclasses.replace(own, k_max=max(own.k_max, reached))  # a model that is not sure turns by less
        return self.set("scalars.", own)


def scaled(piece: Piece, scale: Scale) -> Piece | None:
    """A piece at a scale, or None where nothing of it is left."""
    labels = piece.labels
    if scale.labels is not None and labels:
        labels = tuple(scale.labels[budget] for budget in labels if budget in scale.labels)
        if not labels:
            return None
    steps, between = scale.tuned_steps if scale.tuned_steps and piece.steps else (piece.steps, piece.every)
    settings, seeds = {**piece.settings, **scale.settings}, min(piece.seeds, scale.seeds or piece.seeds)
    return piece._replace(labels=labels, steps=steps, every=between, settings=settings, seeds=seeds)


def bases_of(piece: Piece, scale: Scale, seeds: tuple[int, ...]) -> tuple[int, ...]:
    """The base agents of a piece: settings are chosen on others than those that are reported.

    Raises UserError where none is left.
    """
    if piece.split == "tuning" and piece.world == UNCHANGED:  # which are finished is asked of all
        return seeds
    if len(seeds) <= scale.tuning_bases:
        raise UserError(
            f"the run has {len(seeds)} agents, and settings are chosen on the first {scale.tuning_bases}: "
            "give --bases a run of more"
        )
    return seeds[: scale.tuning_bases] if piece.split == "tuning" else seeds[scale.tuning_bases :]


def open_bench(folder: Path, study: Study, piece: Piece, scale: Scale, out: Path) -> Bench:
    """Open the base agents and world of a piece. Raises UserError if the folder holds no such agents."""
    source = PolicySource.of_run(folder, registry.find)
    if source.task.name != study.task:
        raise UserError(f"{folder} holds agents of {source.task.name}: give --bases a run of {study.task}")
    source = source.on(piece.robot)
    assert source.grid is not None
    config = source.config
    world = config.task if piece.world == UNCHANGED else source.task.scenario(piece.world).apply(config.task)
    own = {name.partition(".")[2]: value for name, value in piece.settings.items() if name.startswith("task.")}
    world = dataclasses.replace(world, **own)
    env = environment(source.task.name, world, "training", piece.robot)
    chosen_seeds = bases_of(piece, scale, source.grid.seeds)
    policies, seeds = several(source, world, "agent", None, None, chosen_seeds, env=env)
    agents = side_by_side(policies)
    if scale.directions:
        agents = agents.replace(
            sizes=dataclasses.replace(agents.sizes, directions=scale.directions, coarse_directions=0)
        )
    steps = scale.steps if source.task.longest is None else source.task.longest(world)
    return Bench(source.task, config, agents, np.array(seeds), world, piece, scale.envs, steps, out)


def run_piece(study: Study, piece: Piece, scale: Scale, bases: Path, out: Path, resume: bool) -> None:
    """Run a piece and finishes its table. Raises UserError if it is there already and is not to be gone on with."""
    folder = out / study.task / piece.path
    if (folder / SCHEMA.parquet).exists() and resume:
        print(f"{piece.path}: finished")
        return
    if folder.exists() and not resume:
        raise UserError(f"{folder} exists: give --resume to go on, or another --out")
    shutil.rmtree(folder, ignore_errors=True)  # what was begun is begun anew: it takes minutes
    bench = open_bench(bases, study, piece, scale, folder)
    about = {"task": study.task, "world": piece.place, "method": piece.method, "variant": piece.variant}
    constants = {**about, "split": piece.split, "bound_deg": piece.bound_deg, **provenance()}
    with tables.TableWriter(folder, SCHEMA, constants) as writer:
        for row in METHODS[piece.method](bench):
            count = len(row["base"])
            # A column is a number for all, or one a lane.
            writer.append(**{name: np.broadcast_to(np.asarray(value), (count,)) for name, value in row.items()})
            shown = {name: float(np.mean(value)) for name, value in row.items() if name in ("reward", "success")}
            told = ", ".join(f"{name} {value:.3f}" for name, value in shown.items())
            print(f"{piece.path}: {row['steps'] or ''} {told}", flush=True)
    tables.finish(folder, SCHEMA)


def run(study: Study, about: str, arguments: Sequence[str] | None = None) -> int:
    """Run pieces, one after the other; return the exit status."""
    parser = argparse.ArgumentParser(
        description=about, formatter_class=argparse.RawDescriptionHelpFormatter, allow_abbrev=False
    )
    scales = "; ".join(f"{name}: {scale.about}" for name, scale in study.scales.items())
    parser.add_argument("--bases", type=Path, help="run folder of the base agents (smoke trains tiny ones by itself)")
    parser.add_argument("--scale", choices=list(study.scales), default="paper", help=scales)
    parser.add_argument("--pieces", nargs="+", default=[], metavar="NAME", help="these alone, or all below a folder")
    parser.add_argument("--out", type=Path, default=Path("runs/adaptation"), help="folder")
    parser.add_argument("--labels", nargs="+", type=int, default=[], help="these of the pieces' budgets alone")
    parser.add_argument("--envs", type=int, help="environments of an evaluation, one episode each in navigation")
    parser.add_argument("--resume", action="store_true", help="leave finished pieces, begin interrupted ones anew")
    parser.add_argument("--list", action="store_true", help="list the pieces and stop")
    asked = parser.parse_args(arguments)
    try:
        pieces = chosen(study, asked.pieces)
    except ValueError as error:
        parser.error(str(error))
    if not asked.pieces:
        pieces = [piece for piece in pieces if piece.split != "tuning" or piece.world == UNCHANGED]
    if asked.list:
        print(list_pieces(pieces))
        return 0
    scale = study.scales[asked.scale]
    if asked.labels:
        known = scale.labels or {budget: budget for piece in pieces for budget in piece.labels}
        scale = scale._replace(labels={budget: known[budget] for budget in asked.labels if budget in known})
    if asked.envs is not None:
        if asked.envs < 1:
            parser.error(f"--envs is {asked.envs}: give at least 1")
        scale = scale._replace(envs=asked.envs)
    out = asked.out if asked.scale == "paper" else asked.out / asked.scale
    bases = asked.bases
    if bases is None and not scale.train:
        parser.error("give --bases the run folder of the base agents")
    if bases is None:
        bases = out / study.task / "bases"
        begun = ["--resume"] if (bases / "config.json").exists() else []
        if status := cuelearner(["sweep", study.task, *scale.train, "--out", str(bases), *begun]):
            return status
    try:
        for piece in pieces:
            if at_scale := scaled(piece, scale):
                run_piece(study, at_scale, scale, bases, out, asked.resume)
    except UserError as error:
        print(error)
        return 2
    return 0
