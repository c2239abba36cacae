"""`cuelearner evaluate`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Generic

import numpy as np
from rich.table import Table

from cuelearner_jax.cli.parsing import about, out, parse, source_of, world_of
from cuelearner_jax.cli.shared_options import TaskT
from cuelearner_jax.errors import UserError
from cuelearner_jax.evaluate import Tell
from cuelearner_jax.runs import measured
from cuelearner_jax.runs.measured import Measured
from cuelearner_jax.task import Task
from cuelearner_jax.terminal import console, progress_bars


@dataclass(frozen=True)
class Evaluate(Generic[TaskT]):
    """Validate a run, an adapted policy, or a task's teacher, heuristic or chance; in any changed world."""

    task: TaskT
    policy: str = "agent"
    """Who acts, see above."""
    guidance: tuple[str, ...] = ()
    """Only these kinds of guidance of the run (default: all)."""
    episodes: int | None = None
    """Whole episodes for each lane, where the task counts episodes (default: 100)."""
    steps: int | None = None
    """Instead: environment steps for each lane (default, where the task counts steps: 10,000)."""
    envs: int | None = None
    """Environments that share the steps (default: 100)."""
    robot: str | None = None
    """Another robot, see above (default: the task's own); with a folder, as anymal:FOLDER, one with your own walking
    policy."""
    engine: str | None = None
    """Other physics that the robot has; anymal: mujoco, for C MuJoCo at a finer step instead of MJX; first episodes
    only."""
    scenario: str | None = None
    """The changed world of this name, see above; options of the task (--task.…) come on top of it."""
    out: Path | None = None
    """Also write the measurements to this JSON file. (Beside all these: --base package.module:NAME gives the code of a
    policy folder that has some.)"""


MOST_ENVS = 100_000  # that memory has room for
MOST_STEPS = 1_000_000  # of an environment

OPTIONS = {"evaluate": Evaluate}


def run(arguments: list[str]) -> None:
    """Runs the command. Raises UserError for what cannot be evaluated."""
    source, rest = source_of(arguments, "evaluate", Evaluate)
    kind = Evaluate[source.task.config]  # pyright: ignore[reportInvalidTypeArguments]
    default = kind(world_of(source, rest), policy=source.default_policy)
    asked = parse(kind, rest, f"evaluate {source.folder}", default, about(Evaluate, source.task, policies=True))
    source = source.on(asked.robot)
    engine = source.task.engine(asked.engine)
    source.check(asked.policy, asked.task, guidance=asked.guidance)
    envs, steps = _work(source.task, asked)
    if asked.out and asked.out.exists():
        raise UserError(f"{asked.out} exists: give another --out")
    with progress_bars(shown=console.is_terminal) as bars:

        def watch(kind: str) -> Tell:
            bar = bars.add_task(kind, total=None, note="")
            return lambda done, count: bars.update(bar, completed=done, total=count)

        found = measured.evaluate(source, asked.task, asked.policy, asked.guidance, envs, steps, engine, watch)
    told = {"robot": asked.robot, "engine": asked.engine, "scenario": asked.scenario}
    told = {name: value for name, value in told.items() if value}
    robot = {"robot_digest": digest} if (digest := source.task.bodies[0].digest) else {}
    amount = f"{steps:,} steps a lane" if source.task.longest is None else f"{envs:,} episodes a lane"
    if asked.out:  # first: whoever reads the table may leave before its end
        measured.write(asked.out, source, asked.task, asked.policy, envs, steps, found, {**told, **robot})
    out.print(_measurements(found, ", ".join([asked.policy, *told.values(), amount])))
    if any((row.metrics.get("finished", np.ones(1)) < 1).any() for row in found):
        console.print("not every first episode has ended, so outcomes have no mean: give more --steps")
    if asked.out:
        out.print(f"wrote {asked.out}")


def _work(task: Task, asked: Evaluate[Any]) -> tuple[int, int]:
    """Environments, and steps that they share. Raises UserError for what makes no sense or cuts episodes short."""
    longest = None if task.longest is None else task.longest(asked.task)
    if asked.episodes is not None:
        if asked.steps is not None or asked.envs is not None:
            raise UserError("--episodes says how many environments take how many steps: leave out --steps and --envs")
        if longest is None:
            raise UserError(f"{task.name} counts steps, not episodes: give --steps in place of --episodes")
        if not 1 <= asked.episodes <= MOST_ENVS:
            raise UserError(f"--episodes is {asked.episodes}: give a number from 1 to {MOST_ENVS:,}")
        return asked.episodes, asked.episodes * longest
    envs = 100 if asked.envs is None else asked.envs
    if not 1 <= envs <= MOST_ENVS:
        raise UserError(f"--envs is {envs}: give a number from 1 to {MOST_ENVS:,}")
    default = 10_000 if longest is None else envs * longest
    steps = default if asked.steps is None else asked.steps
    if steps < 1 or steps % envs:
        raise UserError(f"--steps is {steps}: give a positive multiple of --envs ({envs})")
    if steps // envs > MOST_STEPS:
        raise UserError(f"--steps is {steps}: give at most {MOST_STEPS:,} for each of the environments (--envs)")
    task.check_whole(asked.task, envs, steps, "--envs", "--steps")
    return envs, steps


def _measurements(found: list[Measured], title: str) -> Table:
    """Interquartile means over seeds with their intervals, a row for each guidance and budget."""
    from cuelearner_jax.report.statistics import interval

    table = Table("guidance", "labels", "seeds", "steps", "metric", "mean", "95% interval", title=title)
    for column in table.columns:
        column.no_wrap = True
    for row in found:
        own = [row.guidance, str(row.labels), str(len(row.seeds)), str(row.step)]
        below = "" if row.bound_deg is None else f"≤ {row.bound_deg:g} deg"
        for name, values in row.metrics.items():
            if np.isfinite(values).all():
                of = interval(values)
                spread = f"{float(of.lower):.3f} to {float(of.upper):.3f}" if len(values) > 1 else ""
                table.add_row(*own, name, f"{float(of.estimate):.3f}", spread)
            else:
                table.add_row(*own, name, "none", f"of {len(values)}, {int(np.isfinite(values).sum())} have one")
            own, below = [below] + [""] * (len(own) - 1), ""
        table.add_section()
    return table
