"""`cuelearner report`."""

from __future__ import annotations

import json
import shlex
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

import tyro

from cuelearner_jax.cli.options import Flag, out, parse, unprefixed
from cuelearner_jax.errors import UserError
from cuelearner_jax.report.document import contents_of, report
from cuelearner_jax.report.efficiency import Question
from cuelearner_jax.storage.table import plain


@dataclass(frozen=True)
class Report:
    """Write curves and tables with intervals from recorded results."""

    folders: tyro.conf.Positional[tuple[Path, ...]]
    """Run folders, or folders that contain run folders."""
    out: Path | None = None
    """Folder for the report."""
    json: Flag[bool] = False
    """Print the tables, with intervals and what is missing, as JSON on standard output in place of a report."""
    guidance: tuple[str, ...] = ()
    """Kinds of guidance to report (default: all)."""
    labels: tuple[int, ...] = ()
    """Label budgets to report, beside agents without labels (default: all)."""
    efficiency: Flag[bool] = False
    """Add label efficiency: steps to a level, and how many labels of one kind equal those of another."""
    question: Annotated[Question, unprefixed] = field(default_factory=Question)
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
    question = options.question if options.efficiency or options.question != Question() else None
    how: dict[str, Any] = {"lower_is_better": options.lower_is_better, "by_run": options.by_run, "question": question}
    how |= {"split": options.split, "guidance": options.guidance, "labels": options.labels}
    if options.out is not None:
        command = shlex.join(["cuelearner", "report", *arguments])
        how |= {"overwrite": options.overwrite, "command": command}
        out.print(f"wrote {report(options.folders, options.out, options.metric, **how)}")
        return
    contents = contents_of(options.folders, options.metric, **how)
    tables = {"metric": options.metric, "split": options.split, "rows": contents.rows, "missing": contents.missing}
    if contents.efficiency:
        tables |= {"level": contents.efficiency.level, **contents.efficiency.tables}
    print(json.dumps(plain(tables), indent=1))
