"""Which lanes of a run have failed: those that stopped being finite. They are named, and counted in no mean."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import pyarrow as pa

from cuelearner_jax.errors import NotFinite
from cuelearner_jax.records import results

LISTED = 8  # lanes of one kind of guidance and budget that a message names


def variant_name(guidance: str, labels: int) -> str:
    """How messages name the lanes of one kind of guidance and budget."""
    return f"{guidance}, {labels:,} labels" if labels else guidance


def told(table: pa.Table) -> dict[tuple[str, int], str]:
    """The failed lanes of a table of results by kind of guidance and budget, in words: seeds, and since when."""
    steps: dict[tuple[str, int], list[str]] = {}
    for (guidance, labels, seed), step in results.failures(table).items():
        steps.setdefault((guidance, labels), []).append(f"{seed} (by step {step:,})")
    return {
        variant: ("seed " if len(seeds) == 1 else "seeds ")
        + ", ".join([*seeds[:LISTED], *([f"{len(seeds) - LISTED} more"] if len(seeds) > LISTED else [])])
        for variant, seeds in steps.items()
    }


def summary(table: pa.Table) -> str:
    """How many lanes of a table of results have failed, and which; nothing where none has."""
    failed = results.failures(table)
    which = "; ".join(f"{variant_name(*variant)}: {seeds}" for variant, seeds in told(table).items())
    return f"{len(failed)} of {results.lanes(table)} lanes failed, no longer finite ({which})" if failed else ""


def check(out: Path, kinds: Iterable[str]) -> None:
    """Raises NotFinite if lanes of a run's kinds of guidance have failed, as its results say."""
    found = summary(results.read([out / kind for kind in kinds]))
    if found:
        raise NotFinite(f"{found}: their rows in {out} are marked, and reports leave them out; all else is done")
