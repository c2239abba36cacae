"""`cuelearner report`."""

from __future__ import annotations

import shlex
from dataclasses import dataclass
from pathlib import Path

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
    overwrite: Flag[bool] = False
    """Replace an earlier report."""


OPTIONS = {"report": Report}


def run(arguments: list[str]) -> None:
    """Runs the command. Raises UserError for what cannot be reported."""
    # It loads what draws, which other commands need not wait for.
    from cuelearner_jax.report.document import report

    asked = parse(Report, arguments, "report")
    if not asked.folders:
        raise UserError("no folder to report on: cuelearner report RUN_FOLDER ... --out FOLDER")
    written = report(
        asked.folders,
        asked.out,
        asked.metric,
        split=asked.split,
        lower_is_better=asked.lower_is_better,
        by_run=asked.by_run,
        overwrite=asked.overwrite,
        command=shlex.join(["cuelearner", "report", *arguments]),
    )
    out.print(f"wrote {written}")
