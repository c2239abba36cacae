"""Failed lanes of a run: lanes that stopped being finite. They are named, and excluded from every mean."""

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

LISTED = 8  # most lanes that a message names per kind of guidance and budget


def variant_name(guidance: str, labels: int) -> str:
    """Return the name of a kind of guidance and budget in messages."""
    return f"{guidance}, {labels:,} labels" if labels else guidance


def describe_failed(table: pa.Table) -> dict[tuple[str, int], str]:
    """Describe failed lanes by kind of guidance and budget: seeds, and the step by which each failed."""
    steps: dict[tuple[str, int], list[str]] = {}
    for (guidance, labels, seed), step in results.failures(table).items():
        steps.setdefault((guidance, labels), []).append(f"{seed} (by step {step:,})")
    return {variant: _listed(seeds) for variant, seeds in steps.items()}


def summary(table: pa.Table) -> str:
    """Return a sentence on the failed lanes of a results table; empty if no lane failed."""
    failed = results.failures(table)
    which = "; ".join(f"{variant_name(*variant)}: {seeds}" for variant, seeds in describe_failed(table).items())
    return f"{len(failed)} of {results.lanes(table)} lanes failed, no longer finite ({which})" if failed else ""


def without_failed(loaded: Sequence[Any]) -> list[Any]:
    """Drop the failed lanes of trained lanes (`run_folders.RunLanes`) and name them on the console.

    Raises UserError if no lane is left.
    """
    left = []
    for lanes in loaded:
        failed = np.asarray(lanes.policies["failed"])
        if failed.any():
            names = named(lanes.seeds[failed], lanes.budgets[failed])
            console.print(f"{lanes.guidance.name}: {names} failed, no longer finite: left out")
        if not failed.all():
            left.append(select(lanes, ~failed))
    if not left:
        raise UserError("all of these lanes failed: there is nothing to evaluate; train again with other settings")
    return left


def select(lanes: Any, mask: np.ndarray) -> Any:
    """Return the lanes (`run_folders.RunLanes`) of a mask (lanes,)."""
    policies = jax.tree.map(lambda leaf: leaf[mask], lanes.policies)
    return replace(lanes, seeds=lanes.seeds[mask], budgets=lanes.budgets[mask], policies=policies)


def named(seeds: np.ndarray, budgets: np.ndarray) -> str:
    """Return the names of lanes (lanes,) of one kind of guidance in a message."""
    pairs = zip(seeds.tolist(), budgets.tolist(), strict=True)
    return _listed([f"{seed} ({budget:,} labels)" if budget else str(seed) for seed, budget in pairs])


def _listed(seeds: Sequence[str]) -> str:
    more = [f"{len(seeds) - LISTED} more"] if len(seeds) > LISTED else []
    return ("seed " if len(seeds) == 1 else "seeds ") + ", ".join([*seeds[:LISTED], *more])


def check(out: Path, folders: Iterable[Path]) -> None:
    """Raise NotFinite if the results in these folders of a run at `out` contain failed lanes."""
    found = summary(results.read(list(folders)))
    if found:
        raise NotFinite(
            f"{found}: their rows in {out} are marked and excluded from reports; everything else is finished"
        )
