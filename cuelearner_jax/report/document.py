"""Write the folder of `cuelearner report`: figures and tables of recorded results. Equal results give equal bytes.

`report.md` has the figures, the table, what is missing, and the provenance. Beside it are `summary.csv`, `curves.csv`
and the figures. A study may add tables and a section (`experiments/label_efficiency.py`).
"""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import pyarrow as pa

from cuelearner_jax.errors import UserError
from cuelearner_jax.report import extent, tables
from cuelearner_jax.report.figures import draw_curves, draw_label_efficiency, save_figure
from cuelearner_jax.report.tables import code, markdown
from cuelearner_jax.report.variants import PathLike, Variant, read_groups, variants_of
from cuelearner_jax.storage.folders import in_use

FIGURES = ("curves", "label_efficiency")
PERMISSIVE: dict[str, Any] = {"promote_options": "permissive"}  # runs may differ in their metrics
TABLES = ("summary", "curves", "efficiency", "labels_to_level", "equal_area")
ORIGINS = {"command": "runs made by", "config_hash": "configuration", "commit": "commit"}
ORIGINS |= {"versions": "versions", "hardware": "hardware"}
NOTE = (
    "Interquartile means over seeds with their 95% percentile bootstrap intervals in brackets, over seeds and the "
    "evaluation's episodes; with fewer than 10 seeds such intervals are too narrow. [no spread]: all draws are equal, "
    "which does not make the value certain; evaluate more episodes. Steps are environment steps of one seed. Intervals "
    "are compared at each evaluation by itself, so a short stretch may be chance."
)


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
    lower_is_better: bool = False,
    by_run: bool = False,
    study: Callable[[Sequence[Variant]], Study] | None = None,
    overwrite: bool = False,
    command: str = "",
) -> Path:
    """Write the report of run folders, or of folders above them, into `out`; return the path of `report.md`.

    `folders` are run folders, or folders above them; `by_run` reports each under its own name, as needed where the
    runs' configurations differ. `split`: "validation" or "training". `study` makes additions of the variants. `command`
    is the command line to record in the report.
    """
    folders = [folders] if isinstance(folders, str | os.PathLike) else list(folders)
    out = Path(out)
    if in_use(out) and not overwrite:
        raise UserError(f"{out} exists already: give another --out, or --overwrite to replace it")
    groups = read_groups(folders, metric, split, by_run)
    variants = variants_of(groups, metric)
    rows = tables.summary(variants, lower_is_better)
    seeds = _range("seed", [len(variant.seeds) for variant in variants])
    if episodes := [variant.episodes for variant in variants if variant.episodes]:
        seeds += f" x {_range('episode', episodes)}"
    title = f"{groups[0].table['task'][0].as_py()}: {split} {metric.replace('_', ' ')}, {seeds}"
    figures = {"curves": draw_curves(variants, title, metric)}
    if len({variant.labels for variant in variants if variant.labels}) > 1:
        figures["label_efficiency"] = draw_label_efficiency(variants, title, metric)
    added = study(variants) if study else Study((), {})
    every = pa.concat_tables([group.all_rows for group in groups], **PERMISSIVE)
    missing = extent.missing(folders, every) + extent.gaps(groups, variants, metric, split)
    lines = [f"# {markdown(title)}", "", *(f"![{name.replace('_', ' ')}]({name}.png)\n" for name in figures)]
    lines += [*tables.summary_lines(rows), "", NOTE, *added.lines]
    lines += ["", "## Missing", "", *(f"- {markdown(line)}" for line in missing or ["nothing: all runs are complete"])]
    lines += ["", "## Where the numbers come from", "", *_origins(every, command), ""]
    out.mkdir(parents=True, exist_ok=True)
    figure_files = [f"{name}.{suffix}" for name in FIGURES for suffix in ("png", "svg")]
    for stale in (*figure_files, *(f"{name}.csv" for name in TABLES)):
        (out / stale).unlink(missing_ok=True)
    for name, figure in figures.items():
        save_figure(figure, out / name)
    for name, each in ({"summary": rows, "curves": tables.curve_rows(variants)} | added.tables).items():
        tables.write_csv(out / f"{name}.csv", each)
    (out / "report.md").write_text("\n".join(lines), encoding="utf-8")
    return out / "report.md"


def _range(name: str, counts: Sequence[int]) -> str:
    """Return the least and the largest number of things of a name in words."""
    least, most = min(counts), max(counts)
    return f"{least:,}{f' to {most:,}' if most > least else ''} {name}{'s' * (most > 1)}"


def _origins(table: pa.Table, command: str) -> list[str]:
    """Return lines about where the numbers come from."""
    origins = [("report made by", command)] if command else []
    for column, name in ORIGINS.items():
        values = set(table[column].to_pylist()) if column in table.column_names else set()
        origins += [(name, value) for value in sorted(filter(None, values))] or [(name, "not recorded")]
    return [f"- {name}: {code(value)}" for name, value in origins]
