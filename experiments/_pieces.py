"""The runner of studies: pieces are data, commands run them at a scale, and one report reads their runs."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

from cuelearner_jax.cli import main as cuelearner

FIRST_SEED = 4000  # of reported runs; settings are chosen on seeds from 0 on, with --tuning
Options = Mapping[str, object]  # of a command: a value, several in a tuple, or whether a flag is on
SMOKE: Options = {  # of every sweep at the scale `smoke`
    "agent.replay-capacity": 200,
    "sizes.feedback-layers": 16,
    "sizes.labels-per-round": 5,
    "sizes.fit-steps": 20,
    "sizes.fit-batch-size": 10,
    "sizes.lanes-per-block": 1,
    "schedule.total-steps": 200,
    "schedule.random-steps": 50,
    "schedule.learn-after": 50,
    "schedule.guidance-until": 200,
    "schedule.eval-every": 100,
    "schedule.eval-envs": 5,
    "schedule.eval-steps": 100,
    "schedule.checkpoint-every": 200,
}


class Piece(NamedTuple):
    """One sweep, or one policy in a changed world. Its folder is world/run/name."""

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
    """Return the command line of a piece that is a sweep."""
    own: dict[str, object] = {"first-seed": FIRST_SEED, **piece.options, "guidance": piece.kinds}
    first = own.pop("first-seed")  # no option: the first of the seeds
    own["seeds"] = f"{first}:{int(str(first)) + piece.seeds}"
    own |= {"labels": piece.labels} if piece.labels else {}
    folder = out / piece.path
    going_on = ["--resume"] if resume and (folder / "config.json").exists() else []
    return ["sweep", task, *words_of(own), "--out", str(folder), *going_on]


class Experiment(NamedTuple):
    """The pieces of one study."""

    task: str
    pieces: tuple[Piece, ...]
    scales: Mapping[str, Scale]
    # Options of `cuelearner report --efficiency` at the scale `paper`, by world; None: there is no report.
    report: Mapping[str, Sequence[str]] | None = None
    metric: Sequence[str] = ()  # options of it at every scale
    # (task, piece, folder of all pieces, go on?) -> command lines of the piece
    commands: Callable[[str, Piece, Path, bool], list[list[str]]] = lambda *piece: [sweep_command(*piece)]


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


def report_command(experiment: Experiment, world: str, out: Path, scale: str) -> list[str] | None:
    """Return the command line of the report on the runs of a world, or None where no unguided run has begun."""
    own = [piece for piece in experiment.pieces if piece.world == world]
    begun = [piece for piece in own if (out / piece.path / "config.json").exists()]
    kinds = {kind for piece in begun for kind in piece.kinds}
    if "none" not in kinds:
        return None
    more = list((experiment.report or {}).get(world, ())) if scale == "paper" else []
    if "--reference" in more and more[(at := more.index("--reference")) + 1] not in kinds:
        del more[at : at + 2]
    folders = dict.fromkeys(str(out / world / piece.run) for piece in begun)
    how = ["--by-run", "--efficiency", *experiment.metric, *more]
    return ["report", *folders, *how, "--out", str(out / world / "report"), "--overwrite"]


def pieces_below(pieces: Sequence[Piece], names: Sequence[str]) -> list[Piece]:
    """Return the pieces of these names, or below these folders, in the order of the data; all for no name.

    Raises ValueError for a name that none has.
    """

    def below(piece: Piece, name: str) -> bool:
        return f"{piece.path}/".startswith(f"{name.rstrip('/')}/")

    for name in names:
        if not any(below(piece, name) for piece in pieces):
            raise ValueError(f"no piece {name!r}: see --list")
    return [piece for piece in pieces if not names or any(below(piece, name) for name in names)]


def run(experiment: Experiment, about: str, arguments: Sequence[str] | None = None) -> int:
    """Run pieces and reports on their worlds; stop at the first command that fails and return its status."""
    parser = argparse.ArgumentParser(
        description=about, formatter_class=argparse.RawDescriptionHelpFormatter, allow_abbrev=False
    )
    scales = "; ".join(f"{name}: {scale.about}" for name, scale in experiment.scales.items())
    parser.add_argument("--scale", choices=list(experiment.scales), default="paper", help=scales)
    parser.add_argument("--pieces", nargs="+", default=[], metavar="NAME", help="these alone, or all below a folder")
    parser.add_argument("--out", type=Path, default=Path("runs/studies") / experiment.task, help="folder")
    parser.add_argument("--resume", action="store_true", help="go on with pieces that were begun, leave finished ones")
    parser.add_argument("--list", action="store_true", help="list the pieces and stop")
    parser.add_argument("--report", action="store_true", help="report on what there is, and run nothing")
    options = parser.parse_args(arguments)
    try:
        pieces = pieces_below(experiment.pieces, options.pieces)
    except ValueError as error:
        parser.error(str(error))
    if options.list:
        print("\n".join(f"{piece.path}: {piece.seeds} seeds, labels {piece.labels or 'none'}" for piece in pieces))
        return 0
    out = options.out if options.scale == "paper" else options.out / options.scale
    own = [scaled(piece, experiment.scales[options.scale]) for piece in pieces if not options.report]
    for piece in filter(None, own):
        for command in experiment.commands(experiment.task, piece, out, options.resume):
            if status := cuelearner(command):
                return status
    worlds = dict.fromkeys(piece.world for piece in pieces if experiment.report is not None)
    reports = [report_command(experiment, world, out, options.scale) for world in worlds]
    return next((status for command in reports if command and (status := cuelearner(command))), 0)
