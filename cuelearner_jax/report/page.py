"""The report as one page of HTML: figures whose values and intervals appear under the pointer, and the table.

The page needs no network and no other file. Names in the results are text in it, whatever they hold.
"""

from __future__ import annotations

import html
import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from matplotlib.colors import to_hex

from cuelearner_jax.errors import one_line
from cuelearner_jax.report.figures import axis_name, colour_of, colours_of
from cuelearner_jax.report.tables import Row, summary_table
from cuelearner_jax.report.variants import Variant, guidance_name

TEMPLATE = Path(__file__).with_name("page.html")
DIGITS = 6  # of a value


def page(
    title: str,
    variants: Sequence[Variant],
    rows: Sequence[Row],
    metric: str,
    missing: Sequence[str],
    provenance: Sequence[tuple[str, str]],
) -> str:
    """Return the page.

    Args:
        title: title of the report.
        variants: the curves of the figures.
        rows: the rows of the summary.
        metric: the reported column.
        missing: one line for each part of the runs that has no results.
        provenance: name and value of each entry of the provenance.
    """
    figures = [_curves(variants, metric)]
    if len({variant.labels for variant in variants if variant.labels}) > 1:
        figures.append(_budgets(variants, metric))
    header, cells = summary_table(rows)
    parts = {
        "title": _text(title),
        "table": _table(header, cells),
        "missing": _list([_text(line) for line in missing or ["nothing: all runs are complete"]]),
        "provenance": _list([f"{_text(name)}: <code>{_text(value)}</code>" for name, value in provenance]),
        # No tag can begin in the data.
        "data": json.dumps(figures).replace("<", "\\u003c"),
    }
    text = TEMPLATE.read_text(encoding="utf-8")
    head, *rest = text.split("{{")
    return head + "".join(parts[name] + after for name, _, after in (part.partition("}}") for part in rest))


def _text(value: object) -> str:
    return html.escape(one_line(str(value)))


def _list(items: Sequence[str]) -> str:
    return f"<ul>{''.join(f'<li>{item}</li>' for item in items)}</ul>"


def _table(header: Sequence[str], rows: Sequence[Sequence[object]]) -> str:
    head = "".join(f"<th>{_text(name)}</th>" for name in header)
    body = "".join(
        f"<tr>{''.join(f'<td>{_text(cell)}</td>' for cell in row)}{'<td></td>' * (len(header) - len(row))}</tr>"
        for row in rows
    )
    return f"<table><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table>"


def _curves(variants: Sequence[Variant], metric: str) -> dict[str, Any]:
    """Learning curves as data of a figure."""
    series = [
        {
            "name": variant.name,
            "colour": to_hex(colour),
            "points": [_point(*at) for at in zip(*variant.curve, strict=True)],
        }
        for variant, colour in zip(variants, colours_of(variants), strict=True)
    ]
    axes = {"x": "environment steps of a seed", "unit": "steps", "y": axis_name(metric)}
    return {"title": "Learning curves", "log": False, **axes, "series": series}


def _budgets(variants: Sequence[Variant], metric: str) -> dict[str, Any]:
    """Means over the curve against the label budget, as data of a figure; a kind without labels is a level."""
    budgets = sorted({variant.labels for variant in variants if variant.labels})
    series = []
    for kind in dict.fromkeys((variant.run, variant.guidance) for variant in variants):
        own = [variant for variant in variants if (variant.run, variant.guidance) == kind]
        name = f"{kind[0]}: {guidance_name(kind[1])}" if kind[0] else guidance_name(kind[1])
        level = not any(variant.labels for variant in own)
        pairs = [(budget, own[0]) for budget in budgets] if level else [(one.labels, one) for one in own if one.labels]
        points = [_point(budget, *one.mean) for budget, one in pairs]
        series.append({"name": one_line(name), "colour": to_hex(colour_of(kind[1])), "level": level, "points": points})
    axes = {"x": "labels", "unit": "labels", "y": axis_name(metric)}
    return {"title": "What labels buy: mean over the curve", "log": True, **axes, "series": series}


def _point(x: Any, estimate: Any, lower: Any, upper: Any) -> dict[str, Any]:
    values = {"y": estimate, "lower": lower, "upper": upper}
    return {"x": int(x)} | {name: _number(value) for name, value in values.items()}


def _number(value: Any) -> float | None:
    return float(f"{float(value):.{DIGITS}g}") if math.isfinite(value) else None
