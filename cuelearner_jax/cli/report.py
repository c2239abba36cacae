"""`cuelearner report`."""

from __future__ import annotations

import json
import shlex
from dataclasses import dataclass
from pathlib import Path

import tyro

from cuelearner_jax.cli.options import Flag, out, parse
from cuelearner_jax.errors import UserError
from cuelearner_jax.report.document import ReportRequest, contents_of, report
from cuelearner_jax.storage.table import plain


@dataclass(frozen=True)
class Report(ReportRequest):
    """Write curves and tables with intervals from recorded results."""

    folders: tyro.conf.Positional[tuple[Path, ...]] = ()
    """Run folders, or folders that contain run folders; of several tasks: with aggregates over tasks."""
    out: Path | None = None
    """Folder for the report."""
    json: bool = False
    """Print the tables, with intervals and what is missing, as JSON on standard output in place of a report."""
    overwrite: bool = False
    """Replace an existing report."""


def run(arguments: list[str]) -> None:
    """Run the command. Raises UserError for what cannot be reported."""
    options = parse(Flag[Report], arguments, "report")
    if not options.folders:
        raise UserError("no folder to report on: cuelearner report RUN_FOLDER ... --out FOLDER")
    if (options.out is None) != options.json:
        raise UserError("report writes a folder or prints JSON: give one of --out FOLDER and --json")
    if options.out is not None:
        command = shlex.join(["cuelearner", "report", *arguments])
        out.print(f"wrote {report(options.folders, options.out, options, options.overwrite, command)}")
        return
    contents = contents_of(options.folders, options)
    tables = {"metric": options.metric, "split": options.split, "rows": contents.rows, "missing": contents.missing}
    if contents.efficiency:
        tables |= {"level": contents.efficiency.level, **contents.efficiency.tables}
    if contents.over:
        tables |= {"ends": contents.over.ends, **contents.over.tables}
    print(json.dumps(plain(tables), indent=1))
