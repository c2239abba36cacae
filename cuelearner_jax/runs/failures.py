"""Failed lanes of a run: lanes that stopped being finite. They are named, and excluded from every mean."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

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
    lanes = table.group_by(list(results.LANE)).aggregate([]).num_rows
    return f"{len(steps)} of {lanes} lanes failed, no longer finite ({which})" if steps else ""


def without_failed(blocks: Sequence[Any]) -> list[Any]:
    """Drop the failed lanes of blocks (`policy_sources.Block`) and name them on the console."""
    for block in blocks:
        if block.failed.any():
            names = name_lanes(block.seeds[block.failed], block.budgets[block.failed])
            console.print(f"{block.guidance}: {names} failed, no longer finite: left out")
    if not (rest := [block.lanes(~block.failed) for block in blocks if not block.failed.all()]):
        raise UserError("all of these lanes failed: there is nothing to evaluate; train again with other settings")
    return rest


def name_lanes(seeds: np.ndarray, budgets: np.ndarray) -> str:
    """Return the names of lanes (lanes,) of one kind of guidance in a message."""
    pairs = zip(seeds.tolist(), budgets.tolist(), strict=True)
    return _format_seeds([f"{seed} ({budget:,} labels)" if budget else str(seed) for seed, budget in pairs])


def _format_seeds(seeds: Sequence[str]) -> str:
    more = [f"{len(seeds) - LISTED} more"] if len(seeds) > LISTED else []
    return ("seed " if len(seeds) == 1 else "seeds ") + ", ".join([*seeds[:LISTED], *more])
