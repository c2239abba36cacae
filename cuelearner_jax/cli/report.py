"""`cuelearner report`."""

from __future__ import annotations

import shlex
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import tyro

from cuelearner_jax.cli.parsing import out, parse
from cuelearner_jax.cli.shared_options import Flag
from cuelearner_jax.errors import UserError


@dataclass(frozen=True)
class Report:
    """Curves and tables with intervals from recorded results."""

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
    by_run: Flag[bool] = False
    """Tell the folders apart by their names, as runs of different configurations: each is compared with its own
    unguided agents, or, where it has none, with those of the first folder that has."""
    efficiency: Flag[bool] = False
    """Also say how far labels carry: the guide alone, steps to a level, areas under the curve and labels for either,
    each with an interval."""
    level: float | None = None
    """With --efficiency: value of the metric to be reached."""
    level_at: int | None = None
    """With --efficiency: instead, what the first folder's unguided agents have at this step (default: at the last
    step that all have)."""
    within: float | None = None
    """With --efficiency: share of the unguided agents' steps in which labels are to bring agents to the level (default:
    two thirds)."""
    reference: str | None = None
    """With --efficiency: kind of guidance with whose labels those of others are compared (default: each)."""
    overwrite: Flag[bool] = False
    """Replace an earlier report."""

    @property
    def question(self) -> dict[str, Any]:
        """What was said of what --efficiency is to look for."""
        given = {"level": self.level, "level_at": self.level_at, "within": self.within, "reference": self.reference}
        return {name: value for name, value in given.items() if value is not None}


OPTIONS = {"report": Report}


def run(arguments: list[str]) -> None:
    """Runs the command. Raises UserError for what cannot be reported."""
    # They load what draws, which other commands need not wait for.
    from cuelearner_jax.report.document import report
    from cuelearner_jax.report.efficiency import Question

    asked = parse(Report, arguments, "report")
    if not asked.folders:
        raise UserError("no folder to report on: cuelearner report RUN_FOLDER ... --out FOLDER")
    if asked.question and not asked.efficiency:
        first = next(iter(asked.question)).replace("_", "-")
        raise UserError(f"--{first} says what --efficiency is to look for: give both")
    written = report(
        asked.folders,
        asked.out,
        asked.metric,
        split=asked.split,
        lower_is_better=asked.lower_is_better,
        by_run=asked.by_run,
        efficiency=Question(**asked.question) if asked.efficiency else None,
        overwrite=asked.overwrite,
        command=shlex.join(["cuelearner", "report", *arguments]),
    )
    out.print(f"wrote {written}")
