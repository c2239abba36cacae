"""Write the page of `cuelearner suite`: one figure, one table, what was run; CSV tables of each task beside it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from cuelearner_jax.errors import UserError
from cuelearner_jax.report import figures, tables
from cuelearner_jax.report.aggregates import Aggregates, aggregates_of
from cuelearner_jax.report.document import origins
from cuelearner_jax.report.efficiency import Question, efficiency_of
from cuelearner_jax.report.variants import Variant, group_of, guidance_name, rows_of, variants_of
from cuelearner_jax.runs.failures import describe_failed, variant_name

SCORE, LEVEL = "score", 0.8  # the level of label efficiency
NOTE = (
    "Interquartile means over the runs of all tasks with the most labels that all tasks share, with 95% bootstrap "
    "intervals over seeds and episodes. A run's score is its mean over the curve: 0 is that without labels, held "
    "fixed, so `aggregates.csv` tells what is better than none; 1 is success in all episodes (shots), or the return of "
    "the unchanged world. Rewarded steps are of training, or spent on judging corrections, a lane."
)


def variants(table: pa.Table, use: str, teacher: str, right: str) -> list[Variant]:
    """Return the variants of each task under a teacher, beside those of kinds without labels, which meet none."""
    meets = (pc.field("teacher") == teacher) | ((pc.field("teacher") == right) & (pc.field("labels") == 0))
    own = table.filter((pc.field("use") == use) & meets)
    names = sorted(set(own.filter(pc.field("teacher") == teacher)["task"].to_pylist()))
    groups = [group_of("", SCORE, {"task": name}, own.filter(pc.field("task") == name), None) for name in names]
    return [replace(one, task=one.task or names[0]) for one in variants_of(groups, SCORE)]


def write(out: Path, table: pa.Table, right: str, lines: Sequence[str], command: str) -> Path:
    """Write the page and its tables into `out`; return the path of the page. `lines`: what was run, in Markdown."""
    overs: dict[str, Aggregates] = {}
    own: dict[str, list[tables.Row]] = {}
    missing, teachers = _left_out(table), list(dict.fromkeys(table["teacher"].to_pylist()))
    for use in dict.fromkeys(table["use"].to_pylist()):
        faulty: list[Variant] = []
        for teacher in teachers:
            each = variants(table, use, teacher, right)
            about: tables.Row = {"use": use, "teacher": teacher}
            for task in dict.fromkeys(one.task for one in each):
                alone = [one for one in each if one.task == task]
                rows = {"summary": tables.summary(alone)}
                try:
                    rows |= efficiency_of(alone, Question(level=LEVEL)).tables
                except UserError as error:
                    missing.append(f"{use}, {task}, teacher {teacher}: no label efficiency: {error}")
                for name, these in rows.items():
                    own.setdefault(name, []).extend(about | {"task": task} | row for row in these)
            if teacher == right:
                _add(overs, missing, use, each)
            else:
                faulty += [replace(one, task=f"{one.task}, {teacher}", stream=one.task) for one in each]
        _add(overs, missing, f"{use}, faulty teachers", faulty)
    for name, over in overs.items():
        for file, these in over.tables.items():
            own.setdefault(file, []).extend({"part": name} | row for row in these)
    page = ["# The suite", ""]
    if overs:
        figures.save_figure(figures.draw_suite(overs, "The suite: scores over labels, and profiles"), out / "suite")
        page += ["![Scores over labels, and profiles at the most labels](suite.png)", "", *_table(overs, table), ""]
        page += [NOTE, ""]
    page += ["## What was run", "", *lines, *(f"- {tables.markdown(line)}" for line in missing)]
    page += ["", "## Where the numbers come from", "", *origins(table, command), ""]
    for name, rows in own.items():
        tables.write_csv(out / f"{name}.csv", rows)
    (out / "suite.md").write_text("\n".join(page), encoding="utf-8")
    return out / "suite.md"


def _left_out(table: pa.Table) -> list[str]:
    """Return one line for each variant with failed lanes, and for the other rows without a finite score."""
    lines = []
    for key in table.group_by(["use", "task", "teacher"], use_threads=False).aggregate([]).to_pylist():
        group = group_of("", SCORE, {"task": key["task"]}, rows_of(table, key), None)
        own = [f"{variant_name(*one)}: {seeds} failed" for one, seeds in describe_failed(group.failed).items()]
        own += [f"{group.invalid:,} rows have no finite score"] * (group.invalid > 0)
        lines += [f"{key['use']}, {key['task']}, teacher {key['teacher']}: {line}: left out" for line in own]
    return lines


def _add(overs: dict[str, Aggregates], missing: list[str], name: str, each: list[Variant]) -> None:
    """Add the aggregates of variants, or a line that says why there are none."""
    if not each:
        return
    try:
        overs[name] = aggregates_of(each, 1.0, lower_is_better=False)
        missing += [f"{name}: {line}" for line in overs[name].missing]
    except UserError as error:
        missing.append(f"{name}: no aggregates: {str(error).partition(': give')[0]}")


def _table(overs: dict[str, Aggregates], table: pa.Table) -> list[str]:
    """Return the lines of the table: a row for each kind, a column for each part of the suite."""
    cells: dict[str, dict[str, str]] = {}
    for name, over in overs.items():
        for variant, _, numbers in over.each:  # the largest budget comes last
            labels = f" ({variant.labels:,})" if variant.labels else ""
            cells.setdefault(variant.guidance, {})[name] = f"{numbers['interquartile mean']}{labels}"
    for kind, row in cells.items():
        for use in dict.fromkeys(table["use"].to_pylist()):
            own = table.filter((pc.field("guidance") == kind) & (pc.field("use") == use))
            if own.num_rows:
                lanes = own.group_by(["task", "teacher", "labels", "seed"]).aggregate([("rewarded_steps", "max")])
                row[f"rewarded steps, {use}"] = f"{np.mean(lanes['rewarded_steps_max'].to_numpy()):,.0f}"
    header = list(dict.fromkeys(name for row in cells.values() for name in row))
    rows = [
        [tables.markdown(guidance_name(kind)), *(row.get(name, "") for name in header)] for kind, row in cells.items()
    ]
    return tables.markdown_table(["guidance (labels)", *header], rows)
