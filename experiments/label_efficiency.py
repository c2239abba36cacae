"""Report on recorded runs, and say how far labels carry: steps to a level, areas under the curve, labels for either.

    python experiments/label_efficiency.py RUN_FOLDER ... --out FOLDER [--by-run] [--level 0.4] [--reference relative]

Writes what `cuelearner report` writes; its report.md has a section more, and there are `efficiency.csv`,
`labels_to_level.csv` and `equal_area.csv` besides.
"""

from __future__ import annotations

import argparse
import shlex
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from _efficiency import Efficiency, Question, efficiency_of

from cuelearner_jax.errors import UserError
from cuelearner_jax.report.document import Study, report
from cuelearner_jax.report.tables import markdown, markdown_table
from cuelearner_jax.report.variants import Variant


def parsed(arguments: Sequence[str]) -> argparse.Namespace:
    """The arguments; its `question` is what is asked of label budgets. Raises UserError for what cannot be asked."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folders", type=Path, nargs="+", help="run folders, or folders above them")
    parser.add_argument("--out", type=Path, required=True, help="folder for the report")
    parser.add_argument("--metric", default="reward", help="column of the results")
    parser.add_argument("--lower-is-better", action="store_true", help="as of collisions")
    parser.add_argument("--by-run", action="store_true", help="tell the folders apart by their names")
    parser.add_argument("--level", type=float, help="value of the metric to be reached")
    parser.add_argument("--level-at", type=int, help="instead: what unguided agents have at this step (default: last)")
    parser.add_argument("--within", type=float, default=2 / 3, help="share of the unguided agents' steps")
    parser.add_argument("--reference", help="kind whose labels those of others are compared with (default: each)")
    parser.add_argument("--overwrite", action="store_true", help="replace an earlier report")
    asked = parser.parse_args(arguments)
    asked.question = Question(asked.level, asked.level_at, asked.within, asked.reference)
    return asked


def cell(row: dict[str, Any], name: str, form: str) -> str:
    """Return a quantity with its interval: `0.62 [0.54, 0.71]`, `above 1.40 [1.30, no bound]`, or nothing."""
    value, low, high = row[name], row.get(f"{name}_above", ""), row.get(f"{name}_below", "")
    if value == "" == low:
        return ""
    if value != "":
        text = form.format(value)
    elif np.isinf(high):
        text = f"above {form.format(low)}" if low > 0 else "not known"
    else:
        text = f"below {form.format(high)}" if low <= 0 else f"{form.format(low)} to {form.format(high)}"
    lower, upper = row[f"{name}_lower"], row[f"{name}_upper"]
    if lower == "":
        return text
    return f"{text} [{form.format(lower)}, {form.format(upper) if np.isfinite(upper) else 'no bound'}]"


def section(found: Efficiency) -> list[str]:
    """Return the section of the report: a row for each variant."""
    level = f"The level is {found.level:.3f}: {markdown(found.origin)}."
    header = ["run", "guidance", "labels", "guide alone", "steps to the level", "ratio to unguided"]
    header += [f"mean over the curve to {found.shared:,}", "ratio to unguided"]
    forms = {"guide": "{:.3f}", "steps_to_level": "{:,.0f}", "steps_ratio": "{:.2f}", "mean": "{:.3f}"}
    forms["mean_ratio"] = "{:.2f}"
    lines = []
    for row in found.tables["efficiency"]:
        names = [markdown(row.get("run", "")), markdown(row["guidance"]), f"{row['labels']:,}"]
        lines.append([*names, *(cell(row, name, form) for name, form in forms.items())])
    return ["", "## Label efficiency", "", level, "", *markdown_table(header, lines)]


def main(arguments: Sequence[str] | None = None) -> int:
    """Write the report; return the exit status."""
    arguments = sys.argv[1:] if arguments is None else arguments

    def study(variants: Sequence[Variant]) -> Study:
        found = efficiency_of(variants, asked.question, asked.lower_is_better)
        return Study(section(found), found.tables)

    try:
        asked = parsed(arguments)
        written = report(
            asked.folders,
            asked.out,
            asked.metric,
            lower_is_better=asked.lower_is_better,
            by_run=asked.by_run,
            study=study,
            overwrite=asked.overwrite,
            command=shlex.join(["python", "experiments/label_efficiency.py", *arguments]),
        )
    except UserError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    print(f"wrote {written}")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
