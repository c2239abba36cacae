"""`cuelearner train`, and the options that it shares with `cuelearner sweep`."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from itertools import chain, pairwise, product
from pathlib import Path
from typing import Annotated, Any, TypeVar

import tyro

from cuelearner_jax import plugins
from cuelearner_jax.api.worlds import NoOptions
from cuelearner_jax.cli.options import Flag, Kinds, Outside, RunParts, about, look_ahead_of, out, parse, unprefixed
from cuelearner_jax.cli.sources import preset_of, task_of
from cuelearner_jax.errors import UserError
from cuelearner_jax.guides import registry as guidances
from cuelearner_jax.run_config import PARTS, RunConfig
from cuelearner_jax.runs.grid import Grid
from cuelearner_jax.runs.order import Order
from cuelearner_jax.runs.shards import Shard
from cuelearner_jax.storage import label_files
from cuelearner_jax.studies import train
from cuelearner_jax.task import QUICKSTART

TrainingT = TypeVar("TrainingT", bound="TrainingOptions")
Settled = Annotated[Any, tyro.conf.Fixed, tyro.conf.Suppress]  # of the order, but no option: set after parsing


@dataclass(frozen=True, kw_only=True)
class TrainingOptions(Outside, RunParts, Order):
    """Options that train and sweep share, and the order that they make."""

    task: Settled = None
    grid: Settled = None
    split: Settled = "validation"
    shard: Settled = None
    setting: Settled = ()
    config: Annotated[RunConfig[Kinds], unprefixed] = field(default_factory=lambda: RunConfig(NoOptions()))
    out: Path = Path("runs/NAME")
    """Folder for results and checkpoints."""
    resume: Flag[bool] = False
    """Continue an interrupted run."""
    overwrite: Flag[bool] = False
    """Delete an earlier run in the folder."""
    labels_from: Path | None = None
    """Label file to use instead of asking the teacher; --labels is then by default the file's labels per seed."""
    tuning: Flag[bool] = False
    """Evaluate on the tuning episodes, which are for choosing settings, not on the validation episodes."""
    robot: str | None = None
    """Another robot of the task, which acts in training and in its evaluations (default: the task's own)."""
    track: str | None = None
    """Tracker that also gets the curves, as means over seeds: tensorboard or wandb (offline), below the run's
    folder."""


@dataclass(frozen=True, kw_only=True)
class Train(TrainingOptions):
    """Train one seed under one kind of guidance."""

    guidance: str = ""
    """Kind of guidance."""
    labels: int = 500
    """Number of labels to ask the teacher for; 0: the unguided agent."""
    seed: int = 0
    """Seed of the run."""


def run(arguments: list[str]) -> None:
    """Run the command. Raises what `studies.train.run` raises."""

    def usual(grid: Grid) -> dict[str, Any]:
        return {"guidance": asking_kind(grid.guidance), "labels": grid.labels[0], "seed": grid.seeds[0]}

    (options, *others), _ = parse_training(arguments, "train", Train, usual)
    if others:
        names = ", --".join(name for name, _ in options.setting)
        raise UserError(f"--{names}: train takes one value; give one, or several to cuelearner sweep")
    train_each([options], Grid((options.guidance,), (options.seed,), (options.labels,)))


def train_each(options: Sequence[TrainingOptions], grid: Grid, shard: Shard | None = None) -> None:
    """Train these lanes under each of the options and print where they lie. Raises what `studies.train.run` raises."""
    split, place = "tuning" if options[0].tuning else "validation", options[0].out
    train.run_each([replace(one, grid=grid, shard=shard, split=split) for one in options])
    out.print(f"done: {place} (show it by: cuelearner report {place} --out {place}/report)")


def parse_training(
    arguments: list[str], command: str, kind: type[TrainingT], usual: Callable[[Grid], dict[str, Any]]
) -> tuple[list[TrainingT], Grid]:
    """Return the options of a training command, for the chosen robot, and the grid of its preset.

    A number with several values gives options for each combination of such values, its `setting`. `usual`: from that
    grid, the default options that are not common to all training commands.
    """
    ahead = look_ahead_of(arguments, command, kind)
    task = task_of(ahead)
    name, preset = preset_of(task, ahead.preset, QUICKSTART)
    request = train.suggested(task, preset)
    grid, config = request.grid, request.config
    if ahead.labels_from is not None:
        grid = replace(grid, labels=(label_files.read(Path(ahead.labels_from)).budget,))
    for part, table in PARTS.items():
        own = None if (word := getattr(ahead, part)) is None else plugins.resolve(table, word, part)
        if own is not None and own is not type(getattr(config, part)):
            config = replace(config, **{part: own()})
    guides = [guidances.resolve(word) for word in ahead.guidance or grid.guidance]
    kinds = {one.name: config.kinds.get(one.name) or one.config() for one in guides if one.config}
    default = kind(config=replace(config, kinds=kinds), out=Path("runs") / f"{task.name}-{name}", **usual(grid))
    names, lines = _each_line(arguments, default.config)
    each = [parse(kind, line, command, default, about(kind, task, preset=QUICKSTART)) for line in lines]
    settings = [tuple((name, float(_number(options.config, name))) for name in names) for options in each]
    if len({*settings}) < len(settings):
        raise UserError(f"--{', --'.join(names)}: give each value once")
    if (robot := each[0].robot) is not None and ":" in robot:
        raise UserError(f"--robot is {robot}, but training takes no folder of a robot: give its name alone")
    pairs = zip(each, settings, strict=True)
    return [replace(options, task=task.on(robot), setting=setting) for options, setting in pairs], grid


def _each_line(arguments: list[str], config: RunConfig) -> tuple[list[str], list[list[str]]]:
    """Return the numbers of a configuration that have several values, and a command line for each combination."""
    names, choices = [], []
    starts = [place for place, word in enumerate(arguments) if word.startswith("--")]
    for words in (arguments[start:end] for start, end in pairwise([0, *starts, len(arguments)])):
        name = words[0].removeprefix("--").replace("-", "_") if len(words) > 2 else ""
        several = _number(config, name) is not None
        names += [name] if several else []
        choices.append([[words[0], value] for value in words[1:]] if several else [words])
    return names, [[*chain(*line)] for line in product(*choices)]


def _number(config: RunConfig, name: str) -> Any:
    """Return the value of an option, as `part.field`; None unless it is a number."""
    part, _, field = name.partition(".")
    value = getattr(config.kinds.get(part, getattr(config, part, None)), field, None)
    return value if type(value) in (int, float) else None


def asking_kind(kinds: tuple[str, ...]) -> str:
    """Return the first of the kinds that asks a teacher, or else the first."""
    return next((kind for kind in kinds if guidances.resolve(kind).asks), kinds[0])
