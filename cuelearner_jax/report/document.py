"""Write the folder of `cuelearner report`: figures and tables from recorded results.

A report is a folder. `report.html` is one file: figures with values under the pointer, the table, what is missing, and
the provenance. `report.md` holds the same for other documents. Beside them are `summary.csv` (the table), `curves.csv`
(the curves' values) and `curves.png/.svg`; for several label budgets also `label_efficiency.png/.svg`. A study may add
tables and a section (`experiments/label_efficiency.py`). Equal results always give equal bytes.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import pyarrow as pa
from matplotlib.figure import Figure

from cuelearner_jax.errors import UserError
from cuelearner_jax.report import escaping, extent, tables
from cuelearner_jax.report.figures import draw_curves, draw_label_efficiency, save_figure
from cuelearner_jax.report.page import page
from cuelearner_jax.report.variants import Group, PathLike, Variant, read_groups, variants_of
from cuelearner_jax.storage.folders import in_use

FIGURES = ("curves", "label_efficiency")
UNKNOWN = "not recorded"
PERMISSIVE: dict[str, Any] = {"promote_options": "permissive"}  # runs may differ in their metrics
TABLES = ("summary", "curves", "efficiency", "labels_to_level", "equal_area")


class Study(NamedTuple):
    """A study's additions to a report."""

    lines: Sequence[str]  # of Markdown, below the summary
    tables: dict[str, list[tables.Row]]  # by the name of the file


def report(
    folders: PathLike | Sequence[PathLike],
    out: PathLike,
    metric: str = "reward",
    *,
    split: str = "validation",
    task: str | None = None,
    lower_is_better: bool = False,
    by_run: bool = False,
    study: Callable[[Sequence[Variant]], Study] | None = None,
    overwrite: bool = False,
    command: str = "",
) -> Path:
    """Write the report of any number of runs, finished or not.

    Args:
        folders: run folders, or folders above them.
        out: folder of the report.
        metric: metric column to report.
        split: "validation" or "training".
        task: keeps only this task's runs; needed where there are several tasks.
        lower_is_better: smaller values of the metric are better, for the best value and for reaching a value.
        by_run: reports each folder separately, under its name, as needed where the runs' configurations differ.
        study: called with the variants; returns additions to the report.
        overwrite: replaces an existing report.
        command: command line that makes this report, recorded in it.

    Returns:
        The path of `report.md`.

    Raises:
        UserError: `out` exists, or the results are missing, damaged, of several tasks, without the metric or the split,
            contain a seed twice, or have failed lanes only.
    """
    folders = [folders] if isinstance(folders, str | os.PathLike) else list(folders)
    out = Path(out)
    if in_use(out) and not overwrite:
        raise UserError(
            f"{out} exists already: choose another folder (--out), or allow it to be overwritten (--overwrite)"
        )
    groups = read_groups(folders, task, metric, split, by_run)
    variants = variants_of(groups, metric)
    rows = tables.summary(variants, lower_is_better)
    written = {"summary": rows + tables.of_failed_alone(rows, groups), "curves": tables.curve_rows(variants)}
    title = f"{groups[0].table['task'][0].as_py()}: {split} {metric.replace('_', ' ')}, {_seed_count(variants)}"
    figures = {"curves": draw_curves(variants, title, metric)}
    if len({variant.labels for variant in variants if variant.labels}) > 1:
        figures["label_efficiency"] = draw_label_efficiency(variants, title, metric)
    added = study(variants) if study else Study((), {})
    written |= added.tables
    _write(out, written, figures)
    missing = _missing(folders, groups, variants, metric, split)
    text = _markdown(title, written["summary"], list(figures), added.lines, missing, _provenance(groups, command))
    (out / "report.md").write_text(text, encoding="utf-8")
    whole = page(title, variants, written["summary"], metric, missing, _origins(groups, command))
    (out / "report.html").write_text(whole, encoding="utf-8")
    return out / "report.md"


def _write(out: Path, written: dict[str, list[tables.Row]], figures: dict[str, Figure]) -> None:
    """Write a report's tables and figures; remove those of an earlier report."""
    out.mkdir(parents=True, exist_ok=True)
    figure_files = [f"{name}.{suffix}" for name in FIGURES for suffix in ("png", "svg")]
    for stale in (*figure_files, *(f"{name}.csv" for name in TABLES)):
        (out / stale).unlink(missing_ok=True)
    for name, figure in figures.items():
        save_figure(figure, out / name)
    for name, rows in written.items():
        tables.write_csv(out / f"{name}.csv", rows)


def _seed_count(variants: Sequence[Variant]) -> str:
    counts = sorted({len(variant.seeds) for variant in variants})
    return (
        f"{counts[0]} seed{'s' if counts[0] > 1 else ''}" if len(counts) == 1 else f"{counts[0]} to {counts[-1]} seeds"
    )


def _missing(
    folders: Sequence[PathLike], groups: Sequence[Group], variants: Sequence[Variant], metric: str, split: str
) -> list[str]:
    """Return one line for everything that is missing from the report."""
    failed, gaps, invalid = [], [], 0
    for group in groups:
        own = [variant for variant in variants if variant.run == group.name]
        failed += extent.failed_lanes(group.failed, own)
        gaps += extent.short(group.all_rows, own)
        invalid += group.invalid
    lines = failed + extent.missing(folders, pa.concat_tables([group.all_rows for group in groups], **PERMISSIVE))
    lines += gaps + extent.uneven(variants)
    if invalid:
        lines.append(f"{invalid:,} {split} rows have no finite {metric}; the steps of these rows are left out")
    return lines


def _provenance(groups: Sequence[Group], command: str) -> list[str]:
    """Lines of Markdown."""
    lines = []
    for name, value in _origins(groups, command):
        plain = name in ("versions", "hardware") or value == UNKNOWN
        lines.append(f"{name}: {escaping.markdown(value) if plain else escaping.code(value)}")
    return lines


def _origins(groups: Sequence[Group], command: str) -> list[tuple[str, str]]:
    """Where the numbers come from: what, and its value."""
    table = pa.concat_tables([group.all_rows for group in groups], **PERMISSIVE)
    found = [("report made by", command)] if command else []
    names = {"command": "runs made by", "config_hash": "configuration", "commit": "commit"}
    for column, name in (names | {"versions": "versions", "hardware": "hardware"}).items():
        values = set(table[column].to_pylist()) if column in table.column_names else set()
        known = sorted(value for value in values if value)
        found += [(name, str(value)) for value in known] or [(name, UNKNOWN)]
    return found


def _markdown(
    title: str,
    rows: Sequence[tables.Row],
    figures: Sequence[str],
    added: Sequence[str],
    missing: Sequence[str],
    provenance: Sequence[str],
) -> str:
    lines = [f"# {escaping.markdown(title)}", ""]
    first = [name for name in figures if name in FIGURES[:2]]
    lines += [f"![{name.replace('_', ' ')}]({name}.png)\n" for name in first]
    lines += tables.summary_lines(rows)
    lines += [
        "",
        "Interquartile means over seeds with their 95% percentile bootstrap intervals in brackets; with fewer than 10 "
        "seeds such intervals are too narrow. Steps are environment steps of one seed. Intervals are compared at each "
        "evaluation by itself, so a short stretch may be chance.",
        *added,
    ]
    lines += [
        "",
        "## Missing",
        "",
        *(f"- {escaping.markdown(line)}" for line in missing or ["nothing: all runs are complete"]),
    ]
    lines += ["", "## Where the numbers come from", "", *(f"- {line}" for line in provenance), ""]
    return "\n".join(lines)
