"""`cuelearner report`."""

from __future__ import annotations

import json
import shlex
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import tyro

from cuelearner_jax.cli.options import Flag, out, parse
from cuelearner_jax.errors import UserError
from cuelearner_jax.report import tables
from cuelearner_jax.report.variants import read_groups, variants_of
from cuelearner_jax.storage.table import plain


@dataclass(frozen=True)
class Report:
    """Write curves and tables with intervals from recorded results."""

    folders: tyro.conf.Positional[tuple[Path, ...]]
    """Run folders, or folders that contain run folders."""
    out: Path | None = None
    """Folder for the report."""
    json: Flag[bool] = False
    """Print the table of final values and means, with intervals, as JSON on standard output in place of a report."""
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
    options = parse(Report, arguments, "report")
    if not options.folders:
        raise UserError("no folder to report on: cuelearner report RUN_FOLDER ... --out FOLDER")
    if (options.out is None) != options.json:
        raise UserError("report writes a folder or prints JSON: give one of --out FOLDER and --json")
    read: dict[str, Any] = {"metric": options.metric, "split": options.split, "by_run": options.by_run}
    if options.out is None:
        variants = variants_of(read_groups(options.folders, **read), options.metric)
        table = tables.summary(variants, options.lower_is_better)
        rows = [{name: plain(value) for name, value in row.items()} for row in table]
        print(json.dumps({"metric": options.metric, "split": options.split, "rows": rows}, indent=1))
        return
    # The import loads Matplotlib, which no other command needs.
    from cuelearner_jax.report.document import report

    how: dict[str, Any] = {"lower_is_better": options.lower_is_better, "overwrite": options.overwrite}
    command = shlex.join(["cuelearner", "report", *arguments])
    page = report(options.folders, options.out, **read, **how, command=command)
    out.print(f"wrote {page}")
