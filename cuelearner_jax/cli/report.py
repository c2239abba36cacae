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
    """Write curves and tables with intervals from recorded results."""

    folders: tyro.conf.Positional[tuple[Path, ...]]
    """Run folders, or folders that contain run folders."""
    out: Path
    """Folder for the report."""
    metric: str = "reward"
    """Column of the results to report."""
    split: str = "validation"
    """Evaluation episodes to report: validation or tuning."""
    lower_is_better: Flag[bool] = False
    """Smaller values of the metric are better, as for collisions."""
    by_run: Flag[bool] = False
    """Report each folder separately, under its name, for runs of different configurations. Each is compared with its
    own unguided agents or, without any, with those of the first folder that has some."""
    overwrite: Flag[bool] = False
    """Replace an existing report."""


OPTIONS = {"report": Report}


def run(arguments: list[str]) -> None:
    """Run the command. Raises UserError for what cannot be reported."""
    # The import loads Matplotlib, which no other command needs.
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
