"""`cuelearner report`."""

from __future__ import annotations

import shlex
from dataclasses import dataclass
from pathlib import Path

import tyro

from cuelearner_jax.cli.options import Flag, out, parse
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


def run(arguments: list[str]) -> None:
    """Run the command. Raises UserError for what cannot be reported."""
    # The import loads Matplotlib, which no other command needs.
    from cuelearner_jax.report.document import report

    options = parse(Report, arguments, "report")
    if not options.folders:
        raise UserError("no folder to report on: cuelearner report RUN_FOLDER ... --out FOLDER")
    page = report(
        options.folders,
        options.out,
        options.metric,
        split=options.split,
        lower_is_better=options.lower_is_better,
        by_run=options.by_run,
        overwrite=options.overwrite,
        command=shlex.join(["cuelearner", "report", *arguments]),
    )
    out.print(f"wrote {page}")
