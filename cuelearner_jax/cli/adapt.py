"""`cuelearner adapt`."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Generic

import numpy as np

from cuelearner_jax.adaptation import adapting, judging
from cuelearner_jax.cli.parsing import about, code_of, out, parse, source_of, taken, world_of
from cuelearner_jax.cli.shared_options import Flag, TaskT, seeds_of
from cuelearner_jax.config import GuideSizes, Scalars
from cuelearner_jax.errors import NotFinite, UserError
from cuelearner_jax.evaluate import Tell
from cuelearner_jax.plugins import REFERENCE
from cuelearner_jax.runs import adaptation
from cuelearner_jax.runs.adaptation import Base, Order
from cuelearner_jax.runs.trained import PolicySource
from cuelearner_jax.storage import label_files
from cuelearner_jax.task import Scenario
from cuelearner_jax.terminal import console, progress_bars


@dataclass(frozen=True)
class Adapt(Generic[TaskT]):
    """Correct a finished policy (of a run folder or policy folder; or, with --task, package.module:NAME, any function
    of observations) by labels about what it does in a changed world."""

    task: TaskT
    out: Path
    """The policy folder that is written."""
    labels: tuple[int, ...] = (500,)
    """Label budgets (with --labels-from by default all that the file has)."""
    bound_deg: tuple[float, ...] = ()
    """How far corrections may lead from the policy's own actions, one or more bounds [deg] (default: the scenario's, as
    far as the labels of a file reach, or else 45)."""
    seeds: int = 1
    """Number of seeds; not with several base policies, of which each is adapted with its own."""
    first_seed: int = 0
    """The first seed; the others follow."""
    guidance: str = adaptation.DEFAULT_KIND
    """Kind of guidance: what is asked, and what a model makes of the answers, see above."""
    scenario: str | None = None
    """The changed world of this name, see above; options of the task (--task.…) come on top of it."""
    robot: str | None = None
    """Another robot, see above (default: the task's own); with a folder, as anymal:FOLDER, one with your own walking
    policy."""
    labels_from: Path | None = None
    """Use the labels of this file instead of asking the teacher."""
    judge_by: str = "reward"
    """A model that makes the policy worse than it was is not used: by this metric on tuning episodes of the changed
    world, or by its prediction of held-out labels (labels)."""
    judge_episodes: int = 100
    """Tuning episodes that policies are judged on; where the task counts steps, each is 100 of them."""
    judge_every: int = 0
    """Also measure the policy after every so many labels on the way, kept in guide.parquet (0: at the end alone)."""
    judge_bounds: tuple[float, ...] = ()
    """Also try the model within these shares of its bound (0.5 0.25), and use it within what is worth most on the
    tuning episodes."""
    overwrite: Flag[bool] = False
    """Delete the policy folder that is there."""
    base: Base = field(default_factory=Base)
    sizes: GuideSizes = adapting.SIZES
    scalars: Scalars = field(default_factory=Scalars)


OPTIONS = {"adapt": Adapt}


def run(arguments: list[str]) -> None:
    """Runs the command. Raises UserError for what cannot be adapted, NotFinite if a model could not be fitted."""
    source, code, named, rest = _source(arguments)
    kind = Adapt[source.task.config]  # pyright: ignore[reportInvalidTypeArguments]
    world = world_of(source, rest)
    named_world, _ = taken(rest, "--scenario", ", ".join(source.task.scenarios) or "none")
    changed = source.task.scenario(named_world) if named_world else Scenario("the world as it is", {})
    if taken(rest, "--guidance", "a kind of guidance")[0] not in (None, changed.guidance):
        changed = replace(changed, guidance=None, sizes={}, scalars={})  # which are for the suggested kind
    if taken(rest, "--judge-by", "what it is judged by")[0] == judging.LABELS:
        changed = replace(changed, judge_bounds=())  # which are tried on episodes
    eps, strengths = changed.eps_deg, None
    labels, given = Adapt.labels, taken(rest, "--labels-from", "a labels.parquet")[0]
    if given:  # what the file holds is the default
        file = label_files.read(Path(given))
        eps, strengths = file.eps_deg if file.eps_deg else eps, file.labels.eps_deg
        labels = (int(np.unique(file.seeds, return_counts=True)[1].min()),)
    sizes = replace(adapting.SIZES, **{"frame": source.config.sizes.frame, **changed.sizes})
    of_run = replace(source.config.scalars, eps_last_deg=Scalars.eps_last_deg)  # of its own labels
    scalars = replace(adapting.settling(of_run, eps), **changed.scalars)
    sizes, scalars = adapting.falling(sizes, scalars, strengths)
    default = kind(
        world,
        out=Path("policies") / source.folder.name,
        labels=labels,
        base=Base(policy=source.default_policy),
        guidance=changed.guidance or Adapt.guidance,
        judge_by=changed.judge_by or Adapt.judge_by,
        judge_bounds=changed.judge_bounds,
        sizes=sizes,
        scalars=scalars,
    )
    asked = parse(kind, rest, f"adapt {source.folder}", default, about(Adapt, source.task, policies=True))
    order = _order(source, code, named, asked)
    with progress_bars(shown=console.is_terminal) as bars:

        def watch(what: str) -> Tell:
            bar = bars.add_task(what, total=None, note="")
            return lambda done, count: bars.update(bar, completed=done, total=count)

        found = adaptation.run(order, watch)
    for line in adaptation.told(found):
        out.print(line)
    out.print(f"wrote {asked.out} (measure it with: cuelearner evaluate {asked.out})")
    if found.block.failed.any():
        raise NotFinite("a fit is no longer finite, its model is not used: lower --scalars.feedback-learning-rate")


def _source(arguments: list[str]) -> tuple[PolicySource, Any, str | None, list[str]]:
    """Where policies come from, code in place of one of them, how that is named, and the other arguments.

    Raises UserError if they cannot be had.
    """
    if arguments and REFERENCE.fullmatch(arguments[0]) and not Path(arguments[0]).exists():
        named, rest = arguments[0], arguments[1:]
        if not any(word.split("=")[0] == "--task" for word in rest):
            raise UserError(f"{named} is to act in some task: name it, as --task navigation")
        source, rest = source_of(rest, "adapt", Adapt)
        return source, code_of(named), named, rest
    named, _ = taken(arguments, "--base", "package.module:NAME")
    source, rest = source_of(arguments, "adapt", Adapt)
    return source, None, named, rest


def _order(source: PolicySource, code: Any, named: str | None, asked: Adapt[Any]) -> Order:
    """What is asked for. Raises UserError for seeds that cannot be."""
    bounds = asked.bound_deg
    suggested = source.task.scenario(asked.scenario).bound_deg if asked.scenario else None
    if not bounds and suggested is not None:
        bounds = (suggested,)
    if code is not None and asked.base != Base(policy=source.default_policy):
        raise UserError(f"--base.… chooses among the lanes of a folder, and {named} is none: leave it out")
    return Order(
        source=source.on(asked.robot),
        robot=asked.robot,
        code=code,
        named=named,
        world=asked.task,
        out=asked.out,
        labels=asked.labels,
        bounds_deg=bounds,
        seeds=seeds_of(asked.first_seed, asked.seeds),
        kind=asked.guidance,
        labels_from=asked.labels_from,
        judge_by=asked.judge_by,
        judge_episodes=asked.judge_episodes,
        judge_every=asked.judge_every,
        judge_bounds=asked.judge_bounds,
        overwrite=asked.overwrite,
        base=asked.base,
        sizes=asked.sizes,
        scalars=asked.scalars,
    )
