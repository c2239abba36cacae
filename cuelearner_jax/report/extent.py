"""Compare what the runs' config.json planned with what their results contain; list what a report lacks."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pyarrow as pa

from cuelearner_jax.errors import UserError
from cuelearner_jax.report.variants import Variant
from cuelearner_jax.runs import failures, shards
from cuelearner_jax.storage import formats, results
from cuelearner_jax.storage.folders import CONFIG

LISTED = 20  # most numbers in one line


class Planned(NamedTuple):
    """The planned extent of a run from its config.json; None or empty where the file does not say."""

    total_steps: int | None
    guidance: tuple[str, ...]
    seeds: tuple[int, ...]
    labels: tuple[int, ...]

    @classmethod
    def of(cls, file: Path) -> Planned:
        """Read the plan from a config.json. Raises UserError if the file cannot be read or is invalid."""
        values = formats.read("config", file)
        grid = values.get("grid", {})
        return cls(values.get("total_steps"), *(tuple(grid.get(name, ())) for name in ("guidance", "seeds", "labels")))


def missing(folders: Sequence[str | os.PathLike[str]], table: pa.Table) -> list[str]:
    """Return one line for everything planned that the table lacks, or whose plan is unknown."""
    configurations = {folder: _configuration(Path(folder)) for folder in dict.fromkeys(table["folder"].to_pylist())}
    files = {file for folder in folders for file in Path(folder).rglob(CONFIG)} | set(configurations.values())
    planned: dict[Path, Planned] = {}
    lines = []
    for file in sorted(file for file in files if file):
        try:
            planned[file] = Planned.of(file)
        except UserError as error:
            lines.append(f"the plan of {file.parent.as_posix()} is unknown: {error}")
    lines += _unfinished(configurations, planned, table)
    lines += shards.missing(sorted(planned))
    for file, plan in planned.items():
        lines += _absent(file.parent, plan, table)
    return lines


def failed_lanes(failed: pa.Table, variants: Sequence[Variant]) -> list[str]:
    """Return one line for each variant with failed lanes, given all rows of such lanes."""
    left = {(variant.guidance, variant.labels): len(variant.seeds) for variant in variants}
    return [
        f"{failures.variant_name(*key)}: {seeds} failed, no longer finite: "
        + (f"curve and means are over the other {left[key]}" if key in left else "no lane is left")
        for key, seeds in failures.describe_failed(failed).items()
    ]


def short(table: pa.Table, variants: Sequence[Variant]) -> list[str]:
    """Return one line for each variant shown to less than its last step or without an interval, and for mixed runs."""
    lines = []
    guidance, labels = np.array(table["guidance"].to_pylist()), table["labels"].to_numpy()
    reached = table["step"].to_numpy()
    for variant in variants:
        furthest = int(reached[(guidance == variant.guidance) & (labels == variant.labels)].max())
        if furthest > variant.curve.steps[-1]:
            lines.append(
                f"{variant.name}: some seeds have reached step {furthest:,}; the curve ends at "
                f"{variant.curve.steps[-1]:,}, "
                "the last step of all seeds"
            )
        if len(variant.seeds) == 1:
            lines.append(f"{variant.name}: a single seed, so there is no interval")
    hashes = sorted(set(table["config_hash"].to_pylist()))
    if len(hashes) > 1:
        where = f" of {variants[0].run}" if variants and variants[0].run else ""
        lines.append(
            f"the runs{where} differ in more than guidance, labels and seed: configurations {', '.join(hashes)}"
        )
    return lines


def uneven(variants: Sequence[Variant]) -> list[str]:
    """Return a line if the curves end at different steps."""
    ends = {int(variant.curve.steps[-1]) for variant in variants}
    if len(ends) == 1:
        return []
    return [
        "curves end at different steps, so their final values cannot be compared; "
        f"means over the curve are taken to step {min(ends):,}, shared by all"
    ]


def _unfinished(configurations: dict[str, Path | None], planned: dict[Path, Planned], table: pa.Table) -> list[str]:
    """Return one line for each folder whose results do not reach the end."""
    folders, steps = np.array(table["folder"].to_pylist()), table["step"].to_numpy()
    lines = []
    for folder, file in configurations.items():
        last, total = int(steps[folders == folder].max()), planned[file].total_steps if file in planned else None
        if file is None:
            lines.append(f"{folder}: has no config.json, so its plan is unknown; at step {last:,}")
        elif total is not None and last < total:
            lines.append(f"{folder}: at step {last:,} of {total:,} ({last / total:.0%})")
        elif total is None and not (Path(folder) / results.PARQUET).exists():
            lines.append(f"{folder}: not finished, at step {last:,}")
    return lines


def _absent(run: Path, plan: Planned, table: pa.Table) -> list[str]:
    """Return one line for each planned kind of guidance, seed or label budget without results."""
    folders, row = np.unique(table["folder"].to_pylist(), return_inverse=True)
    below = np.array([Path(folder).is_relative_to(run) for folder in folders.tolist()])[row]
    name = run.as_posix()
    if not plan.guidance:
        return [] if below.any() else [f"{name}: no results"]
    guidance, labels = np.array(table["guidance"].to_pylist()), table["labels"].to_numpy()
    lines = []
    for kind in plan.guidance:
        rows = below & (guidance == kind)
        if not rows.any():
            lines.append(f"{name}: no results of {kind} guidance")
            continue
        seeds, budgets = set(table["seed"].to_numpy()[rows].tolist()), set(labels[rows].tolist())
        if absent := set(plan.seeds) - seeds:
            lines.append(f"{name}: no results of {kind} guidance with the seeds {_listed(absent)}")
        # A kind that asks for no labels has rows with 0 labels, whatever the other kinds' budgets.
        if budgets != {0} and (absent := set(plan.labels) - budgets):
            lines.append(f"{name}: no results of {kind} guidance with the label budgets {_listed(absent)}")
    return lines


def _configuration(folder: Path) -> Path | None:
    """Return the config.json of a folder with results; a run's lies above the folders of its kinds of guidance."""
    files = [folder / CONFIG, folder.parent / CONFIG]
    return next((file for file in files if os.path.exists(file)), None)


def _listed(numbers: set[int]) -> str:
    more = f" and {len(numbers) - LISTED:,} more" if len(numbers) > LISTED else ""
    return f"{', '.join(map(str, sorted(numbers)[:LISTED]))}{more}"
