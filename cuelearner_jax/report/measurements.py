"""Intervals of measured policies, differences of two policies, and the JSON file of a measurement."""

from __future__ import annotations

import json
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from cuelearner_jax import config
from cuelearner_jax.errors import UserError
from cuelearner_jax.evaluate import group_means, mean_interval
from cuelearner_jax.report.statistics import Interval, interquartile_mean, interval, resampled
from cuelearner_jax.runs.policy_sources import POLICIES, PolicySource
from cuelearner_jax.storage.provenance import provenance
from cuelearner_jax.storage.table import plain
from cuelearner_jax.studies.evaluate import EvaluateRequest, Measured, amount


def is_single(row: Measured) -> bool:
    """Whether a row measures one policy, whose interval is over episodes instead of seeds."""
    return len(row.seeds) == 1 or row.is_shared


def over(*rows: Measured) -> str:
    """Return what the intervals of rows, or of their difference, are computed over: "episodes" or "seeds"."""
    return "episodes" if all(map(is_single, rows)) else "seeds"


def spread(row: Measured, metric: str) -> Interval | None:
    """Return one policy's mean over episodes, or the interquartile mean over seeds; None if a value is not finite.

    The interval of several seeds draws seeds and episodes. Where all episodes succeed, or all fail, resampling has no
    spread: the interval is then that of the episodes of one seed, which all seeds share.
    """
    if not np.isfinite(row.metrics[metric]).all():
        return None
    each = row.each[metric]
    is_share = metric not in (("reward", "return") if "return" in row.metrics else ())
    if is_single(row) or (is_share and each.min() == each.max() and each.min() in (0, 1)):
        return Interval(*mean_interval(each[0], is_share))
    return interval(row.metrics[metric], group_means(each))


class Difference(NamedTuple):
    """The difference of two policies measured on the same episodes."""

    row: Measured
    other: Measured
    over: str  # "episodes" or "seeds"
    metrics: dict[str, Interval]


def variant(row: Measured) -> str:
    """Return a row's guidance, labels and bound as a phrase; empty for a policy without them."""
    if row.guidance == "-":
        return ""
    return f"{row.guidance}, {row.labels} labels{f' within {row.within}' if row.within else ''}"


def differences(rows: Sequence[Measured], others: Sequence[Measured]) -> list[Difference]:
    """Return the difference of each row from the other row of its variant, or from the only other row.

    Two single policies are paired by episode, and rows of equal seeds by seed. A single policy is subtracted from each
    seed of several. Of rows with different seeds these are resampled independently, the episodes alike.
    """
    result = []
    for row in rows:
        alike = others if len(others) == 1 else [other for other in others if variant(other) == variant(row)]
        if len(alike) != 1:
            variants, own = "; ".join(map(variant, others)), variant(row) or "without labels"
            raise UserError(f"--compare has {len(others)} variants ({variants}), but not {own}: measure one of both")
        both = row, alike[0]
        shared = [name for name in row.metrics if name in both[1].metrics]
        finite = [name for name in shared if all(np.isfinite(one.metrics[name]).all() for one in both)]
        result.append(Difference(*both, over(*both), {name: _less(*both, name) for name in finite}))
    return result


def _less(row: Measured, other: Measured, name: str) -> Interval:
    if is_single(row) and is_single(other):
        return Interval(*mean_interval(row.each[name][0] - other.each[name][0]))
    both = [slice(0, 1) if is_single(one) else slice(None) for one in (row, other)]
    mine, its = (one.metrics[name][rows] for one, rows in zip((row, other), both, strict=True))
    groups = [group_means(one.each[name][rows]) for one, rows in zip((row, other), both, strict=True)]
    if is_single(row) or is_single(other) or np.array_equal(row.seeds, other.seeds):
        return interval(mine - its, groups[0] - groups[1])
    draws = resampled(groups[0], seed=0) - resampled(groups[1], seed=1)
    return Interval(interquartile_mean(mine) - interquartile_mean(its), *np.quantile(draws, [0.025, 0.975]))


def _numbers(of: Any) -> Any:
    """Return an interval, or values, as plain JSON numbers."""
    return plain(np.asarray(of).tolist())


def _row(row: Measured) -> dict[str, Any]:
    return {
        "guidance": row.guidance,
        "labels": row.labels,
        **({} if row.bound_deg is None else {"bound_deg": float(f"{row.bound_deg:g}")}),
        "trained_steps": row.step,
        "seeds": row.seeds.tolist(),
        **{metric: _numbers(values) for metric, values in row.metrics.items()},
        "intervals": {"over": over(row), **{metric: _numbers(spread(row, metric)) for metric in row.metrics}},
    }


def _compared(one: Difference) -> dict[str, Any]:
    difference = {metric: _numbers(value) for metric, value in one.metrics.items()}
    return {"of": variant(one.row), "less": _row(one.other), "over": one.over, "difference": difference}


def to_json(
    source: PolicySource,
    request: EvaluateRequest,
    rows: Sequence[Measured],
    body: dict[str, str],
    compared: tuple[str, Sequence[Difference]] | None = None,
) -> str:
    """Return measurements as JSON: the world, the rows with intervals, and the provenance.

    `body`: robot, engine and scenario, where they are not the defaults. `compared`: the other policy.
    """
    envs, steps = amount(source.task, request)
    contents = {
        "subject": source.folder.name,
        "world": {"name": source.task.name, **config.to_json(request.task)},
        **({"files": files} if POLICIES[request.policy].taught and (files := source.task.files(request.task)) else {}),
        "policy": request.policy,
        **body,
        "envs": envs,
        "steps": steps,
        **provenance(),
        "rows": [_row(row) for row in rows],
    }
    if compared is not None:
        name, pairs = compared
        contents["compared"] = {"with": name, "differences": [_compared(one) for one in pairs]}
    return json.dumps(contents, indent=1)
