"""The options of each command, as dataclasses: a field is an option, the text below it its help."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Generic, Literal, TypeVar

import tyro

from cuelearner_jax.bench.measuring import Measuring
from cuelearner_jax.brax_bridge.walking import LocomotionConfig
from cuelearner_jax.config import RunConfig
from cuelearner_jax.runs.cluster import Job
from cuelearner_jax.teachers.learned import TeacherConfig

TaskT = TypeVar("TaskT")
Flag = tyro.conf.FlagCreatePairsOff


@dataclass(frozen=True)
class Common(Generic[TaskT]):
    """What train and sweep share."""

    run: Annotated[RunConfig[TaskT], tyro.conf.arg(name="")]
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


@dataclass(frozen=True)
class Train(Common[TaskT], Generic[TaskT]):
    """Train one seed under one kind of guidance."""

    guidance: str = "relative"
    """none, relative or heuristic."""
    labels: int = 500
    """Labels that the teacher is asked for."""
    seed: int = 0
    """Seed."""


@dataclass(frozen=True)
class Sweep(Common[TaskT], Generic[TaskT]):
    """Train seeds x label budgets x kinds of guidance in one process."""

    guidance: tuple[str, ...] = ("none", "relative", "heuristic")
    """Any of none, relative, heuristic."""
    labels: tuple[int, ...] = (500,)
    """Label budgets; guidance without labels runs once a seed."""
    seeds: int = 5
    """Number of seeds."""
    first_seed: int = 0
    """The first seed; the others follow."""
    shard: str | None = None
    """Only piece i of n, as i/n: its share of the seeds, in a folder of its own below --out. Goes on by itself where it
    was interrupted."""
    cluster: Literal["slurm", "local"] | None = None
    """Run the sweep as jobs, one a piece: slurm submits them as a job array and returns, local runs them on this
    machine and waits. The same command again goes on with the pieces that are not finished. Needs submitit."""
    shards: int | None = None
    """With --cluster: number of pieces, and so of jobs."""
    job: Job = field(default_factory=Job)


@dataclass(frozen=True)
class Evaluate(Generic[TaskT]):
    """Validate policies."""

    task: TaskT
    policy: str = "agent"
    """Of a run: agent, guide (guidance of uniform actions), guided (guidance of the agent's), corrected (the teacher's
    own feedback on the agent's); of a run or a task alone: teacher, heuristic or uniform."""
    guidance: tuple[str, ...] = ()
    """Only these kinds of guidance of the run (default: all)."""
    steps: int = 10_000
    """Environment steps for each lane."""
    envs: int = 100
    """Environments that share them."""
    robot: str | None = None
    """navigation: anymal, a quadruped with full physics in MJX (default: the task's own robot)."""
    engine: str | None = None
    """With a robot: mujoco, for C MuJoCo at a finer step instead of MJX; first episodes only."""
    out: Path | None = None
    """Also write the measurements to this JSON file."""


@dataclass(frozen=True)
class Render(Generic[TaskT]):
    """A still and a film."""

    task: TaskT
    out: Path
    """Folder for the pictures; films and stills of the same name are not overwritten."""
    policy: str = "agent"
    """As for evaluate."""
    guidance: str | None = None
    """Kind of guidance of the run (default: its last)."""
    labels: int | None = None
    """Label budget of the lane (default: the largest)."""
    seed: int | None = None
    """Seed of the lane (default: the first)."""
    steps: int = 4
    """Steps to film; a new episode follows the end of one."""
    episode: int = 0
    """Which random start."""
    robot: str | None = None
    """navigation: anymal, filmed by MuJoCo (default: the task's own robot)."""
    film: str = "gif"
    """gif or mp4."""
    overwrite: Flag[bool] = False
    """Replace pictures of the same name."""


@dataclass(frozen=True)
class Report:
    """Curves and tables."""

    folders: tyro.conf.Positional[tuple[Path, ...]]
    """Run folders, or folders above them."""
    out: Path
    """Folder for the report."""
    metric: str = "reward"
    """Column of the results."""
    split: str = "validation"
    """Episodes of the results: validation, or tuning."""
    lower_is_better: Flag[bool] = False
    """Small values of the metric are good ones, as of collisions."""
    overwrite: Flag[bool] = False
    """Replace an earlier report."""


@dataclass(frozen=True)
class TeacherTrain(Generic[TaskT]):
    """Train a teacher."""

    task: TaskT
    out: Path
    """Folder for the teacher."""
    teacher: TeacherConfig = field(default_factory=TeacherConfig)
    seed: int = 0
    """Seed."""
    eval_steps: int = 10_000
    """Validation steps at the end."""
    resume: Flag[bool] = False
    """Go on with an interrupted training."""


@dataclass(frozen=True)
class Bench:
    """Measure the small presets (quickstart) of all tasks, which takes about a minute, and compare with known machines.

    Name a task first to measure one configuration: cuelearner bench billiards --preset paper --seeds 8 75
    """

    measuring: Annotated[Measuring, tyro.conf.arg(name="")] = field(default_factory=Measuring)
    full: Flag[bool] = False
    """The paper-sized presets instead (paper); minutes."""
    add: Path | None = None
    """Measure nothing: take this file, which --out wrote, into the table of known machines."""


@dataclass(frozen=True)
class BenchTask(Generic[TaskT]):
    """Measure one configuration."""

    run: Annotated[RunConfig[TaskT], tyro.conf.arg(name="")]
    measuring: Annotated[Measuring, tyro.conf.arg(name="")] = field(default_factory=Measuring)


@dataclass(frozen=True)
class LocomotionTrain:
    """Train the quadruped's walking policy."""

    out: Path = Path("runs/anymal-policy")
    """Folder for the policy."""
    train: LocomotionConfig = field(default_factory=LocomotionConfig)
    seed: int = 0
    """Seed."""


@dataclass(frozen=True)
class LocomotionEvaluate:
    """Measure a walking policy in MJX and in C MuJoCo."""

    policy: tyro.conf.Positional[Path | None] = None
    """Folder of a policy (default: the shipped one)."""
    robots: int = 512
    """Robots that walk for 20 s in each trial."""
    seed: int = 1
    """Decides commands, grounds, noise and pushes."""
    out: Path | None = None
    """Also write the figures to this JSON file."""
