"""Figures and tables from recorded results: what `cuelearner report` writes.

A report is a folder: `report.md` (table, figures, what is missing, where the numbers come from), `summary.csv` (the
table), `curves.csv` (what the curves show), `curves.png/.svg` and, where there are several label budgets,
`label_efficiency.png/.svg`. The same results always give the same bytes.
"""

from __future__ import annotations

import csv
import os
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from cuelearner_jax.errors import UserError
from cuelearner_jax.records import results
from cuelearner_jax.records.folders import in_use
from cuelearner_jax.report import escaping, extent
from cuelearner_jax.report.figures import Variant, draw_curves, draw_label_efficiency, save_figure
from cuelearner_jax.report.statistics import curve, interval, mean_over_curve, steps_to_reach, stretches_apart
from cuelearner_jax.runs import failures

Row = dict[str, str | int | float]  # of the summary


def report(
    folders: str | os.PathLike[str] | Sequence[str | os.PathLike[str]],
    out: str | os.PathLike[str],
    metric: str = "reward",
    *,
    split: str = "validation",
    task: str | None = None,
    lower_is_better: bool = False,
    overwrite: bool = False,
    command: str = "",
) -> Path:
    """Writes the report of any number of runs, done or still going.

    Args:
        folders: folders of runs, or folders above them.
        out: folder of the report.
        metric: metric column to report.
        split: "validation" or "training".
        task: keeps the runs of this task only; needed where there are several.
        lower_is_better: small values of the metric are good ones: what is best, and when a value is reached.
        overwrite: write over a report that is there already.
        command: command line that makes this report, noted in it.

    Returns:
        The path of `report.md`.

    Raises:
        UserError: if `out` is there already, or the results are missing, corrupt, of several tasks, lack the metric or
            the split, hold a seed twice, or are of failed lanes alone.
    """
    folders = [folders] if isinstance(folders, str | os.PathLike) else list(folders)
    out = Path(out)
    if in_use(out) and not overwrite:
        raise UserError(
            f"{out} exists already: choose another folder (--out), or allow it to be overwritten (--overwrite)"
        )
    table, failed, invalid = _select(results.read(folders, task), metric, split)
    variants = _variants(table, metric, results.failures(failed))
    missing = _failed_lanes(failed, variants) + _missing(folders, pa.concat_tables([table, failed]), variants)
    if invalid:
        missing.append(f"{invalid:,} {split} rows have no finite {metric}; the steps of these rows are left out")
    rows = summary(variants, lower_is_better)
    rows += _of_failed_alone(rows, failed)
    title = f"{table['task'][0].as_py()}: {split} {metric.replace('_', ' ')}, {_seed_count(variants)}"
    figures = {"curves": draw_curves(variants, title, metric)}
    if len({variant.labels for variant in variants if variant.labels}) > 1:
        figures["label_efficiency"] = draw_label_efficiency(variants, title, metric)

    out.mkdir(parents=True, exist_ok=True)
    for name in ("curves", "label_efficiency"):  # a figure of an earlier report that this one lacks must not stay
        for suffix in ("png", "svg"):
            (out / f"{name}.{suffix}").unlink(missing_ok=True)
    for name, figure in figures.items():
        save_figure(figure, out / name)
    _write_csv(out / "summary.csv", rows)
    _write_csv(out / "curves.csv", _curve_rows(variants))
    text = _markdown(title, rows, list(figures), missing, _provenance(pa.concat_tables([table, failed]), command))
    (out / "report.md").write_text(text, encoding="utf-8")
    return out / "report.md"


# --- from rows to variants -------------------------------------------------------------------------------------------


def _select(table: pa.Table, metric: str, split: str) -> tuple[pa.Table, pa.Table, int]:
    """The rows to report, all rows of lanes that failed, and how many rows were left out for a metric not finite."""
    if metric not in results.metrics(table):
        raise UserError(f"no metric {metric!r} in the results: there are {', '.join(results.metrics(table))}")
    splits = sorted(set(table["split"].to_pylist()))
    if split not in splits:
        raise UserError(f"no {split} rows in the results: there are {', '.join(splits)} rows")
    rows = table.filter(pc.field("split") == split)
    marked = results.failures(rows)
    lanes = zip(*(rows[name].to_pylist() for name in results.LANE), strict=True) if marked else ()
    of_failed = np.array([lane in marked for lane in lanes] or [False] * rows.num_rows, bool)
    rows, failed = rows.filter(pa.array(~of_failed)), rows.filter(pa.array(of_failed))
    if failed.num_rows and not rows.num_rows:
        raise UserError(f"nothing to report, {failures.summary(failed)}: train again with other settings")
    table = rows.filter(pc.field(metric).is_valid())
    if table.num_rows == 0:
        raise UserError(f"the metric {metric!r} has no finite value in the {split} rows: choose another metric")
    return table, failed, rows.num_rows - table.num_rows


def _variants(table: pa.Table, metric: str, failed: Mapping[results.LaneKey, int]) -> list[Variant]:
    """The variants in the order of the legend: unguided, then by guidance and label budget."""
    guidance, labels = np.array(table["guidance"].to_pylist()), table["labels"].to_numpy()
    keys = set(zip(guidance.tolist(), labels.tolist(), strict=True))
    raw = {}
    for key in sorted(keys, key=lambda key: (key[0] != "none", key[0], key[1])):
        raw[key] = _matrix(table.filter(pa.array((guidance == key[0]) & (labels == key[1]))), metric, key)
    shared = min(steps[-1] for _, steps, _ in raw.values())
    variants = []
    for (kind, budget), (seeds, steps, values) in raw.items():
        until = max(1, int(np.searchsorted(steps, shared, side="right")))
        mean = interval(mean_over_curve(steps[:until], values[:, :until]))
        lost = np.array([step for lane, step in failed.items() if lane[:2] == (kind, budget)], int)
        variants.append(Variant(kind, budget, seeds, values, curve(steps, values), mean, lost))
    return variants


def _matrix(table: pa.Table, metric: str, key: tuple[str, int]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Seeds (seeds,), steps (steps,) and values (seeds, steps) of one variant, at the steps that all seeds have."""
    seeds, row = np.unique(table["seed"].to_numpy(), return_inverse=True)
    steps, column = np.unique(table["step"].to_numpy(), return_inverse=True)
    count = np.zeros((len(seeds), len(steps)), int)
    np.add.at(count, (row, column), 1)
    if count.max() > 1:
        twice = seeds[(count > 1).any(axis=1)][0]
        where = sorted(set(table.filter(pc.field("seed") == int(twice))["folder"].to_pylist()))
        raise UserError(
            f"seed {twice} of {key[0]} guidance with {key[1]} labels occurs twice, in {' and '.join(where)}: "
            "leave one of them out"
        )
    values = np.full(count.shape, np.nan)
    values[row, column] = table[metric].to_numpy()
    whole = (count == 1).all(axis=0)
    if not whole.any():
        raise UserError(
            f"the seeds of {key[0]} guidance with {key[1]} labels have no step in common: wait for all of them, or "
            "leave out the run that was evaluated at other steps"
        )
    return seeds, steps[whole], values[:, whole]


def _seed_count(variants: Sequence[Variant]) -> str:
    counts = sorted({len(variant.seeds) for variant in variants})
    return (
        f"{counts[0]} seed{'s' if counts[0] > 1 else ''}" if len(counts) == 1 else f"{counts[0]} to {counts[-1]} seeds"
    )


def _failed_lanes(failed: pa.Table, variants: Sequence[Variant]) -> list[str]:
    """One line for each variant of which lanes have failed, given all rows of such lanes."""
    left = {(variant.guidance, variant.labels): len(variant.seeds) for variant in variants}
    return [
        f"{failures.variant_name(*key)}: {seeds} failed, no longer finite: "
        + (f"curve and means are over the other {left[key]}" if key in left else "no lane is left")
        for key, seeds in failures.told(failed).items()
    ]


def _of_failed_alone(rows: Sequence[Row], failed: pa.Table) -> list[Row]:
    """Rows of the summary, beside those that there are, for variants of which every lane has failed."""
    there = {(row["guidance"], row["labels"]) for row in rows}
    lanes = Counter(key[:2] for key in results.failures(failed) if key[:2] not in there)
    blank = dict.fromkeys(rows[0], "")
    return [{**blank, "guidance": key[0], "labels": key[1], "seeds": 0, "failed": n} for key, n in lanes.items()]


def _missing(folders: Sequence[str | os.PathLike[str]], table: pa.Table, variants: Sequence[Variant]) -> list[str]:
    """One line for everything that a reader of the report would otherwise take to be there."""
    lines = extent.missing(folders, table)
    guidance, labels = np.array(table["guidance"].to_pylist()), table["labels"].to_numpy()
    reached = table["step"].to_numpy()
    for variant in variants:
        furthest = int(reached[(guidance == variant.guidance) & (labels == variant.labels)].max())
        if furthest > variant.curve.steps[-1]:
            lines.append(
                f"{variant.name}: some seeds have reached step {furthest:,}; shown to {variant.curve.steps[-1]:,}, "
                "where all of them are"
            )
        if len(variant.seeds) == 1:
            lines.append(f"{variant.name}: one seed, so no interval")
    if len({int(variant.curve.steps[-1]) for variant in variants}) > 1:
        shared = min(int(variant.curve.steps[-1]) for variant in variants)
        lines.append(
            "curves end at different steps, so their final values are no comparison; "
            f"means over the curve are taken to step {shared:,}, shared by all"
        )
    hashes = sorted(set(table["config_hash"].to_pylist()))
    if len(hashes) > 1:
        lines.append(f"the runs differ in more than guidance, labels and seed: configurations {', '.join(hashes)}")
    return lines


# --- tables ----------------------------------------------------------------------------------------------------------


def summary(variants: Sequence[Variant], lower_is_better: bool = False) -> list[Row]:
    """One row for each variant, numbers unrounded; the columns are those of `summary.csv`.

    `reaches_unguided_final` is the first step at which the variant's interquartile mean is as good as the unguided
    one's at its last step. The stretches `above_unguided` and `below_unguided` are those of `stretches_apart`.
    """
    unguided = next((variant for variant in variants if variant.guidance == "none"), None)
    sign = -1.0 if lower_is_better else 1.0
    rows = []
    for variant in variants:
        goodness = sign * variant.curve.estimate
        steps, best = variant.curve.steps, int(goodness.argmax())
        row: Row = {"guidance": variant.guidance, "labels": variant.labels}
        row |= {"seeds": len(variant.seeds), "failed": len(variant.failed), "last_step": int(steps[-1])}
        row |= {"final": variant.curve.estimate[-1], "final_lower": variant.curve.lower[-1]}
        row |= {"final_upper": variant.curve.upper[-1], "mean": float(variant.mean.estimate)}
        row |= {"mean_lower": float(variant.mean.lower), "mean_upper": float(variant.mean.upper)}
        row |= {"best_step": int(steps[best]), "best": variant.curve.estimate[best]}
        row |= {"reaches_unguided_final": "", "above_unguided": "", "below_unguided": ""}
        if unguided is not None:
            reached = steps_to_reach(steps, goodness[None], sign * unguided.curve.estimate[-1])[0]
            row["reaches_unguided_final"] = int(reached) if np.isfinite(reached) else "never"
            for column, apart in (
                ("above_unguided", stretches_apart(variant.curve, unguided.curve)),
                ("below_unguided", stretches_apart(unguided.curve, variant.curve)),
            ):
                row[column] = "; ".join(f"{start}-{end}" for start, end in apart) if variant is not unguided else ""
        rows.append({name: value.item() if isinstance(value, np.generic) else value for name, value in row.items()})
    return rows


def _curve_rows(variants: Sequence[Variant]) -> list[Row]:
    return [
        {"guidance": variant.guidance, "labels": variant.labels, "seeds": len(variant.seeds), "step": int(step)}
        | {"iqm": float(estimate), "lower": float(lower), "upper": float(upper)}
        for variant in variants
        for step, estimate, lower, upper in zip(*variant.curve, strict=True)
    ]


def _write_csv(path: Path, rows: Sequence[Row]) -> None:
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, list(rows[0]), lineterminator="\n")
        writer.writeheader()
        writer.writerows({name: escaping.cell(value) for name, value in row.items()} for row in rows)


def _provenance(table: pa.Table, command: str) -> list[str]:
    """Lines of Markdown."""
    lines = [f"report made by: {escaping.code(command)}"] if command else []
    names = {"command": "runs made by", "config_hash": "configuration", "commit": "commit"}
    for column, name in (names | {"versions": "versions", "hardware": "hardware"}).items():
        values = set(table[column].to_pylist()) if column in table.column_names else set()
        known = sorted(value for value in values if value)
        escape = escaping.code if column in ("command", "config_hash", "commit") else escaping.markdown
        lines += [f"{name}: {escape(value)}" for value in known] or [f"{name}: not recorded"]
    return lines


def _markdown(
    title: str,
    rows: Sequence[Row],
    figures: Sequence[str],
    missing: Sequence[str],
    provenance: Sequence[str],
) -> str:
    header = ["guidance", "labels", "seeds", "last step", "final", "mean over the curve", "best (at step)"]
    header += ["reaches the unguided final", "interval above the unguided", "interval below the unguided"]
    lines = [f"# {escaping.markdown(title)}", "", *(f"![{name.replace('_', ' ')}]({name}.png)\n" for name in figures)]
    lines += [f"| {' | '.join(header)} |", "|" + "---|" * len(header)]
    for row in rows:
        reached, failed = row["reaches_unguided_final"], int(row["failed"])
        seeds = f"{row['seeds']} of {int(row['seeds']) + failed}, {failed} failed" if failed else row["seeds"]
        cells = [escaping.markdown(row["guidance"]), f"{row['labels']:,}", seeds]
        if not row["seeds"]:
            lines.append(f"| {' | '.join(map(str, cells))} |" + " |" * (len(header) - len(cells)))
            continue
        cells.append(f"{row['last_step']:,}")
        for key in ("final", "mean"):
            bounds = f" [{row[f'{key}_lower']:.3f}, {row[f'{key}_upper']:.3f}]" if int(row["seeds"]) > 1 else ""
            cells.append(f"{row[key]:.3f}{bounds}")
        cells += [f"{row['best']:.3f} ({row['best_step']:,})", f"{reached:,}" if isinstance(reached, int) else reached]
        for column in ("above_unguided", "below_unguided"):
            apart = [stretch.split("-") for stretch in str(row[column]).split("; ") if stretch]
            spans = [f"{int(start):,} to {int(end):,}" if start != end else f"{int(start):,}" for start, end in apart]
            cells.append("; ".join(spans))
        lines.append(f"| {' | '.join(str(cell) for cell in cells)} |")
    lines += [
        "",
        "Interquartile means over seeds with their 95% percentile bootstrap intervals in brackets; with fewer than 10 "
        "seeds such intervals are too narrow. Steps are environment steps of one seed. Intervals are compared at each "
        "evaluation by itself, so a short stretch may be chance.",
    ]
    lines += [
        "",
        "## Missing",
        "",
        *(f"- {escaping.markdown(line)}" for line in missing or ["nothing: all runs are complete"]),
    ]
    lines += ["", "## Where the numbers come from", "", *(f"- {line}" for line in provenance), ""]
    return "\n".join(lines)
