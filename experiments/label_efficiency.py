"""Report on recorded runs, and say how far labels carry: steps to a level, areas under the curve, labels for either.

    python experiments/label_efficiency.py RUN_FOLDER ... --out FOLDER [--by-run] [--level 0.4] [--reference relative]

Writes what `cuelearner report` writes; its report.md has a section more, and there are `efficiency.csv`,
`labels_to_level.csv`, `equal_area.csv`, `labels_to_quality.png/.svg` and `steps_saved.png/.svg` besides.
"""

from __future__ import annotations

import argparse
import shlex
import sys
from collections.abc import Sequence
from pathlib import Path

from _efficiency import Question, efficiency_of
from _efficiency_document import efficiency_figures, efficiency_lines

from cuelearner_jax.errors import UserError
from cuelearner_jax.report.document import Study, report
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


def main(arguments: Sequence[str] | None = None) -> int:
    """Write the report; return the exit status."""
    arguments = sys.argv[1:] if arguments is None else arguments

    def study(variants: Sequence[Variant], title: str) -> Study:
        found = efficiency_of(variants, asked.question, asked.lower_is_better)
        return Study(efficiency_lines(found), found.tables(), efficiency_figures(found, title, asked.metric))

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
