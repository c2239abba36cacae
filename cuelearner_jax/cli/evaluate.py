"""`cuelearner evaluate`."""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import takewhile
from pathlib import Path
from typing import Any, Generic

import numpy as np
from rich.table import Table

from cuelearner_jax.api import correction
from cuelearner_jax.cli.parsing import out, taken
from cuelearner_jax.cli.shared_options import Outside, TaskT, asked_of_source
from cuelearner_jax.cli.sources import code_of, is_code
from cuelearner_jax.errors import UserError
from cuelearner_jax.report import measurements
from cuelearner_jax.report.measurements import Difference
from cuelearner_jax.runs import trained
from cuelearner_jax.runs.trained import POLICIES, PolicySource
from cuelearner_jax.storage import policy_folders
from cuelearner_jax.studies import evaluate
from cuelearner_jax.studies.evaluate import EvaluateRequest, Measured
from cuelearner_jax.tasks import registry, shipped
from cuelearner_jax.terminal import console, progress_bars, watched_by


@dataclass(frozen=True, kw_only=True)
class Evaluate(EvaluateRequest[TaskT], Outside, Generic[TaskT]):
    """Measure a policy on validation episodes, or compare two; in any changed world.

    The policy is of a run or a policy folder, or a task's teacher, heuristic or chance."""

    robot: str | None = None
    """Another robot, by its name (default: the task's own). With a folder, as anymal:FOLDER: one with your own walking
    policy."""
    scenario: str | None = None
    """A changed world, by its name. Options of the task (--task.…) come on top of it."""
    compare: str | None = None
    """Another run folder, policy folder or policy, on the same episodes: a table with both and the difference. Two may
    stand here with nothing named before: evaluate --compare A B."""
    labels_from: Path | None = None
    """Instead: how many answers of this label file the policy agrees with. Also of package.module:NAME and of a file in
    ONNX; beside the policy as it was and "already right" always."""
    out: Path | None = None
    """Also write the measurements to this JSON file. (Beside all these: --base and --changes package.module:NAME give
    the code of a policy folder that has some, --agent and --arbiter that of a run's own parts.)"""


OPTIONS = {"evaluate": Evaluate}
COMPARE = "--compare"


def run(arguments: list[str]) -> None:
    """Run the command. Raises UserError for what cannot be evaluated."""
    if arguments and is_code(arguments[0]) and (file := taken(arguments, "--labels-from", "a labels.parquet"))[0]:
        if len(file[1]) > 1:
            raise UserError(f"the answers of a label file need the policy alone: leave out {file[1][1]}")
        _print_agreement(arguments[0], code_of(arguments[0]), file[0])
        return
    source, asked = asked_of_source(_named_first(arguments), "evaluate", Evaluate)
    if asked.labels_from is not None:
        source.check(asked.policy, asked.task, guidance=asked.guidance)
        if trained.POLICIES[asked.policy].taught:
            raise UserError(
                f"policy {asked.policy!r} asks the teacher, who looks at the true state: choose another policy"
            )
        policy = trained.one_policy(source, asked.task, asked.policy, next(iter(asked.guidance), None), None, None)
        _print_agreement(f"{source.folder}, {asked.policy}", policy, asked.labels_from)
        return
    source.task.engine(asked.engine)
    source.check(asked.policy, asked.task, guidance=asked.guidance)
    envs, steps = evaluate.amount(source.task, asked)
    if asked.out and asked.out.exists():
        raise UserError(f"{asked.out} exists: give another --out")
    other = _other(source, asked) if asked.compare is not None else None
    with progress_bars() as bars:
        watch = watched_by(bars)
        found = evaluate.run(source, asked, watch)
        others = evaluate.run(other[0], replace(asked, policy=other[1], guidance=()), watch) if other else []
    compared = measurements.differences(found, others) if other else None
    told = {"robot": source.task.robot, "engine": asked.engine, "scenario": asked.scenario}
    told = {name: value for name, value in told.items() if value}
    robot = {"robot_digest": digest} if (digest := source.task.bodies[0].digest) else {}
    amount = f"{steps:,} steps a lane" if source.task.longest is None else f"{envs:,} episodes a lane"
    title = ", ".join([asked.policy, *told.values(), amount])
    if asked.out:  # first: whoever reads the table may leave before its end
        named = (str(asked.compare), compared) if compared is not None else None
        described = {**told, **robot}
        measurements.write(asked.out, source, asked.task, asked.policy, envs, steps, found, described, named)
    shares = f"{envs:,} episodes" if source.task.longest else f"{envs:,} environments of {steps // envs:,} steps"
    if compared is None:
        out.print(_measurements(found, title, shares))
    for difference in compared or ():
        out.print(_comparison(difference, str(asked.compare), title, shares))
        out.print(_verdict(difference))
    if any((row.metrics.get("finished", np.ones(1)) < 1).any() for row in [*found, *others]):
        console.print("not every first episode has ended, so outcomes have no mean: give more --steps")
    if asked.out:
        out.print(f"wrote {asked.out}")


def _named_first(arguments: list[str]) -> list[str]:
    """Return the arguments with `--compare A B` as `A --compare B` where nothing is named before.

    Raises UserError for a single policy after a --compare that comes first.
    """
    if COMPARE not in arguments or not arguments[0].startswith("-"):
        return arguments
    place = arguments.index(COMPARE) + 1
    both = list(takewhile(lambda word: not word.startswith("-"), arguments[place:]))
    if place == 1 and len(both) == 1:
        raise UserError(f"--compare {both[0]} compares with nothing: give two, as --compare {both[0]} uniform")
    if len(both) != 2:
        return arguments
    first, second = both
    return [first, *arguments[: place - 1], COMPARE, second, *arguments[place + 2 :]]


def _print_agreement(named: str, policy: Any, path: Any) -> None:
    """Print the share of a label file's answers that a policy agrees with."""
    found = correction.agreement(policy, path)
    table = Table(
        "", "share of answers", "95% interval", title=f"{named}: agreement with {found.labels} labels of {path}"
    )
    rows = (
        ("the policy", found.policy),
        ("the policy as it was", found.base),
        ("always already right", found.right),
        ("difference from the policy as it was", found.difference),
    )
    for name, share in rows:
        if share is not None:
            table.add_row(name, f"{share[0]:.3f}", f"{share[1]:.3f} to {share[2]:.3f}")
    out.print(table)


def _other(source: PolicySource, asked: Evaluate[Any]) -> tuple[PolicySource, str]:
    """Return the source and name of the policy to compare with. Raises UserError if it does not act in that world."""
    given = str(asked.compare)
    folder = shipped.folder_of(given)
    if given in POLICIES and not folder.exists():
        other, policy = source, given
    elif folder.exists():
        code = source.adapted.code if source.adapted and policy_folders.is_one(folder) else None
        other = PolicySource.of_folder(folder, registry.find, code)
        if other.task.name != source.task.name:
            raise UserError(f"{given} is of {other.task.name}, not of {source.task.name}: compare within one task")
        other, policy = other.on(asked.robot), other.default_policy
    else:
        known = ", ".join(POLICIES)
        raise UserError(
            f"--compare is {given!r}: give a run folder, a policy folder, a shipped agent, or one of {known}"
        )
    if policy == asked.policy and other.folder.absolute() == source.folder.absolute():
        raise UserError(f"--compare is {given!r}, the policy that is evaluated: give another one")
    other.check(policy, asked.task)
    return other, policy


def _measurements(found: list[Measured], title: str, episodes: str) -> Table:
    """Return a table of means with intervals (single policies: over `episodes`), by guidance and budget."""
    columns = {
        "guidance": lambda row: row.guidance,
        "labels": lambda row: str(row.labels),
        "within": lambda row: row.within,
        "seeds": lambda row: str(len(row.seeds)),
        "trained steps": lambda row: f"{row.step:,}",
    }
    if all(row.guidance == "-" for row in found):  # of no folder
        columns = {}
    elif not any(row.step for row in found):
        del columns["trained steps"]
    if all(row.bound_deg is None for row in found):
        columns.pop("within", None)
    table = Table(*columns, "metric", "mean", "95% interval", title=title, caption=_over(found, episodes))
    for column in table.columns:
        column.no_wrap = True
    for row in found:
        own = [told(row) for told in columns.values()]
        for name, values in row.metrics.items():
            of = measurements.spread(row, name)
            if of is None:
                told = f"of {len(values)}, {int(np.isfinite(values).sum())} have one"
                table.add_row(*own, name, "none", told)
            else:
                ends = "" if np.isnan(of.lower) else f"{of.lower:.3f} to {of.upper:.3f}"
                table.add_row(*own, name, f"{of.estimate:.3f}", ends)
            own = [""] * len(own)
        table.add_section()
    return table


def _over(found: list[Measured], episodes: str) -> str:
    """Return what the means and intervals are computed over, in words."""
    kinds = {measurements.over(row) for row in found}
    told = {
        measurements.EPISODES: f"one policy: mean and bootstrap over {episodes}",
        measurements.SEEDS: "several seeds: interquartile mean and bootstrap over seeds",
    }
    return "; ".join(text for kind, text in told.items() if kind in kinds)


def _comparison(difference: Difference, other: str, title: str, episodes: str) -> Table:
    """Return a table of two policies side by side, with their difference."""
    mine, its = (measurements.variant(row) for row in (difference.row, difference.other))
    over = f"{episodes}, paired" if difference.over == measurements.EPISODES else "seeds (interquartile means)"
    named = " against ".join(name + (f" ({told})" if told else "") for name, told in ((title, mine), (other, its)))
    table = Table(
        *("metric", "policy", "against", "difference"),
        title=named,
        caption=f"mean [95% bootstrap interval]; of the difference over {over}",
        padding=0,
    )
    for column in table.columns:
        column.no_wrap = True
    for name, less in difference.metrics.items():
        both = (measurements.spread(row, name) for row in (difference.row, difference.other))
        table.add_row(name, *map(str, both), f"{less.estimate:+.3f} [{less.lower:+.3f}, {less.upper:+.3f}]")
    return table


def _verdict(difference: Difference) -> str:
    """Return a sentence on which metrics' differences exclude 0."""
    apart = [name for name, less in difference.metrics.items() if less.excludes_zero]
    alike = [name for name in difference.metrics if name not in apart]
    told = [f"excludes 0 for {', '.join(apart)}"] * bool(apart) + [f"includes 0 for {', '.join(alike)}"] * bool(alike)
    return f"The 95% interval of the difference {'; '.join(told)}."
