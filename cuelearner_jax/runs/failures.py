"""Which lanes of a run have failed: those that stopped being finite. They are named, and counted in no mean."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pyarrow as pa

from cuelearner_jax.errors import NotFinite, UserError
from cuelearner_jax.storage import results
from cuelearner_jax.terminal import console

LISTED = 8  # lanes of one kind of guidance and budget that a message names


def variant_name(guidance: str, labels: int) -> str:
    """How messages name the lanes of one kind of guidance and budget."""
    return f"{guidance}, {labels:,} labels" if labels else guidance


def told(table: pa.Table) -> dict[tuple[str, int], str]:
    """The failed lanes of a table of results by kind of guidance and budget, in words: seeds, and since when."""
    steps: dict[tuple[str, int], list[str]] = {}
    for (guidance, labels, seed), step in results.failures(table).items():
        steps.setdefault((guidance, labels), []).append(f"{seed} (by step {step:,})")
    return {variant: _listed(seeds) for variant, seeds in steps.items()}


def summary(table: pa.Table) -> str:
    """How many lanes of a table of results have failed, and which; nothing where none has."""
    failed = results.failures(table)
    which = "; ".join(f"{variant_name(*variant)}: {seeds}" for variant, seeds in told(table).items())
    return f"{len(failed)} of {results.lanes(table)} lanes failed, no longer finite ({which})" if failed else ""


def without_failed(loaded: Sequence[Any]) -> list[Any]:
    """Trained lanes (`trained.Lanes`) less those that have failed, which are named on the console.

    Raises UserError if none is left.
    """
    left = []
    for lanes in loaded:
        failed = np.asarray(lanes.policies["failed"])
        pairs = sorted(zip(lanes.budgets[failed].tolist(), lanes.seeds[failed].tolist(), strict=True))
        for budget in sorted({budget for budget, _ in pairs}):
            seeds = [str(seed) for own, seed in pairs if own == budget]
            name = variant_name(lanes.guidance.name, budget)
            console.print(f"{name}: {_listed(seeds)} failed, no longer finite, and left out")
        if not failed.all():
            kept = jax.tree.map(lambda leaf, failed=failed: leaf[~failed], lanes.policies)
            left.append(replace(lanes, seeds=lanes.seeds[~failed], budgets=lanes.budgets[~failed], policies=kept))
    if not left:
        raise UserError("all of these lanes failed: there is nothing to evaluate; train again with other settings")
    return left


def _listed(seeds: Sequence[str]) -> str:
    more = [f"{len(seeds) - LISTED} more"] if len(seeds) > LISTED else []
    return ("seed " if len(seeds) == 1 else "seeds ") + ", ".join([*seeds[:LISTED], *more])


def check(out: Path, folders: Iterable[Path]) -> None:
    """Raises NotFinite if lanes of a run at `out` have failed, as the results in these folders of it say."""
    found = summary(results.read(list(folders)))
    if found:
        raise NotFinite(f"{found}: their rows in {out} are marked, and reports leave them out; all else is done")
