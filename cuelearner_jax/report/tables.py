"""Build a report's tables and write them as CSV and Markdown."""

from __future__ import annotations

import csv
import html
import re
from collections.abc import Iterable, Sequence
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np

from cuelearner_jax.errors import one_line
from cuelearner_jax.report import statistics
from cuelearner_jax.report.statistics import Interval
from cuelearner_jax.report.variants import Variant

Row = dict[str, str | int | float]  # of a table
GAIN = 0.9  # share of the unguided agents' gain over the curve: the level to reach where none is given
COMPARISONS = ("reaches_unguided", "mean_difference", "improvement")
REACHES, DIFFERS, IMPROVES = (tuple(name + end for end in ("", "_lower", "_upper")) for name in COMPARISONS)


def markdown(text: object) -> str:
    """Escape text for a line or a table cell in Markdown, where tags and bars are active."""
    return re.sub(r"([\\`|\[\]])", r"\\\1", html.escape(one_line(str(text)), quote=False))


def code(text: object) -> str:
    """Format text as code in Markdown."""
    return f"`{one_line(str(text)).replace('`', chr(39))}`"


def summary(variants: Sequence[Variant], lower_is_better: bool = False) -> list[Row]:
    """Return one row for each variant, with unrounded numbers; the columns are those of `summary.csv`.

    `reaches_unguided` is the interquartile mean over seeds of the step at which a seed reaches `level_of` the unguided
    agents (`steps_to_level`); "never" if too many seeds end below that for a mean; empty where these gain nothing.
    `mean_difference` is the mean over the curve less the unguided seeds'. `improvement` is the probability that a
    seed's mean over the curve is better than that of an unguided seed. Equal seeds are drawn together. With several
    runs, a variant is compared with the unguided variant of `unguided_of`.
    """
    sign = -1.0 if lower_is_better else 1.0
    rows = []
    for variant in variants:
        unguided = unguided_of(variant, variants)
        steps, estimate, lower, upper = variant.curve
        best = int((sign * estimate).argmax())
        row: Row = {**identity(variant), "seeds": len(variant.seeds), "failed": len(variant.failed)}
        row |= {"episodes": variant.episodes or "not known"}
        row |= {"last_step": steps[-1], "final": estimate[-1], "final_lower": lower[-1], "final_upper": upper[-1]}
        row |= dict(zip(("mean", "mean_lower", "mean_upper"), map(float, variant.mean), strict=True))
        row |= {"best_step": steps[best], "best": estimate[best]}
        row |= dict.fromkeys((*REACHES, *DIFFERS, *IMPROVES), "")
        if unguided is not None and sign * (level_of(unguided) - unguided.curve.estimate[0]) > 0:
            row |= _steps_to(variant, sign, sign * level_of(unguided))
        if unguided is not None and variant is not unguided:
            row |= _against(variant, unguided, sign)
        rows.append({name: value.item() if isinstance(value, np.generic) else value for name, value in row.items()})
    return rows


def level_of(unguided: Variant) -> float:
    """Return the value at `GAIN` of what the unguided agents gain from their first evaluation to their last."""
    first, last = unguided.curve.estimate[[0, -1]].tolist()
    return first + GAIN * (last - first)


def _against(variant: Variant, unguided: Variant, sign: float) -> Row:
    """Return the columns that compare a variant with the unguided one, without intervals for a single seed."""
    pair = variant, unguided
    areas = [each.samples(each.area, lambda values, axis: values) for each in pair]
    less = np.subtract(*(statistics.interquartile_mean(each, axis=1) for each in areas))
    row: Row = {}
    for names, of in ((DIFFERS, less), (IMPROVES, statistics.improvement(*(sign * each for each in areas)))):
        ends = np.quantile(of[1:], [0.025, 0.975]) if min(len(each.seeds) for each in pair) > 1 else ()
        row |= dict(zip(names, (of[0], *ends), strict=False))
    return row


def _steps_to(variant: Variant, sign: float, level: float) -> Row:
    """Return the columns of the step at which a variant's seeds reach a level; an interval for several seeds."""
    own, *draws = variant.samples(lambda curves: statistics.steps_to_level(variant.curve.steps, sign * curves, level))
    numbers = (own[1], *(statistics.censored_interval(np.array(draws)) if len(variant.seeds) > 1 else ()))
    return dict(zip(REACHES, (round(float(step)) if np.isfinite(step) else "never" for step in numbers), strict=False))


def unguided_of(variant: Variant, variants: Sequence[Variant]) -> Variant | None:
    """Return the unguided variant to compare with: that of the variant's own run, or else the task's first one."""
    unguided = [other for other in variants if other.guidance == "none" and other.task == variant.task]
    return next((other for other in unguided if other.run == variant.run), unguided[0] if unguided else None)


def identity(variant: Variant) -> Row:
    """Return the columns that identify a variant; `task` and `run` are among them where there are several."""
    own = {"task": variant.task, "run": variant.run, "guidance": variant.guidance, "labels": variant.labels}
    return {name: value for name, value in own.items() if value != ""}


def curve_rows(variants: Sequence[Variant]) -> list[Row]:
    """Return one row for each variant and evaluation: the values of the curves."""
    return [
        {**identity(variant), "seeds": len(variant.seeds), "step": int(step)}
        | {"iqm": float(estimate), "lower": float(lower), "upper": float(upper)}
        for variant in variants
        for step, estimate, lower, upper in zip(*variant.curve, strict=True)
    ]


def write_csv(path: Path, rows: Sequence[Row]) -> None:
    """Write a CSV table with the columns of all rows; a row without a column leaves it empty."""
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, list(dict.fromkeys(chain(*rows))), lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)


def markdown_table(header: Sequence[str], rows: Iterable[Sequence[object]]) -> list[str]:
    """Return the lines of a Markdown table; cells are Markdown already."""
    head, *body = (f"| {' | '.join(map(format, row))} |" for row in (header, *rows))
    return [head, "|" + "---|" * len(header), *body]


def summary_lines(rows: Sequence[Row]) -> list[str]:
    """Return the summary as a table in Markdown."""
    header = [name for name in ("task", "run") if name in rows[0]]
    header += ["guidance", "labels", "seeds", "episodes", "last step", "final", "mean over the curve", "best (at step)"]
    header += [f"{GAIN:.0%} of the unguided gain at step", "mean less the unguided's", "probability of improvement"]
    return markdown_table(header, [_summary_cells(row) for row in rows])


def _step(value: str | float) -> str:
    return value if isinstance(value, str) else f"{value:,.0f}"


def _summary_cells(row: Row) -> list[object]:
    reached, *ends = (_step(row[name]) for name in REACHES)
    failed = int(row["failed"])
    seeds = f"{row['seeds']} of {int(row['seeds']) + failed}, {failed} failed" if failed else row["seeds"]
    cells: list[object] = [markdown(row[name]) for name in ("task", "run", "guidance") if name in row]
    cells += [f"{row['labels']:,}", seeds, _step(row["episodes"]), f"{row['last_step']:,}"]
    cells += [Interval(*(row[key + end] for end in ("", "_lower", "_upper"))) for key in ("final", "mean")]  # pyright: ignore[reportArgumentType]
    cells += [f"{row['best']:.3f} ({row['best_step']:,})", f"{reached} [{', '.join(ends)}]" if any(ends) else reached]
    for names, sign in ((DIFFERS, "+"), (IMPROVES, "")):
        of: list[Any] = [np.nan if row[name] == "" else row[name] for name in names]
        cells.append("" if np.isnan(of[0]) else format(Interval(*of), sign))
    return cells
