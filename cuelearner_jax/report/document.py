"""Write the folder of `cuelearner report`: figures and tables of recorded results. Equal results give equal bytes.

`report.md` has the figures, the tables, what is missing, and the provenance. Beside it are `summary.csv`, `curves.csv`,
the figures, and the tables of a question about label efficiency, or of several tasks.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import pyarrow as pa

from cuelearner_jax.errors import UserError
from cuelearner_jax.report import aggregates, extent, tables
from cuelearner_jax.report.efficiency import Efficiency, Question, efficiency_of, section
from cuelearner_jax.report.tables import code, markdown
from cuelearner_jax.report.variants import Group, PathLike, Variant, read_groups, variants_of
from cuelearner_jax.storage.folders import in_use

FILES = [f"{name}.{suffix}" for name in ("curves", "label_efficiency", "profiles") for suffix in ("png", "svg")]
FILES += [f"{name}.csv" for name in ("summary", "curves", "efficiency", "equal_area", "aggregates", "profiles")]
ORIGINS = {"command": "runs made by", "config_hash": "configuration", "commit": "commit"}
ORIGINS |= {"versions": "versions", "hardware": "hardware"}
NOTE = (
    "Interquartile means over seeds with their 95% percentile bootstrap intervals in brackets, over seeds and the "
    "evaluation's episodes; with few seeds such intervals are too narrow: with 5 they hold the truth in about 90 of "
    "100 studies, with 3 in 75, with 2 in 50. [no spread]: all draws are equal, which does not make the value certain; "
    "evaluate more episodes. Steps are environment steps of one seed. Means over the curve are compared with those of "
    "the unguided agents, equal seeds drawn together; the probability of improvement is that of a seed against an "
    "unguided seed."
)


@dataclass(frozen=True, kw_only=True)
class ReportRequest(Question):
    """Options of a report's contents."""

    guidance: tuple[str, ...] = ()
    """Kinds of guidance to report (default: all)."""
    labels: tuple[int, ...] = ()
    """Label budgets to report, beside agents without labels (default: all)."""
    metric: str = "reward"
    """Column of the results to report."""
    split: str = "validation"
    """Evaluation episodes to report: validation or tuning."""
    lower_is_better: bool = False
    """Smaller values of the metric are better, also where the runs' task does not say so (unless it names its own, of
    collision, cost, distance, error, foul and timeout)."""
    by_run: bool = False
    """Report each folder separately, under its name, for runs of different configurations. Each is compared with its
    own unguided agents or, without any, with those of the first folder that has some."""
    efficiency: bool = False
    """Add label efficiency: steps to a level, and how many labels of one kind equal those of another."""

    @property
    def asks(self) -> bool:
        """Whether label efficiency is asked for: by `efficiency`, or by an option of the question."""
        return self.efficiency or (self.level, self.level_at, self.reference) != (None, None, None)


ALL = ReportRequest()


class Contents(NamedTuple):
    """Contents of a report."""

    groups: list[Group]
    variants: list[Variant]
    rows: list[tables.Row]  # the summary
    missing: list[str]  # a line for each thing that was planned and has no results, or that the figures leave out
    efficiency: Efficiency | None
    every: pa.Table  # all recorded rows of the split
    over: aggregates.Aggregates | None  # several tasks


def contents_of(folders: Sequence[PathLike], request: ReportRequest = ALL) -> Contents:
    """Read the results of run folders, or of folders above them, and compute what a report shows."""
    metric, split = request.metric, request.split
    groups = read_groups(folders, metric, split, request.by_run, guidance=request.guidance, labels=request.labels)
    every = pa.concat_tables([group.every for group in groups], promote_options="permissive")  # of other metrics
    plans = extent.plans_of(folders, every)
    lower_is_better = request.lower_is_better or metric in extent.less_is_better(plans)
    variants = variants_of(groups, metric)
    over = answer = None
    if len({variant.task for variant in variants}) > 1:
        if (request if request.by_run else replace(request, level=None)).asks:
            raise UserError("label efficiency is of one task: report each task by itself, or give --level alone")
        over = None if request.by_run else aggregates.aggregates_of(variants, request.level, lower_is_better)
    elif request.asks:
        answer = efficiency_of(variants, request, lower_is_better)
    missing = extent.missing(plans, every, split) + extent.gaps(groups, variants, metric, split)
    missing += over.missing if over else []
    return Contents(groups, variants, tables.summary(variants, lower_is_better), missing, answer, every, over)


def report(
    folders: Sequence[PathLike], out: Path, request: ReportRequest = ALL, overwrite: bool = False, command: str = ""
) -> Path:
    """Write the report of run folders, or of folders above them, into `out`; return the path of `report.md`.

    `command` is the command line to record in the report.
    """
    from cuelearner_jax.report import figures as drawing  # loads Matplotlib

    if in_use(out) and not overwrite:
        raise UserError(f"{out} exists already: give another --out, or --overwrite to replace it")
    contents, metric = contents_of(folders, request), request.metric
    variants, efficiency, over = contents.variants, contents.efficiency, contents.over
    seeds = _range("seed", [len(variant.seeds) for variant in variants])
    if episodes := [variant.episodes for variant in variants if variant.episodes]:
        seeds += f" x {_range('episode', episodes)}"
    tasks = ", ".join(dict.fromkeys(group.task for group in contents.groups))
    title = f"{tasks}: {request.split} {metric.replace('_', ' ')}, {seeds}"
    figures = {"curves": drawing.draw_curves(variants, title, metric)}
    alone = len({(variant.task, variant.run) for variant in variants}) == 1
    if alone and len({variant.labels for variant in variants if variant.labels}) > 1:
        figures["label_efficiency"] = drawing.draw_label_efficiency(variants, title, metric)
    if over:
        figures["profiles"] = drawing.draw_profiles(over)
    lines = [f"# {markdown(title)}", "", *(f"![{name.replace('_', ' ')}]({name}.png)\n" for name in figures)]
    lines += [*tables.summary_lines(contents.rows), "", NOTE, *(section(efficiency) if efficiency else [])]
    lines += aggregates.section(over, request.level) if over else []
    missing = contents.missing or ["nothing: all runs that have begun are complete"]
    lines += ["", "## Missing", "", *(f"- {markdown(line)}" for line in missing)]
    lines += ["", "## Where the numbers come from", "", *origins(contents.every, command), ""]
    out.mkdir(parents=True, exist_ok=True)
    for name in FILES:  # also those of an earlier report
        (out / name).unlink(missing_ok=True)
    for name, figure in figures.items():
        drawing.save_figure(figure, out / name)
    own = {"summary": contents.rows, "curves": tables.curve_rows(variants)}
    own |= (efficiency.tables if efficiency else {}) | (over.tables if over else {})
    for name, each in own.items():
        tables.write_csv(out / f"{name}.csv", each)
    (out / "report.md").write_text("\n".join(lines), encoding="utf-8")
    return out / "report.md"


def _range(name: str, counts: Sequence[int]) -> str:
    """Return the least and the largest number of things of a name in words."""
    least, most = min(counts), max(counts)
    return f"{least:,}{f' to {most:,}' if most > least else ''} {name}{'s' * (most > 1)}"


def origins(table: pa.Table, command: str) -> list[str]:
    """Return lines about where the numbers come from."""
    lines = [("report made by", command)] if command else []
    for column, name in ORIGINS.items():
        values = set(table[column].to_pylist()) if column in table.column_names else set()
        lines += [(name, value) for value in sorted(filter(None, values))] or [(name, "not recorded")]
    return [f"- {name}: {code(value)}" for name, value in lines]
