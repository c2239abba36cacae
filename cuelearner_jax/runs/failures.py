"""Failed lanes of a run: lanes that stopped being finite. They are named, and excluded from every mean."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import jax
import numpy as np
import pyarrow as pa

from cuelearner_jax.errors import UserError
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
    return {variant: _format_seeds(seeds) for variant, seeds in steps.items()}


def summary(table: pa.Table) -> str:
    """Return a sentence on the failed lanes of a results table; empty if no lane failed."""
    steps = results.failures(table)
    which = "; ".join(f"{variant_name(*variant)}: {seeds}" for variant, seeds in describe_failed(table).items())
    return f"{len(steps)} of {results.lanes(table)} lanes failed, no longer finite ({which})" if steps else ""


def without_failed(groups: Sequence[Any]) -> list[Any]:
    """Drop the failed lanes of trained lanes (`run_folders.RunLanes`) and name them on the console."""
    rest = []
    for lanes in groups:
        mask = np.asarray(lanes.policies["failed"])
        if mask.any():
            names = name_lanes(lanes.seeds[mask], lanes.budgets[mask])
            console.print(f"{lanes.guidance.name}: {names} failed, no longer finite: left out")
        if not mask.all():
            policies = jax.tree.map(lambda leaf, mask=mask: leaf[~mask], lanes.policies)
            rest.append(replace(lanes, seeds=lanes.seeds[~mask], budgets=lanes.budgets[~mask], policies=policies))
    if not rest:
        raise UserError("all of these lanes failed: there is nothing to evaluate; train again with other settings")
    return rest


def name_lanes(seeds: np.ndarray, budgets: np.ndarray) -> str:
    """Return the names of lanes (lanes,) of one kind of guidance in a message."""
    pairs = zip(seeds.tolist(), budgets.tolist(), strict=True)
    return _format_seeds([f"{seed} ({budget:,} labels)" if budget else str(seed) for seed, budget in pairs])


def _format_seeds(seeds: Sequence[str]) -> str:
    more = [f"{len(seeds) - LISTED} more"] if len(seeds) > LISTED else []
    return ("seed " if len(seeds) == 1 else "seeds ") + ", ".join([*seeds[:LISTED], *more])
