"""`cuelearner evaluate`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Generic

from rich.table import Table

from cuelearner_jax.cli.parsing import about, out, parse, source_of, world_of
from cuelearner_jax.cli.shared_options import TaskT
from cuelearner_jax.errors import UserError
from cuelearner_jax.runs import trained


@dataclass(frozen=True)
class Evaluate(Generic[TaskT]):
    """Validate a run's newest checkpoints, or a task's teacher, heuristic or chance; in any changed world."""

    task: TaskT
    policy: str = "agent"
    """Who acts, see above."""
    guidance: tuple[str, ...] = ()
    """Only these kinds of guidance of the run (default: all)."""
    steps: int = 10_000
    """Environment steps for each lane."""
    envs: int = 100
    """Environments that share them."""
    robot: str | None = None
    """Another robot, see above (default: the task's own)."""
    engine: str | None = None
    """Other physics that the robot has; anymal: mujoco, for C MuJoCo at a finer step instead of MJX; first episodes
    only."""
    scenario: str | None = None
    """The changed world of this name, see above; options of the task (--task.…) come on top of it."""
    out: Path | None = None
    """Also write the measurements to this JSON file."""


OPTIONS = {"evaluate": Evaluate}


def run(arguments: list[str]) -> None:
    """Runs the command. Raises UserError for what cannot be evaluated."""
    source, rest = source_of(arguments, "evaluate", Evaluate)
    kind = Evaluate[source.task.config]  # pyright: ignore[reportInvalidTypeArguments]
    default = kind(world_of(source, rest), policy="agent" if source.grid else "heuristic")
    asked = parse(kind, rest, f"evaluate {source.folder}", default, about(Evaluate, source.task, policies=True))
    source = source.on(asked.robot)
    engine = source.task.engine(asked.engine)
    source.check(asked.policy, asked.task, guidance=asked.guidance)
    if asked.steps < 1 or asked.envs < 1 or asked.steps % asked.envs:
        raise UserError(f"--steps is {asked.steps}: give a positive multiple of --envs ({asked.envs})")
    if asked.out and asked.out.exists():
        raise UserError(f"{asked.out} exists: give another --out")
    measured = trained.evaluate(source, asked.task, asked.policy, asked.guidance, asked.envs, asked.steps, engine)
    told = {"robot": asked.robot, "engine": asked.engine, "scenario": asked.scenario}
    told = {name: value for name, value in told.items() if value}
    out.print(_measurements(measured, ", ".join([asked.policy, *told.values(), f"{asked.steps} steps a lane"])))
    if asked.out:
        trained.write(asked.out, source, asked.task, asked.policy, asked.envs, asked.steps, measured, told)
        out.print(f"wrote {asked.out}")


def _measurements(measured: list[trained.Measured], title: str) -> Table:
    """Interquartile means over seeds with their intervals, a row for each guidance and budget."""
    from cuelearner_jax.report.statistics import interval

    table = Table("guidance", "labels", "seeds", "steps", "metric", "mean", "95% interval", title=title)
    for column in table.columns:
        column.no_wrap = True
    for row in measured:
        own = [row.guidance, str(row.labels), str(len(row.seeds)), str(row.step)]
        for name, values in row.metrics.items():
            found = interval(values)
            spread = f"{float(found.lower):.3f} to {float(found.upper):.3f}" if len(values) > 1 else ""
            table.add_row(*own, name, f"{float(found.estimate):.3f}", spread)
            own = [""] * len(own)
        table.add_section()
    return table
