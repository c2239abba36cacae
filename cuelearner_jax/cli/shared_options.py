"""What several commands share of their options: a field is an option, the text below it its help."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, make_dataclass, replace
from itertools import takewhile
from pathlib import Path
from typing import Annotated, Any, Generic, TypeVar

import tyro

from cuelearner_jax.cli.parsing import taken
from cuelearner_jax.guides import registry as guidances
from cuelearner_jax.run_config import PARTS, RunConfig
from cuelearner_jax.runs.grid import Grid
from cuelearner_jax.runs.order import Order
from cuelearner_jax.runs.shards import Shard
from cuelearner_jax.task import Preset, Task, shape_of

TaskT = TypeVar("TaskT")
RunT = TypeVar("RunT", bound=RunConfig)
KindsT = TypeVar("KindsT")
Flag = tyro.conf.FlagCreatePairsOff


@dataclass(frozen=True)
class Training(Generic[RunT]):
    """What train and sweep share."""

    run: Annotated[RunT, tyro.conf.arg(name="")]  # a RunConfig
    out: Path
    """Folder for results and checkpoints."""
    resume: Flag[bool] = False
    """Go on with an interrupted run."""
    overwrite: Flag[bool] = False
    """Delete what an earlier run left in the folder."""
    labels_from: Path | None = None
    """Use the labels of this file instead of asking the teacher."""
    tuning: Flag[bool] = False
    """Evaluate on episodes set aside for choosing settings, not on those of reported figures."""
    track: str | None = None
    """Also write curves, means over seeds, for tensorboard or wandb (offline), below the run's folder."""

    def order(self, task: Task, grid: Grid, shard: Shard | None = None) -> Order:
        """What is asked for, of a task and a grid."""
        return Order(
            task,
            as_kept(self.run),
            grid,
            self.out,
            resume=self.resume,
            overwrite=self.overwrite,
            labels_from=self.labels_from,
            shard=shard,
            split="tuning" if self.tuning else "validation",
            track=self.track,
        )

    @property
    def done(self) -> str:
        """What is told at the end."""
        return f"done: {self.out} (see it with: cuelearner report {self.out} --out {self.out}/report)"


def as_kept(run: RunConfig) -> RunConfig:
    """A configuration of the command line with its options of kinds by name."""
    return replace(run, kinds=vars(run.kinds))


def parts_of(config: RunConfig, arguments: list[str], kinds: tuple[str, ...]) -> tuple[RunConfig, Any, list[str]]:
    """The configuration with the agent and the arbiter that are asked for, and options of kinds that are in use.

    Args:
        config: a preset's; its own options of a part hold if the part is the same.
        arguments: what was typed; --agent and --arbiter name parts.
        kinds: of guidance, by name or as package.module:NAME, where --guidance names none.

    Returns:
        The configuration, its `kinds` a dataclass; its type, of which tyro makes options; the other arguments.

    Raises:
        UserError: a part that cannot be had.
    """
    for name, known in PARTS.items():
        asked, arguments = taken(arguments, f"--{name}", ", ".join(kind.NAME for kind in known.known))
        kind = type(getattr(config, name)) if asked is None else known.resolve(asked)
        if kind is not type(getattr(config, name)):
            config = replace(config, **{name: kind()})
    used = [guidances.resolve(kind) for kind in named_kinds(arguments) or kinds]
    options = kinds_type({one.name: config.kinds.get(one.name) or one.config() for one in used if one.config})
    config = replace(config, kinds=options())
    types = (type(config.task), type(config.agent), type(config.arbiter), Annotated[options, unprefixed])
    return config, RunConfig[types], arguments  # pyright: ignore[reportInvalidTypeArguments]


unprefixed = tyro.conf.arg(name="")  # options of kinds are `--KIND.…`


def kinds_type(options: Mapping[str, Any]) -> type:
    """The type whose fields are options of kinds, by their names; these are its defaults."""
    fields = [(name, type(own), field(default=own)) for name, own in options.items()]
    return make_dataclass("Kinds", fields, frozen=True)


def named_kinds(arguments: list[str]) -> tuple[str, ...]:
    """The values of --guidance, as they are typed."""
    for place, argument in enumerate(arguments):
        if argument.startswith("--guidance="):
            return (argument.partition("=")[2],)
        if argument == "--guidance":
            return tuple(takewhile(lambda word: not word.startswith("-"), arguments[place + 1 :]))
    return ()


def preset_kinds(task: Task, preset: Preset) -> tuple[str, ...]:
    """The kinds of guidance that a preset compares: those it names, or all that the task can have."""
    return preset.guidance or guidances.possible(shape_of(task, preset.config.task), taught=task.teacher is not None)


def asking_kind(kinds: tuple[str, ...]) -> str:
    """The first of the kinds that asks a teacher, or else the first."""
    asking = [kind for kind in kinds if guidances.resolve(kind).asks]
    return (asking or list(kinds))[0]
