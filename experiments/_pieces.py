"""Sweeps cut into pieces: which pieces, at which scale, resumed, and reported together."""

from __future__ import annotations

import argparse
from collections import defaultdict
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import label_efficiency
import numpy as np

from cuelearner_jax.cli import main as cuelearner
from cuelearner_jax.evaluate import mean_interval

FIRST_SEED = 4000  # of reported runs; settings are chosen on seeds from 0 on, with --tuning
Options = Mapping[str, object]  # of `cuelearner sweep`: a value, several in a tuple, or whether a flag is on


class Piece(NamedTuple):
    """One sweep. Its folder is world/run/name."""

    world: str  # that it is played in: what one report is of
    run: str  # what is compared as one: kinds and budgets under one configuration
    name: str
    kinds: tuple[str, ...]
    labels: tuple[int, ...]  # budgets; none for kinds that never ask
    seeds: int
    options: Options

    @property
    def path(self) -> str:
        """The piece's folder and name on the command line."""
        return f"{self.world}/{self.run}/{self.name}"


class Scale(NamedTuple):
    """How much of every piece is run."""

    about: str
    seeds: int | None = None  # at most so many
    labels: Mapping[int, int] | None = None  # budgets that are kept, and what they become
    options: Mapping[str, object] = {}
    instead: Mapping[str, object] = {}  # of options that a piece has


class Experiment(NamedTuple):
    """The sweeps of one task."""

    task: str
    pieces: tuple[Piece, ...]
    scales: Mapping[str, Scale]
    report: Mapping[str, Sequence[str]]  # options of label_efficiency.py at the scale `paper`, by world
    metric: Sequence[str] = ()  # options of it at every scale


def scaled(piece: Piece, scale: Scale) -> Piece | None:
    """Return a piece at a scale, or None where nothing of it is left."""
    seeds = min(piece.seeds, scale.seeds or piece.seeds)
    labels = piece.labels
    if scale.labels is not None and labels:
        labels = tuple(scale.labels[budget] for budget in labels if budget in scale.labels)
        if not labels:
            return None
    instead = {name: value for name, value in scale.instead.items() if name in piece.options}
    return piece._replace(seeds=seeds, labels=labels, options={**piece.options, **scale.options, **instead})


def option(name: str, value: object) -> list[str]:
    """Return an option as it is typed: `--no-…` for a flag that is off."""
    if isinstance(value, bool):
        group, _, flag = name.rpartition(".")
        return [f"--{group}.{flag if value else f'no-{flag}'}"]
    return [f"--{name}", *(str(each) for each in (value if isinstance(value, tuple) else (value,)))]


def words_of(options: Options) -> list[str]:
    """Return options as they are typed."""
    return [word for name, value in options.items() for word in option(name, value)]


def sweep_command(task: str, piece: Piece, out: Path, resume: bool) -> list[str]:
    """Return the command line of a piece."""
    own: dict[str, object] = {**piece.options, "guidance": piece.kinds, "seeds": piece.seeds}
    own |= {"first-seed": FIRST_SEED, **({"labels": piece.labels} if piece.labels else {})}
    folder = out / piece.path
    going_on = ["--resume"] if resume and (folder / "config.json").exists() else []
    return ["sweep", task, *words_of(own), "--out", str(folder), *going_on]


def folder_at(out: Path, scale: str) -> Path:
    """Return the folder of a scale's worlds: the folder itself for `paper`, one below for others."""
    return out if scale == "paper" else out / scale


def report_command(experiment: Experiment, world: str, out: Path, scale: str) -> list[str] | None:
    """Return the arguments of label_efficiency.py for the runs of a world, or None where no unguided run has begun."""
    own = [piece for piece in experiment.pieces if piece.world == world]
    begun = [piece for piece in own if (out / piece.path / "config.json").exists()]
    kinds = {kind for piece in begun for kind in piece.kinds}
    if "none" not in kinds:
        return None
    more = list(experiment.report.get(world, ())) if scale == "paper" else []
    if "--reference" in more and more[(at := more.index("--reference")) + 1] not in kinds:
        del more[at : at + 2]
    folders = dict.fromkeys(str(out / world / piece.run) for piece in begun)
    return [*folders, "--by-run", *experiment.metric, *more, "--out", str(out / world / "report"), "--overwrite"]


def pieces_below(pieces: Sequence[Any], names: Sequence[str]) -> list[Any]:
    """Return the pieces of these names, or below these folders, in the order of the data; all for no name.

    Raises ValueError for a name that none has.
    """

    def below(piece: Any, name: str) -> bool:
        return f"{piece.path}/".startswith(f"{name.rstrip('/')}/")

    for name in names:
        if not any(below(piece, name) for piece in pieces):
            raise ValueError(f"no piece {name!r}: see --list")
    return [piece for piece in pieces if not names or any(below(piece, name) for name in names)]


def asked_of(
    about: str, pieces: Sequence[Piece], scales: Mapping[str, Scale], out: Path, arguments: Sequence[str] | None
) -> tuple[argparse.Namespace, list[Piece]]:
    """Return the arguments of a study's command, and the pieces that are meant; print them and exit for --list."""
    parser = argparse.ArgumentParser(
        description=about, formatter_class=argparse.RawDescriptionHelpFormatter, allow_abbrev=False
    )
    known = "; ".join(f"{name}: {scale.about}" for name, scale in scales.items())
    parser.add_argument("--scale", choices=list(scales), default="paper", help=known)
    parser.add_argument("--pieces", nargs="+", default=[], metavar="NAME", help="these alone, or all below a folder")
    parser.add_argument("--out", type=Path, default=out, help="folder")
    parser.add_argument("--resume", action="store_true", help="go on with pieces that were begun, leave finished ones")
    parser.add_argument("--list", action="store_true", help="list the pieces and stop")
    parser.add_argument("--report", action="store_true", help="report on what there is, and run nothing")
    asked = parser.parse_args(arguments)
    try:
        meant = pieces_below(pieces, asked.pieces)
    except ValueError as error:
        parser.error(str(error))
    if asked.list:
        print("\n".join(f"{piece.path}: {piece.seeds} seeds, labels {piece.labels or 'none'}" for piece in meant))
        raise SystemExit(0)
    return asked, meant


def run_pieces(task: str, pieces: Sequence[Piece], scale: Scale, out: Path, resume: bool) -> int:
    """Run pieces at a scale; stop at the first command that fails and return its status."""
    for piece in pieces:
        at_scale = scaled(piece, scale)
        if at_scale and (status := cuelearner(sweep_command(task, at_scale, out, resume))):
            return status
    return 0


def run(experiment: Experiment, about: str, arguments: Sequence[str] | None = None) -> int:
    """Run pieces and reports on their worlds; stop at the first command that fails and return its status."""
    folder = Path("runs") / f"{experiment.task}_bootstrapping"
    asked, pieces = asked_of(about, experiment.pieces, experiment.scales, folder, arguments)
    out = folder_at(asked.out, asked.scale)
    if not asked.report:
        scale = experiment.scales[asked.scale]
        if status := run_pieces(experiment.task, pieces, scale, out, asked.resume):
            return status
    worlds = dict.fromkeys(piece.world for piece in pieces)
    commands = [report_command(experiment, world, out, asked.scale) for world in worlds]
    return next((status for command in commands if command and (status := label_efficiency.main(command))), 0)


def grouped(rows: Sequence[dict[str, Any]], *names: str) -> list[tuple[Any, list[dict[str, Any]]]]:
    """Return rows that are alike in some columns, by these."""
    groups = defaultdict(list)
    for row in rows:
        groups[tuple(row[name] for name in names)].append(row)
    return sorted(groups.items())


def spread(values: Sequence[float]) -> dict[str, Any]:
    """Return the mean of as many seeds with its 95% bootstrap interval."""
    mean, low, high = mean_interval(np.array(values, float)).tolist()
    return {"seeds": len(values), "mean": mean, "low": low, "high": high}
