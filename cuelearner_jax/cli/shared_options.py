"""Options that several commands share; a field is an option, and its docstring the option's help."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, make_dataclass, replace
from itertools import takewhile
from pathlib import Path
from typing import Annotated, Any, Generic, TypeVar

import tyro

from cuelearner_jax.cli import pages
from cuelearner_jax.cli.pages import Subject
from cuelearner_jax.cli.parsing import about, parse, taken
from cuelearner_jax.cli.sources import preset_of, source_of, task_of, world_of
from cuelearner_jax.environment import offers
from cuelearner_jax.errors import UserError
from cuelearner_jax.guides import registry as guidances
from cuelearner_jax.run_config import PARTS, RunConfig
from cuelearner_jax.runs import trained
from cuelearner_jax.runs.grid import Grid
from cuelearner_jax.runs.order import Order
from cuelearner_jax.runs.shards import Shard
from cuelearner_jax.runs.trained import PolicySource
from cuelearner_jax.studies.train import suggested
from cuelearner_jax.task import QUICKSTART, Task, shape_of

TaskT = TypeVar("TaskT")
RunT = TypeVar("RunT", bound=RunConfig)
KindsT = TypeVar("KindsT")
Flag = tyro.conf.FlagCreatePairsOff


@dataclass(frozen=True, kw_only=True)
class Outside:
    """Options that name code and worlds; `sources` reads them before the others, since they decide what options there
    are."""

    env: str | None = None
    """World: a task, or a library's environment, as gymnasium:FetchReach-v4 (--task is another name of this option)."""
    teacher: str | None = None
    """Your own teacher: package.module:NAME of a function of observations, a policy or a teacher (default: the
    task's)."""


@dataclass(frozen=True, kw_only=True)
class Lane:
    """Choice of a folder's policy, and of its lane."""

    policy: str | None = None
    """Name of the acting policy, as for evaluate (default: the agent, or the adapted policy)."""
    guidance: str | None = None
    """Kind of guidance of the lane (default: the run's last)."""
    labels: int | None = None
    """Label budget of the lane (default: the largest)."""
    bound_deg: float | None = None
    """Bound of a policy folder's lane (default: the largest) [deg]."""
    seed: int | None = None
    """Seed of the lane (default: the first)."""

    @property
    def chosen(self) -> dict[str, Any]:
        """Return the options that were given to choose a lane, by name."""
        lane = {"guidance": self.guidance, "labels": self.labels, "seed": self.seed, "bound-deg": self.bound_deg}
        return {name: value for name, value in lane.items() if value is not None}

    def name_in(self, source: PolicySource, world: Any) -> str:
        """Return the policy's name. Raises UserError if the source has no such policy, or none for that world."""
        name = self.policy or source.default_policy
        source.check(name, world, self.guidance)
        return name

    def policy_in(self, source: PolicySource, world: Any, env: Any) -> Any:
        """Return the single policy. Raises UserError if there is no such lane."""
        name = self.policy or source.default_policy
        return trained.one_policy(source, world, name, self.guidance, self.labels, self.seed, self.bound_deg, env)


def asked_of_source(arguments: list[str], command: str, kind: Any, more: str = "") -> tuple[PolicySource, Any]:
    """Return the policies' source, with the chosen robot, and the options of a command.

    `kind` is generic in the task's configuration. `more` is added to the help's text. Raises UserError for choices that
    do not exist.
    """
    source, rest = source_of(arguments, command, kind)
    default = kind[source.task.config](task=world_of(source, rest), policy=source.default_policy)
    told = f"{about(kind, source.task, policies=True)}{more}"
    subject = subject_of(source)
    asked = parse(kind[source.task.config], rest, f"{command} {subject.typed}", default, told, subject)
    return source.on(getattr(asked, "robot", None)), asked


@dataclass(frozen=True)
class Training(Outside, Generic[RunT]):
    """Options that train and sweep share."""

    run: Annotated[RunT, tyro.conf.arg(name="")]  # a RunConfig
    out: Path
    """Folder for results and checkpoints."""
    resume: Flag[bool] = False
    """Continue an interrupted run."""
    overwrite: Flag[bool] = False
    """Delete an earlier run in the folder."""
    labels_from: Path | None = None
    """Label file to use instead of asking the teacher."""
    tuning: Flag[bool] = False
    """Evaluate on the tuning episodes, which are for choosing settings, not on the validation episodes."""
    robot: str | None = None
    """Another robot of the task, which acts in training and in its evaluations (default: the task's own)."""
    track: str | None = None
    """Tracker that also gets the curves, as means over seeds: tensorboard or wandb (offline), below the run's
    folder."""

    def order(self, task: Task, grid: Grid, shard: Shard | None = None) -> Order:
        """Return the order to train a grid of a task."""
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
        """The line printed at the end."""
        return f"done: {self.out} (show it by: cuelearner report {self.out} --out {self.out}/report)"


def asked_of_preset(
    arguments: list[str], command: str, kind: Any, options: Callable[[Grid], dict[str, Any]]
) -> tuple[Task, Any]:
    """Return the task and the options of a training command. Raises UserError for choices that do not exist.

    `kind` is generic in the run's configuration. `options` returns defaults from what the preset compares.
    """
    task, rest = task_of(arguments, command, kind)
    name, preset, rest = preset_of(task, rest, QUICKSTART)
    request = suggested(task, preset)
    config, run_type, rest = parts_of(request.config, rest, request.grid.guidance)
    default = kind[run_type](config, out=Path("runs") / f"{task.name}-{name}", **options(request.grid))
    subject = pages.subject_of(typed_name(task), task.name, task)
    asked = parse(
        kind[run_type], rest, f"{command} {subject.typed}", default, about(kind, task, preset=QUICKSTART), subject
    )
    if asked.robot is not None and ":" in asked.robot:
        raise UserError(f"--robot is {asked.robot}, but training takes no folder of a robot: give its name alone")
    return task.on(asked.robot), asked


def typed_name(task: Task) -> str:
    """How a task is named on the command line."""
    return task.origin or task.named or task.name


def subject_of(source: PolicySource) -> Subject:
    """A task, or a folder with policies, as examples name it."""
    task, name = source.task, source.folder.name
    typed = str(source.folder) if source.folder.is_dir() else typed_name(task)
    world = shape_of(task, source.config.task)
    needs = trained.POLICIES[source.default_policy].needs
    return pages.subject_of(typed, name, task, all(offers(world, need) for need in needs))


def as_kept(run: RunConfig) -> RunConfig:
    """Return the command line's configuration with its options of kinds as a dictionary by name."""
    return replace(run, kinds=vars(run.kinds))


def parts_of(config: RunConfig, arguments: list[str], kinds: tuple[str, ...]) -> tuple[RunConfig, Any, list[str]]:
    """Return a preset's configuration with the chosen agent, arbiter and options of kinds.

    Also returns its type, from which tyro makes options, and the other arguments. The configuration's `kinds` is a
    dataclass. Raises UserError for a part that is not available.
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


unprefixed = tyro.conf.arg(name="")  # options of kinds are named `--KIND.…`


def kinds_type(options: Mapping[str, Any]) -> type:
    """Make the dataclass with one field per kind of guidance, with the given options as defaults."""
    fields = [(name, type(own), field(default=own)) for name, own in options.items()]
    return make_dataclass("Kinds", fields, frozen=True)


def named_kinds(arguments: list[str]) -> tuple[str, ...]:
    """Return the values of --guidance as typed."""
    for place, argument in enumerate(arguments):
        if argument.startswith("--guidance="):
            return (argument.partition("=")[2],)
        if argument == "--guidance":
            return tuple(takewhile(lambda word: not word.startswith("-"), arguments[place + 1 :]))
    return ()


def asking_kind(kinds: tuple[str, ...]) -> str:
    """Return the first of the kinds that asks a teacher, or else the first."""
    asking = [kind for kind in kinds if guidances.resolve(kind).asks]
    return (asking or list(kinds))[0]
