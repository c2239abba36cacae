"""Sweeps cut into pieces: which pieces, at which scale, resumed, and reported together."""

from __future__ import annotations

import argparse
import itertools
import os
import signal
import threading
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import label_efficiency
import numpy as np

from cuelearner_jax.cli import main as cuelearner
from cuelearner_jax.errors import UserError
from cuelearner_jax.evaluate import mean_interval
from cuelearner_jax.guides.registry import resolve
from cuelearner_jax.signals import Interrupted
from cuelearner_jax.storage import formats, results

FIRST_SEED = 4000  # of reported runs; settings are chosen on seeds from 0 on, with --tuning
LABEL_EFFICIENCY = "label_efficiency"  # in the place of a command's name: the report of that file
Options = Mapping[str, object]  # of `cuelearner sweep`: a value, several in a tuple, or whether a flag is on


class Piece(NamedTuple):
    """One sweep that fits half an hour of one accelerator. Its folder is world/run/name."""

    world: str  # that it is played in: what one report is of
    run: str  # what is compared as one: kinds and budgets under one configuration
    name: str
    kinds: tuple[str, ...]
    labels: tuple[int, ...]  # budgets; none for kinds that never ask
    seeds: int
    options: Options
    minutes: int  # of an H100 or H200; estimated from 0.45 ms a step of 32 lanes, not measured
    serves: str  # which figure
    first_seed: int = FIRST_SEED

    @property
    def path(self) -> str:
        """The piece's folder and name on the command line."""
        return f"{self.world}/{self.run}/{self.name}"

    @property
    def lanes(self) -> int:
        """Seeds times budgets times kinds."""
        return self.seeds * max(1, len(self.labels)) * len(self.kinds)


class Scale(NamedTuple):
    """How much of every piece is run."""

    about: str
    seeds: int | None = None  # at most so many
    labels: Mapping[int, int] | None = None  # budgets that are kept, and what they become
    options: Mapping[str, object] = {}
    instead: Mapping[str, object] = {}  # of options that a piece has
    reported: bool = False  # is its report asked the questions of the experiment's page?


class Experiment(NamedTuple):
    """The sweeps of one task."""

    task: str
    pieces: tuple[Piece, ...]
    scales: Mapping[str, Scale]
    report: Mapping[str, Sequence[str]]  # options of `cuelearner report` at scales that are reported, by world
    metric: Sequence[str] = ()  # options of it at every scale
    folder: str = ""  # of what is run, below runs/ (default: the task's name and what it is about)


def scaled(piece: Piece, scale: Scale) -> Piece | None:
    """A piece at a scale, or None where nothing of it is left."""
    seeds = min(piece.seeds, scale.seeds or piece.seeds)
    labels = piece.labels
    if scale.labels is not None and labels:
        labels = tuple(scale.labels[budget] for budget in labels if budget in scale.labels)
        if not labels:
            return None
    instead = {name: value for name, value in scale.instead.items() if name in piece.options}
    return piece._replace(seeds=seeds, labels=labels, options={**piece.options, **scale.options, **instead})


def option(name: str, value: object) -> list[str]:
    """An option as it is typed: `--no-…` for a flag that is off."""
    if isinstance(value, bool):
        group, _, flag = name.rpartition(".")
        return [f"--{group}.{flag if value else f'no-{flag}'}"]
    return [f"--{name}", *(str(each) for each in (value if isinstance(value, tuple) else (value,)))]


def sweep_command(task: str, piece: Piece, out: Path, resume: bool) -> list[str]:
    """The command line of a piece."""
    given: dict[str, object] = {**piece.options, "guidance": piece.kinds, "seeds": piece.seeds}
    given |= {"first-seed": piece.first_seed, **({"labels": piece.labels} if piece.labels else {})}
    words = ["sweep", task]
    for name, value in given.items():
        words += option(name, value)
    folder = out / piece.path
    return [*words, "--out", str(folder), *(["--resume"] if resume and (folder / "config.json").exists() else [])]


def folder_at(out: Path, scale: str) -> Path:
    """Return the folder of a scale's worlds: the folder itself for `paper`, one below for others."""
    return out if scale == "paper" else out / scale


def report_command(experiment: Experiment, world: str, out: Path, scale: str) -> list[str] | None:
    """The command line of the report of all runs of a world that have been begun, or None where none has.

    How far labels carry is said as soon as there are unguided agents to compare with; how many labels of the reference
    they are worth, as soon as that has been begun.
    """
    own = [piece for piece in experiment.pieces if piece.world == world]
    for kind in {kind for piece in own for kind in piece.kinds if ":" in kind}:
        resolve(kind)  # the report then knows its title and colour
    runs = dict.fromkeys(piece.run for piece in own)
    begun = [str(out / world / run) for run in runs if list((out / world / run).glob("*/config.json"))]
    if not begun:
        return None
    kinds = {kind for piece in own if (out / piece.path / "config.json").exists() for kind in piece.kinds}
    asked = list(experiment.report.get(world, ())) if experiment.scales[scale].reported else []
    if "--reference" in asked and asked[(at := asked.index("--reference")) + 1] not in kinds:
        del asked[at : at + 2]
    command, more = (LABEL_EFFICIENCY, asked) if "none" in kinds else ("report", [])
    words = [command, *begun, "--by-run", *experiment.metric, *more]
    return [*words, "--out", str(out / world / "report"), "--overwrite"]


def reported(command: list[str]) -> int:
    """Write the report that `report_command` says; return the exit status."""
    return label_efficiency.main(command[1:]) if command[0] == LABEL_EFFICIENCY else cuelearner(command)


def chosen(experiment: Any, names: Sequence[str]) -> list[Any]:
    """The pieces of these names, or below these folders, in the order of the data; all of them for no name.

    Raises ValueError for a name that none has.
    """
    for name in names:
        if not any(_below(piece, name) for piece in experiment.pieces):
            raise ValueError(f"no piece {name!r}: see --list")
    return [piece for piece in experiment.pieces if not names or any(_below(piece, name) for name in names)]


def _below(piece: Any, name: str) -> bool:
    return f"{piece.path}/".startswith(f"{name.rstrip('/')}/")


def list_pieces(pieces: Sequence[Any]) -> str:
    """Pieces with what they take and serve, a line each."""
    width = max(len(piece.path) for piece in pieces)
    rows = [f"{piece.path:<{width}} {piece.lanes:4} lanes  {piece.minutes:3} min  {piece.serves}" for piece in pieces]
    hours = sum(piece.minutes for piece in pieces) / 60
    total = f"{len(pieces)} pieces, {hours:.1f} hours of one accelerator at the scale paper (estimates, not measured)"
    return "\n".join([*rows, total])


def run(experiment: Experiment, about: str, arguments: Sequence[str] | None = None) -> int:
    """Run pieces and reports on their worlds; stops at the first command that fails and return its status."""
    parser = argparse.ArgumentParser(
        description=about, formatter_class=argparse.RawDescriptionHelpFormatter, allow_abbrev=False
    )
    folder = Path("runs") / (experiment.folder or f"{experiment.task}_bootstrapping")
    scales = "; ".join(f"{name}: {scale.about}" for name, scale in experiment.scales.items())
    parser.add_argument("--scale", choices=list(experiment.scales), default="paper", help=scales)
    parser.add_argument("--pieces", nargs="+", default=[], metavar="NAME", help="these alone, or all below a folder")
    parser.add_argument("--out", type=Path, default=folder, help="folder")
    parser.add_argument("--resume", action="store_true", help="go on with pieces that were begun, leave finished ones")
    parser.add_argument("--list", action="store_true", help="list the pieces and stop")
    parser.add_argument("--report", action="store_true", help="report on what there is, and run nothing")
    asked = parser.parse_args(arguments)
    try:
        pieces = chosen(experiment, asked.pieces)
    except ValueError as error:
        parser.error(str(error))
    if asked.list:
        print(list_pieces(pieces))
        return 0
    out = folder_at(asked.out, asked.scale)
    commands = []
    if not asked.report:
        at_scale = [scaled(piece, experiment.scales[asked.scale]) for piece in pieces]
        commands = [sweep_command(experiment.task, piece, out, asked.resume) for piece in at_scale if piece]
    for command in commands:
        if status := cuelearner(command):
            return status
    worlds = dict.fromkeys(piece.world for piece in pieces)
    reports = [report_command(experiment, world, out, asked.scale) for world in worlds]
    return next((status for command in reports if command and (status := reported(command))), 0)


def asked_of(
    about: str, pieces: Sequence[Any], scales: Mapping[str, Any], name: str, arguments: Sequence[str] | None
) -> tuple[argparse.Namespace, list[Any]]:
    """Return what a study of its own table is asked for, and the pieces that are meant.

    `name`: of its folder below runs/. Ends the process for options that make no sense.
    """
    form = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser(description=about, formatter_class=form, allow_abbrev=False)
    told = "; ".join(f"{known}: {scale.about}" for known, scale in scales.items())
    parser.add_argument("--scale", choices=list(scales), default="paper", help=told)
    parser.add_argument("--pieces", nargs="+", default=[], metavar="NAME", help="these alone, or all below a folder")
    parser.add_argument("--labels", nargs="+", type=int, default=[], help="these of the pieces' budgets alone")
    parser.add_argument("--out", type=Path, default=Path("runs") / name, help="folder")
    parser.add_argument("--minutes", type=float, help="save and end after so many; the same command goes on")
    parser.add_argument("--list", action="store_true", help="list the pieces and stop")
    parser.add_argument("--report", action="store_true", help="tell what there is, and run nothing")
    asked = parser.parse_args(arguments)
    try:
        meant = chosen(argparse.Namespace(pieces=pieces), asked.pieces)
    except ValueError as error:
        parser.error(str(error))
    if asked.labels:
        known = sorted({one for piece in meant for one in piece.labels})
        if missing := sorted(set(asked.labels) - set(known)):
            parser.error(f"--labels {missing[0]}: these pieces have {', '.join(map(str, known)) or 'no labels'}")
        kept = [piece._replace(labels=tuple(one for one in piece.labels if one in asked.labels)) for piece in meant]
        meant = [new for old, new in zip(meant, kept, strict=True) if new.labels or not old.labels]
    return asked, meant


def within(minutes: float | None, work: Callable[[], int]) -> int:
    """Return the exit status of work that saves and ends after so many minutes, as at Ctrl-C (None: no limit).

    That the time was up is no failure: 0.
    """
    timer = threading.Timer(60 * (minutes or 0.0), lambda: os.kill(os.getpid(), signal.SIGINT))
    timer.daemon = True
    if minutes:
        timer.start()
    try:
        status = work()
    except KeyboardInterrupt:  # between two pieces
        status = Interrupted.status
    finally:
        timer.cancel()
    if status == Interrupted.status and minutes:
        print("the time is up: the same command goes on")
        status = 0
    return status


def evaluations(
    out: Path, pieces: Sequence[Piece]
) -> Iterator[tuple[Piece, Mapping[str, Any], dict[str, Any], list[dict[str, Any]]]]:
    """Yield each evaluation of pieces that have begun: the piece, its arbiter's options, row, results.

    A row of a table begins with what the row here holds; the results are those of all seeds.
    """
    for piece in pieces:
        try:
            rows = results.read(out / piece.path).to_pylist()
        except UserError:  # not begun
            continue
        arbiter = formats.read("config", out / piece.path / "config.json")["arbiter"]
        for (labels, step), own in grouped(rows, "labels", "step"):
            row = {"world": piece.world, "run": piece.run, "guidance": piece.kinds[0], "labels": labels, "step": step}
            yield piece, arbiter, row, own


def grouped(rows: Sequence[dict[str, Any]], *names: str) -> list[tuple[Any, list[dict[str, Any]]]]:
    """Rows that are alike in some columns, by these."""
    groups = defaultdict(list)
    for row in rows:
        groups[tuple(row[name] for name in names)].append(row)
    return sorted(groups.items())


def spread(values: Sequence[float]) -> dict[str, Any]:
    """Mean of as many seeds with its 95% bootstrap interval."""
    mean, low, high = mean_interval(np.array(values, float)).tolist()
    return {"seeds": len(values), "mean": mean, "low": low, "high": high}


def steps_to(level: float, rows: Sequence[Mapping[str, Any]]) -> float:
    """Steps after which the mean curve first reaches a level, on straight lines between evaluations; inf: never."""
    for before, after in itertools.pairwise(rows):
        if before["mean"] >= level:
            return before["step"]
        if after["mean"] >= level:
            share = (level - before["mean"]) / (after["mean"] - before["mean"])
            return before["step"] + share * (after["step"] - before["step"])
    return rows[-1]["step"] if rows and rows[-1]["mean"] >= level else float("inf")
