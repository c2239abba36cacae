"""`cuelearner evaluate`."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from rich.table import Table

from cuelearner_jax.api.adaptation import agreement
from cuelearner_jax.cli.options import Finished, Flag, out
from cuelearner_jax.cli.sources import source_and_options, source_in
from cuelearner_jax.errors import UserError
from cuelearner_jax.report import measurements
from cuelearner_jax.report.measurements import Difference
from cuelearner_jax.runs.policy_sources import POLICIES, LaneChoice, PolicySource
from cuelearner_jax.storage import policy_folders
from cuelearner_jax.storage.results import LANE
from cuelearner_jax.storage.whole import replacing
from cuelearner_jax.studies import evaluate
from cuelearner_jax.studies.evaluate import EvaluateRequest, Measured
from cuelearner_jax.tasks import shipped
from cuelearner_jax.terminal import console, progress_bars, watched_by

FEWEST = 6  # differences that are all alike and that a two-sided sign test tells from 0


@dataclass(frozen=True, kw_only=True)
class Evaluate(Finished, EvaluateRequest):
    """Measure a policy on validation episodes, or compare two; in any changed world.

    The policy is of a run or a policy folder, or a task's teacher, heuristic or chance; or, with --env, it is
    package.module:NAME, any function of observations."""

    compare: str | None = None
    """Another run folder, policy folder or policy, on the same episodes: a table with both and the difference.
    --guidance, --labels and --seed choose its lanes too; in another folder only --seed does, if there are several."""
    labels_from: Path | None = None
    """Instead: how many answers of this label file the policy agrees with. Also of package.module:NAME and of a file in
    ONNX; beside the policy as it was and "already right" always."""
    out: Path | None = None
    """Also write the measurements to this JSON file."""
    json: Flag[bool] = False
    """Print the measurements, with intervals, as JSON in place of tables."""


def run(arguments: list[str]) -> None:
    """Run the command. Raises UserError for what cannot be evaluated."""
    source, options = source_and_options(arguments, "evaluate", Evaluate)
    source.task.engine(options.engine)
    source.check(options.policy, options.task, guidance=options.guidance)
    if options.labels_from is not None:
        _print_agreement(source, options)
        return
    evaluate.amount(source.task, options)
    if options.out and options.out.exists():
        raise UserError(f"{options.out} exists: give another --out")
    requests = [(source, options)]
    requests += [_other(source, options, options.compare)] if options.compare else []
    plans = [evaluate.prepare(*request) for request in requests]
    if options.compare:  # what cannot be compared is not measured first
        rows = ([row for block in lanes for row in evaluate.variants(env, block)] for env, lanes in plans)
        measurements.differences(*rows)
    with progress_bars() as bars:
        watch = watched_by(bars)
        measured = [evaluate.run(*request, watch, plan) for request, plan in zip(requests, plans, strict=True)]
    _print_measured(source, options, measured[0], measured[1] if options.compare else [])


def _print_measured(source: PolicySource, options: Evaluate, rows: list[Measured], others: Sequence[Measured]) -> None:
    """Print the measurements, or the comparison with others, and write them to the chosen file."""
    envs, steps = evaluate.amount(source.task, options)
    about = {"robot": source.task.robot, "engine": options.engine, "scenario": options.scenario}
    about = {name: value for name, value in about.items() if value}
    lane = f"{steps:,} steps a lane" if source.task.longest is None else f"{envs:,} episodes a lane"
    title, other = ", ".join([options.policy, *about.values(), lane]), options.compare or ""
    compared = measurements.differences(rows, others) if others else []
    described = about | ({"robot_digest": digest} if (digest := source.task.bodies[0].digest) else {})
    text = measurements.to_json(source, options, rows, described, (other, compared) if others else None)
    if options.out:  # first: whoever reads the table may leave before its end
        options.out.parent.mkdir(parents=True, exist_ok=True)
        with replacing(options.out) as file:
            file.write(text + "\n")
    shares = f"{envs:,} episodes" if source.task.longest else f"{envs:,} environments of {steps // envs:,} steps"
    if options.json:
        print(text)
    elif not others:
        out.print_table(_measurements(rows, title, shares))
    for difference in () if options.json else compared:
        out.print_table(_comparison(difference, other, title, shares))
        out.print(_verdict(difference))
    if any((row.metrics.get("finished", np.ones(1)) < 1).any() for row in [*rows, *others]):
        console.print("not every first episode has ended, so outcomes have no mean: give more --steps")
    if options.out:
        (console if options.json else out).print(f"wrote {options.out}")


def _print_agreement(source: PolicySource, options: Evaluate) -> None:
    """Print the share of a label file's answers that the policy agrees with. Raises UserError for other options."""
    name, path = options.policy, options.labels_from
    assert path is not None
    unused = [one for one in ("episodes", "steps", "envs", "engine", "compare", "out") if getattr(options, one)]
    unused += [one for one in LANE if len(getattr(options, one)) > 1]
    if unused:
        raise UserError(f"the answers of a label file need one policy: leave out --{unused[0]}, or give one value")
    if POLICIES[name].taught:
        raise UserError(f"policy {name!r} asks the teacher, who looks at the true state: choose another policy")
    kind, budget = next(iter(options.guidance), None), next(iter(options.labels), None)
    policy, _ = LaneChoice(policy=name, guidance=kind, labels=budget, seed=options.seed).lane_in(source, options.task)
    result = agreement(policy, path)
    subject = options.subject if name == "own" else f"{source.folder}, {name}"
    if options.json:
        print(json.dumps({"subject": subject, "labels": result.labels, "shares": dict(result.rows())}, indent=1))
        return
    title = f"{subject}: agreement with {result.labels} labels of {path}"
    table = Table("", "share of answers", "95% interval", title=title)
    for row, share in result.rows():
        table.add_row(row, f"{share[0]:.3f}", "{1:.3f} to {2:.3f}".format(*share))
    out.print_table(table)


def _other(source: PolicySource, options: Evaluate, name: str) -> tuple[PolicySource, Evaluate]:
    """Return the source and options of the policy to compare with, which acts in the same world on the same robot.

    Guidance and labels choose lanes of the same folder only. Raises UserError if the policy does not act in that world.
    """
    folder = shipped.folder_of(name)
    if folder.exists():
        code = (source.adapted.code if source.adapted else source.code) if policy_folders.is_one(folder) else None
        other = replace(source_in(folder, source.task, code, options.changes), task=source.task)
        policy = other.default_policy
    elif name in POLICIES:
        other, policy = source, name
    else:
        names = ", ".join(POLICIES)
        raise UserError(f"--compare is {name!r}: give a run folder, a policy folder, a shipped agent or one of {names}")
    is_same = other.folder.absolute() == source.folder.absolute()
    if policy == options.policy and is_same:
        raise UserError(f"--compare is {name!r}, the policy that is evaluated: give another one")
    seeds = other.grid.seeds if other.grid else other.adapted.lanes.seed if other.adapted else ()
    choice = LANE if is_same else ("seed",) if len({*seeds}) > 1 else ()
    unused = [one for one in LANE if one not in choice or not POLICIES[policy].from_folder]
    options = replace(options, policy=policy, **dict.fromkeys(unused, ()))
    other.check(policy, options.task, guidance=options.guidance)
    return other, options


def _measurements(rows: list[Measured], title: str, episodes: str) -> Table:
    """Return a table of means with intervals (single policies: over `episodes`), by guidance and budget."""
    columns = {
        "guidance": [row.guidance for row in rows],
        "labels": [str(row.labels) for row in rows],
        "within": [row.within for row in rows],
        "seeds": [str(len(row.seeds)) for row in rows],
        "trained steps": [f"{row.step:,}" if row.step else "" for row in rows],
    }
    is_alone = all(row.guidance == "-" for row in rows)  # of no folder
    columns = {} if is_alone else {name: cells for name, cells in columns.items() if any(cells)}
    over = {
        "episodes": f"one policy: mean over {episodes}, Student's t, of shares Wilson's score",
        "seeds": f"several seeds: interquartile mean, bootstrap over seeds and {episodes}",
    }
    caption = "; ".join(words for kind, words in over.items() if kind in map(measurements.over, rows))
    table = Table(*columns, "metric", "mean", "95% interval", title=title, caption=caption)
    for number, row in enumerate(rows):
        own = [cells[number] for cells in columns.values()]
        for name, values in row.metrics.items():
            mean, ends = "none", f"of {len(values)}, {int(np.isfinite(values).sum())} have one"
            if (of := measurements.spread(row, name)) is not None:
                mean, ends = f"{of.estimate:.3f}", "" if np.isnan(of.lower) else f"{of.lower:.3f} to {of.upper:.3f}"
            table.add_row(*own, name, mean, ends)
            own = [""] * len(own)
        table.add_section()
    return table


def _comparison(difference: Difference, other: str, title: str, episodes: str) -> Table:
    both = difference.row, difference.other
    over = {"episodes": f"{episodes}, paired, Student's t", "seeds": f"seeds and {episodes} (interquartile means)"}
    names = zip((title, other), map(measurements.variant, both), strict=True)
    heading = " against ".join(f"{name} ({variant})" if variant and name != "base" else name for name, variant in names)
    caption = f"mean [95% interval]; of the difference over {over[difference.over]}"
    table = Table("metric", "policy", "against", "difference", title=heading, caption=caption)
    for name, less in difference.metrics.items():
        table.add_row(name, *(f"{measurements.spread(row, name)}" for row in both), f"{less:+}")
    return table


def _verdict(difference: Difference) -> str:
    names = {"excludes 0": [], "includes 0": [], "needs more episodes": []}
    for name, less in difference.metrics.items():
        few = less.lower == less.upper != 0 and difference.row.each[name].size < FEWEST  # all alike: a sign test
        says = "excludes 0" if less.excludes_zero else "includes 0"
        names["needs more episodes" if few or np.isnan(less.lower) else says].append(name)
    parts = [f"{says} for {', '.join(metrics)}" for says, metrics in names.items() if metrics]
    return f"The 95% interval of the difference {'; '.join(parts)}."
