"""Compare what the runs' config.json planned with what their results contain; list what a report lacks."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.compute as pc

from cuelearner_jax.errors import UserError, format_numbers
from cuelearner_jax.report.variants import Group, Variant
from cuelearner_jax.runs import failures, shards
from cuelearner_jax.storage import formats, results
from cuelearner_jax.storage.folders import CONFIG
from cuelearner_jax.task import Task

Plans = dict[Path, dict[str, Any] | UserError]  # what each config.json says, or why it cannot be read


def plans_of(folders: Sequence[str | os.PathLike[str]], table: pa.Table) -> Plans:
    """Return the plans below some folders, and those of the runs that a table holds."""
    files = {file for folder in folders for file in Path(folder).rglob(CONFIG)}
    files |= {file for folder in table["folder"].unique().to_pylist() if (file := _plan_above(folder))}
    plans: Plans = {}
    for file in sorted(files):
        try:
            plans[file] = formats.read("config", file)
        except UserError as error:
            plans[file] = error
    return plans


def _plan_above(folder: str) -> Path | None:
    """Return the config.json of a run, which lies above the folders of its kinds of guidance."""
    return next(filter(Path.exists, (Path(folder) / CONFIG, Path(folder).parent / CONFIG)), None)


def less_is_better(plans: Plans) -> set[str]:
    """Return the metrics of which less is better: by the runs' tasks, or by default where none says so."""
    own = [plan["less_is_better"] for plan in plans.values() if isinstance(plan, dict) and "less_is_better" in plan]
    return set().union(*(own or [Task.less_is_better]))


def missing(every: Plans, table: pa.Table, split: str) -> list[str]:
    """Return a line for everything planned that the table of a split lacks, or whose plan is unknown."""
    plans = {file: plan for file, plan in every.items() if isinstance(plan, dict)}
    unknown = [(file.parent.as_posix(), why) for file, why in every.items() if file not in plans]
    lines = [f"the plan of {folder} is unknown: {why}" for folder, why in unknown]
    for row in table.group_by("folder").aggregate([("step", "max")]).to_pylist():
        folder, last, file = row["folder"], row["step_max"], _plan_above(row["folder"])
        total = plans[file].get("total_steps") if file in plans else None
        if file is None:
            lines.append(f"{folder}: has no config.json, so its plan is unknown; at step {last:,}")
        elif total is not None and last < total:
            lines.append(f"{folder}: at step {last:,} of {total:,} ({last / total:.0%})")
        elif total is None and not (Path(folder) / results.PARQUET).exists():
            lines.append(f"{folder}: not finished, at step {last:,}")
    lines += shards.missing(sorted(plans))
    for file, plan in plans.items():
        if (other := plan.get("split", split)) != split:
            lines.append(f"{file.parent.as_posix()}: evaluated on {other} episodes, so not in this report")
        else:
            lines += _absent(file.parent, plan.get("grid", {}), table)
    return lines


def _absent(run: Path, grid: dict[str, Any], table: pa.Table) -> list[str]:
    """Return one line for each planned kind of guidance, seed or label budget without results."""
    name = run.as_posix()
    inside = [folder for folder in table["folder"].unique().to_pylist() if Path(folder).is_relative_to(run)]
    below = table.filter(pc.field("folder").isin(pa.array(inside, pa.string())))
    if not grid.get("guidance"):
        return [] if below.num_rows else [f"{name}: no results"]
    lines = []
    for kind in grid["guidance"]:
        if not (rows := below.filter(pc.field("guidance") == kind)).num_rows:
            lines.append(f"{name}: no results of {kind} guidance")
            continue
        seeds, budgets = (set(rows[column].unique().to_pylist()) for column in ("seed", "labels"))
        if absent := set(grid.get("seeds", ())) - seeds:
            lines.append(f"{name}: no results of {kind} guidance with the seeds {format_numbers(absent)}")
        # A kind that asks for no labels has rows with 0 labels, whatever the other kinds' budgets.
        if budgets != {0} and (absent := set(grid.get("labels", ())) - budgets):
            lines.append(f"{name}: no results of {kind} guidance with the label budgets {format_numbers(absent)}")
    return lines


def gaps(groups: Sequence[Group], variants: Sequence[Variant], metric: str, split: str) -> list[str]:
    """Return one line for everything in the results that the figures do not show."""
    lines: list[str] = []
    for group in groups:
        own = [one for one in variants if one.run == group.name and one.task in ("", group.task)]
        where = "".join(f"{word}: " for word in (group.task if variants[0].task else "", group.name) if word)
        counts = {(variant.guidance, variant.labels): len(variant.seeds) for variant in own}
        for key, seeds in failures.describe_failed(group.failed).items():
            rest = f"curve and means are over the other {counts[key]}" if key in counts else "no lane is left"
            lines.append(f"{where}{failures.variant_name(*key)}: {seeds} failed, no longer finite: {rest}")
        lines += _short(group.every, own)
        if group.invalid:
            lines.append(f"{where}{group.invalid:,} {split} rows have no finite {metric}; their steps are left out")
    for task, (start, end) in {one.task: one.span for one in variants}.items():
        ends = {(int(one.steps[0]), int(one.steps[-1])) for one in variants if one.task == task}
        span = f"from step {start:,.0f} to {end:,.0f}, shared by all" if start <= end else "over no shared steps"
        if len(ends) > 1:
            lines.append(
                f"{task and f'{task}: '}curves begin or end at different steps, so their final values cannot be "
                f"compared; means over the curve are taken {span}"
            )
    return lines


def _short(table: pa.Table, variants: Sequence[Variant]) -> list[str]:
    """Return one line for each variant shown to less than its last step or without an interval, and for mixed runs."""
    lines = []
    for variant in variants:
        rows = table.filter((pc.field("guidance") == variant.guidance) & (pc.field("labels") == variant.labels))
        furthest, last = pc.max(rows["step"]).as_py(), int(variant.steps[-1])  # pyright: ignore[reportAttributeAccessIssue]
        if furthest > last:
            words = f"the curve ends at {last:,}, the last step of all seeds"
            lines.append(f"{variant.name}: some seeds have reached step {furthest:,}; {words}")
        if left_out := len({step for step in rows["step"].to_pylist() if step <= last}) - len(variant.steps):
            lines.append(f"{variant.name}: {left_out} evaluations that not all seeds have are left out")
        if len(variant.seeds) == 1:
            lines.append(f"{variant.name}: a single seed, so there is no interval")
        elif not variant.episodes:
            words = "not all seeds keep results of equally many episodes, so intervals leave out the evaluation's error"
            lines.append(f"{variant.name}: {words}")
    if len(hashes := sorted(set(table["config_hash"].to_pylist()))) > 1:
        where, names = f" of {variants[0].run}" if variants and variants[0].run else "", ", ".join(hashes)
        lines.append(f"the runs{where} differ in more than guidance, labels and seed: configurations {names}")
    return lines
