"""Studies of adaptation: pieces, base agents, methods, recorded tables.

A piece is one method in one changed world, over all base agents of a run folder and all its budgets (or steps), in
lanes of one program. Its rows go to FOLDER/TASK/WORLD/PIECE/adaptation.jsonl while it runs, .parquet once it is done.
"""

from __future__ import annotations

import argparse
import dataclasses
import shutil
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from _finetuning import FineTuning, every
from _pieces import grouped, pieces_below

from cuelearner_jax.adaptation import by_model, by_reading
from cuelearner_jax.adaptation.judging import LABELS, Judging
from cuelearner_jax.adaptation.lanes import Adaptation, product, side_by_side
from cuelearner_jax.cli import main as cuelearner
from cuelearner_jax.config import GuideSizes
from cuelearner_jax.environment import actions_of, spaces_of
from cuelearner_jax.errors import UserError
from cuelearner_jax.evaluate import episodes, rollout_lanes
from cuelearner_jax.guides import registry as guidances
from cuelearner_jax.policies import Agent, Corrected
from cuelearner_jax.reading import declared_distortions
from cuelearner_jax.report.statistics import interval
from cuelearner_jax.run_config import RunConfig
from cuelearner_jax.runs.policy_sources import PolicySource, several
from cuelearner_jax.storage import table as tables
from cuelearner_jax.storage.provenance import provenance
from cuelearner_jax.task import Task
from cuelearner_jax.tasks import registry

SCHEMA = tables.Schema(
    stem="adaptation",
    required=("task", "world", "method", "variant", "base", "labels", "steps"),
    strings=("task", "world", "method", "variant", "split", "commit", "versions", "hardware", "command"),
    integers=("base", "label_seed", "labels", "steps"),
    remedy="is damaged: delete its folder and run the piece again",
)
UNCHANGED = "unchanged"  # the world that the base agents were trained in
SHOWN = ("reward", "success")  # metrics in a table
JUDGED = 500  # environments at most in which it is decided whether a model is used
Row = dict[str, Any]  # columns, each a number for all lanes or an array (lanes,)

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
    settings: Mapping[str, Any] = {}  # "sizes.…" and "scalars.…" of the guide or of the learning agent, "task.…"
    rate: float = 0.0  # of fine-tuning: its step size,
    noise_deg: float = 0.0  # its noise,
    steps: int = 0  # its steps,
    every: int = 0  # and those between two measurements
    seeds: int = 1  # of labels, fits and fine-tuning, for each base agent
    judge_by: str = "reward"  # a model that is worse by this on tuning episodes is not used
    judge_bounds: tuple[float, ...] = ()  # shares of the bound within which the model is tried too
    robot: str | None = None  # what acts there, where that is changed

    @property
    def path(self) -> str:
        """The piece's folder and name on the command line."""
        name = f"{self.method}-{self.variant}" if self.variant else self.method
        return f"{self.place}/{name}"

    @property
    def place(self) -> str:
        """The changed world's name in tables."""
        if self.robot is None:
            return self.world
        return self.robot if self.world == UNCHANGED else f"{self.world}_{self.robot}"


class Scale(NamedTuple):
    """How much of every piece is run."""

    about: str
    envs: int  # of an evaluation
    steps: int  # of each of them
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

    def env(self, split: str) -> Any:
        """Return the world of a split; questions and fine-tuning use "training"."""
        return environment(self.task.name, self.world, split, self.piece.robot)

    def measured(self, policy: Any) -> Row:
        """Return metrics (lanes,) of a block of policies on validation episodes."""
        return rollout_lanes(
            self.env("validation"), policy, episodes("validation"), self.envs, self.envs * self.steps
        ).means

    def set(self, group: str, values: Any) -> Any:
        """Return a group of a configuration with the piece's settings of that name."""
        own = {name.partition(".")[2]: value for name, value in self.piece.settings.items() if name.startswith(group)}
        known = {field.name for field in dataclasses.fields(values)}
        return dataclasses.replace(values, **{name: value for name, value in own.items() if name in known})

    def scalars(self) -> Any:
        """Return the base agents' scalars with labels of the scenario's strength, refined within the bound."""
        eps = None if self.piece.world == UNCHANGED else self.task.scenario(self.piece.world).eps_deg
        own = by_model.settling(self.config.scalars, self.piece.settings.get("scalars.eps_deg", eps))
        reached = int(np.ceil(self.piece.bound_deg / own.eps_deg)) + 2  # passes of which each turns by eps
        own = dataclasses.replace(own, k_max=max(own.k_max, reached))  # a model that is not sure turns by less
        return self.set("scalars.", own)


# --- methods: rows of a piece, for all base agents and budgets ------------------------------------------------------


def unadapted(bench: Bench) -> Iterator[Row]:
    """Measure the base agents themselves."""
    agents = bench.agents.replace(view=bench.env("validation"))
    yield {"base": bench.seeds, "labels": 0, "steps": 0, **bench.measured(agents)}


def by_teacher(bench: Bench) -> Iterator[Row]:
    """Correct by the teacher's own answers, refined as by a model of them, within the same bound."""
    env = bench.env("validation")
    scalars = dataclasses.replace(bench.scalars(), tau_max_deg=bench.piece.bound_deg)
    teacher = bench.task.make_teacher(bench.world, env)
    policy = Corrected(bench.agents.replace(view=env), teacher, scalars, actions_of(env))
    yield {"base": bench.seeds, "labels": 0, "steps": 0, **bench.measured(policy)}


def by_labels(bench: Bench) -> Iterator[Row]:
    """Adapt by labels of the guidance that the method names, with every budget as a lane."""
    piece, env = bench.piece, bench.env("training")
    kind = guidances.find(piece.method)
    sizes = bench.set("sizes.", GuideSizes(frame=bench.config.sizes.frame))
    options = bench.set(f"{kind.name}.", kind.config()) if kind.config else None
    lanes = product(len(bench.seeds), range(piece.seeds), piece.labels, (piece.bound_deg,))
    envs = min(bench.envs, JUDGED)
    judge = Judging(bench.env("tuning"), envs, envs * bench.steps, piece.judge_by, bounds=piece.judge_bounds)
    of = Adaptation(kind(sizes, spaces_of(env), options), sizes, bench.scalars(), env, bench.agents)
    after = by_model.adapt(of, lanes, judge, bench.task.make_teacher(bench.world, env))
    which = {"base": bench.seeds[lanes.base], "label_seed": lanes.seed, "labels": lanes.budget, "steps": 0}
    judged = {
        "used": after.judgement.in_use.astype(float),
        "within_deg": after.judgement.within_deg,
        "rewarded_steps": after.judgement.rewarded_steps.astype(float),
    }
    yield {**which, **judged, **bench.measured(after.policy(bench.env("validation")))}


def by_answers(bench: Bench) -> Iterator[Row]:
    """Read answers, which also decide whether the correction is used."""
    piece, env = bench.piece, bench.env("training")
    kind, scalars = guidances.find("reading"), bench.scalars()
    guidance = kind(by_model.SIZES, spaces_of(env))
    lanes = product(len(bench.seeds), range(piece.seeds), piece.labels, (actions_of(env).reach,))
    family = declared_distortions(env)
    of = by_reading.ReadingAdaptation(guidance, by_model.SIZES, scalars, env, bench.agents, family)
    after = by_reading.adapt(of, lanes, Judging(None, by=LABELS), bench.task.make_teacher(bench.world, env))
    which = {"base": bench.seeds[lanes.base], "label_seed": lanes.seed, "labels": lanes.budget, "steps": 0}
    judged = {"used": after.judgement.in_use.astype(float), "rewarded_steps": 0.0}
    yield {**which, **judged, **bench.measured(after.policy(bench.env("validation")))}


def by_fine_tuning(bench: Bench) -> Iterator[Row]:
    """Let agents go on learning, and measure them on the way."""
    piece, env = bench.piece, bench.env("training")
    schedule = dataclasses.replace(bench.config.schedule, learn_after=1_000)
    own = dataclasses.replace(
        bench.config,
        task=bench.world,
        sizes=bench.set("sizes.", bench.config.sizes),
        agent=bench.set("agent.", bench.config.agent),
        scalars=bench.set("scalars.", bench.config.scalars),
        schedule=bench.set("schedule.", schedule),
    )
    lanes = every(len(bench.seeds), range(piece.seeds), (piece.rate,), (piece.noise_deg,))
    tuning = FineTuning(own, env, bench.agents, lanes)
    which = {"base": bench.seeds[lanes.base], "label_seed": lanes.seed, "labels": 0}
    while True:
        metrics = bench.measured(tuning.policy(bench.env("validation")))
        yield {**which, "steps": tuning.step, "failed": tuning.failed.astype(float), **metrics}
        if tuning.step >= piece.steps:
            return
        tuning.train(piece.every)


METHODS: dict[str, Callable[[Bench], Iterator[Row]]] = {
    "none": unadapted,
    "teacher": by_teacher,
    "relative": by_labels,
    "intent": by_labels,
    "reading": by_answers,
    "finetuning": by_fine_tuning,
}


# --- running --------------------------------------------------------------------------------------------------------


def scaled(piece: Piece, scale: Scale) -> Piece | None:
    """Return a piece at a scale, or None where nothing of it is left."""
    labels = piece.labels
    if scale.labels is not None and labels:
        labels = tuple(scale.labels[budget] for budget in labels if budget in scale.labels)
        if not labels:
            return None
    steps, between = scale.tuned_steps if scale.tuned_steps and piece.steps else (piece.steps, piece.every)
    settings, seeds = {**piece.settings, **scale.settings}, min(piece.seeds, scale.seeds or piece.seeds)
    return piece._replace(labels=labels, steps=steps, every=between, settings=settings, seeds=seeds)


def open_bench(folder: Path, study: Study, piece: Piece, scale: Scale) -> Bench:
    """Open the base agents and world of a piece. Raises UserError if the folder holds no such agents."""
    source = PolicySource.of_folder(folder, registry.find)
    if source.task.name != study.task:
        raise UserError(f"{folder} holds agents of {source.task.name}: give --bases a run of {study.task}")
    source = source.on(piece.robot)
    assert source.grid is not None
    config = source.config
    world = config.task if piece.world == UNCHANGED else source.task.scenario(piece.world).apply(config.task)
    own = {name.partition(".")[2]: value for name, value in piece.settings.items() if name.startswith("task.")}
    world = dataclasses.replace(world, **own)
    env = environment(source.task.name, world, "training", piece.robot)
    policies, _ = several(source, world, "agent", None, None, source.grid.seeds, env=env)
    agents = side_by_side(policies)
    if scale.directions:
        agents = agents.replace(
            sizes=dataclasses.replace(agents.sizes, directions=scale.directions, coarse_directions=0)
        )
    steps = scale.steps if source.task.longest is None else source.task.longest(world)
    return Bench(source.task, config, agents, np.array(source.grid.seeds), world, piece, scale.envs, steps)


def run_piece(study: Study, piece: Piece, scale: Scale, bases: Path, out: Path, resume: bool) -> None:
    """Run a piece and finish its table. Raises UserError if it is there already and is not to be gone on with."""
    folder = out / study.task / piece.path
    if (folder / SCHEMA.parquet).exists() and resume:
        print(f"{piece.path}: finished")
        return
    if folder.exists() and not resume:
        raise UserError(f"{folder} exists: give --resume to go on, or another --out")
    shutil.rmtree(folder, ignore_errors=True)  # what was begun is begun anew: it takes minutes
    bench = open_bench(bases, study, piece, scale)
    about = {"task": study.task, "world": piece.place, "method": piece.method, "variant": piece.variant}
    with tables.TableWriter(folder, SCHEMA, {**about, "bound_deg": piece.bound_deg, **provenance()}) as writer:
        for row in METHODS[piece.method](bench):
            count = len(row["base"])
            writer.append(**{name: np.broadcast_to(np.asarray(value), (count,)) for name, value in row.items()})
            means = ", ".join(f"{name} {np.mean(row[name]):.3f}" for name in SHOWN if name in row)
            print(f"{piece.path}: {row['steps'] or ''} {means}", flush=True)
    tables.finish(folder, SCHEMA)


def table(folder: Path) -> str:
    """Return a line for each finished piece and budget: interquartile means over agents, with 95% intervals."""
    lines = []
    for file in sorted(folder.rglob(SCHEMA.parquet)):
        rows = tables.read(file, SCHEMA).to_pylist()
        for (labels, steps), own in grouped(rows, "labels", "steps"):
            for metric in (name for name in SHOWN if own[0].get(name) is not None):
                means = [np.mean([row[metric] for row in each]) for _, each in grouped(own, "base")]
                middle, low, high = map(float, interval(np.array(means)))
                place = file.parent.relative_to(folder)
                lines.append(f"{place!s:<50}{labels:>6}{steps:>8}  {metric} {middle:.3f} [{low:.3f}, {high:.3f}]")
    return "\n".join(lines)


def run(study: Study, about: str, arguments: Sequence[str] | None = None) -> int:
    """Run pieces, one after the other, then print their table; return the exit status."""
    parser = argparse.ArgumentParser(
        description=about, formatter_class=argparse.RawDescriptionHelpFormatter, allow_abbrev=False
    )
    scales = "; ".join(f"{name}: {scale.about}" for name, scale in study.scales.items())
    parser.add_argument("--bases", type=Path, help="run folder of the base agents (smoke trains tiny ones by itself)")
    parser.add_argument("--scale", choices=list(study.scales), default="paper", help=scales)
    parser.add_argument("--pieces", nargs="+", default=[], metavar="NAME", help="these alone, or all below a folder")
    parser.add_argument("--out", type=Path, default=Path("runs/adaptation"), help="folder")
    parser.add_argument("--resume", action="store_true", help="leave finished pieces, begin interrupted ones anew")
    parser.add_argument("--list", action="store_true", help="list the pieces and stop")
    asked = parser.parse_args(arguments)
    try:
        pieces = pieces_below(study.pieces, asked.pieces)
    except ValueError as error:
        parser.error(str(error))
    if asked.list:
        print("\n".join(piece.path for piece in pieces))
        return 0
    scale = study.scales[asked.scale]
    out, bases = asked.out if asked.scale == "paper" else asked.out / asked.scale, asked.bases
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
    print(table(out))
    return 0
