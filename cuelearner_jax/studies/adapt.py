"""Adaptation as one request, filled alike by the command line and Python, which checks itself and runs.

request = AdaptRequest.of(task, config, scenario="rooms")    # the defaults
study = replace(request, labels=(250,)).run(Subject(task, env, bases))
with policy_folders.place_of(out) as place:
    study.write(place)
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from cuelearner_jax.adaptation import by_model, by_reading, changes, judging, serialization
from cuelearner_jax.adaptation.by_model import AdaptationResult
from cuelearner_jax.adaptation.by_reading import ReadingAdaptation
from cuelearner_jax.adaptation.judging import LABELS, PERSON, Judging, Prefer
from cuelearner_jax.adaptation.lanes import Adaptation, begin, product, side_by_side
from cuelearner_jax.asking import label_slots
from cuelearner_jax.config import GuideSizes, Scalars, check_guide, check_part
from cuelearner_jax.devices import release_programs
from cuelearner_jax.environment import Environment, actions_of, spaces_of
from cuelearner_jax.errors import UserError, suggestion
from cuelearner_jax.evaluate import Tell, ignore_progress
from cuelearner_jax.feedback import external_labels
from cuelearner_jax.feedback.answers import check_teacher
from cuelearner_jax.guides import registry as guidances
from cuelearner_jax.guides.base import Guide, ReadingGuide
from cuelearner_jax.policies import Common, lanes_in
from cuelearner_jax.reading.families import declared_distortions
from cuelearner_jax.run_config import RunConfig
from cuelearner_jax.runs import adapted, policy_sources
from cuelearner_jax.runs.grid import Grid, check_grid, parse_seeds
from cuelearner_jax.runs.order import read_labels
from cuelearner_jax.runs.policy_sources import LaneChoice, PolicySource
from cuelearner_jax.storage import label_files
from cuelearner_jax.storage.whole import Place
from cuelearner_jax.task import Scenario, Task
from cuelearner_jax.types import Label, Teacher

AS_IT_IS = Scenario("the world as it is", {})


class Subject(NamedTuple):
    """The policies to adapt, the world that they act in, and who answers."""

    task: Task
    env: Environment
    bases: Any  # a block of policies, or `Common`
    seeds: tuple[int, ...] = (0,)  # of several base policies, each of which is adapted with its own
    origin: dict[str, Any] = {}  # noqa: RUF012  # the base policies in plain values; empty: no folder will hold them
    teacher: Teacher | None = None  # None: the task's teacher
    rows: Label | None = None  # labels (labels, ...) in place of questions; None: ask
    changes: Any = None  # what may have changed, as `changes.family_of` takes it; None: what the world declares
    changes_reference: str = "code"  # package.module:NAME of `changes`
    prefer: Prefer | None = None  # who judges, where a person does


def subject_of(source: PolicySource, world: Any, base: LaneChoice, reference: str | None = None) -> Subject:
    """Return the source's policies, or its code, in a world of its task.

    `reference`: package.module:NAME of code that acts or is in the folder.
    """
    env, name = source.task.environment(world), base.name_in(source, world)
    if policy_sources.POLICIES[name].taught:
        raise UserError(f"policy {name!r} asks the teacher, so there is nothing to adapt: choose another")
    policies, lanes = base.lanes_in(source, world, env)
    seeds = tuple(lane["seed"] for lane in lanes)
    origin = {"code": reference} if reference else {}
    if source.code is None:
        lane = {name: value for name, value in lanes[0].items() if name != "seed"}
        lane |= {} if base.bound_deg is None else {"bound_deg": base.bound_deg}
        origin = {"folder": source.folder.name, **lane, "policy": name, "seeds": list(seeds), **origin}
    bases = Common(policies[0]) if len(policies) == 1 else side_by_side(policies)
    return Subject(source.task, env, bases, seeds, origin)


@dataclass(frozen=True, kw_only=True)
class AdaptRequest:
    """A request to adapt a policy."""

    task: Any
    labels: tuple[int, ...] = (500,)
    """Label budgets (default with --labels-from: all labels in the file)."""
    bound_deg: tuple[float, ...] = ()
    """How far corrections may lead from the policy's own actions [deg]. One bound or several (default: the scenario's;
    of `reading` none; else as far as the labels of a file reach, or a quarter of the space's reach, 45)."""
    seeds: str = "1"
    """Number of seeds, or a range such as 0:16, without its end. Several base policies are each adapted with their own
    seed, so leave this out then."""
    guidance: str = ReadingGuide.name
    """Kind of guidance: what is asked, and what a model makes of the answers."""
    labels_from: Path | None = None
    """Label file to use instead of asking the teacher."""
    judge_by: str = "reward"
    """What decides whether the correction is used: labels (default of `reading`), a metric of which more is better,
    as success on tuning episodes, or person: you, by films. What is not shown to be better is not used."""
    judge_episodes: int = 50
    """Largest number of tuning episodes for judging a policy; 100 steps each where the task counts steps."""
    judge_bounds: tuple[float, ...] = ()
    """Also try the model within these shares of its bound, for instance 0.5 0.25, and use the bound that scores best on
    the tuning episodes."""
    sizes: GuideSizes = by_model.SIZES
    scalars: Scalars = field(default_factory=Scalars)
    kinds: dict[str, Any] = field(default_factory=dict)
    """Options of kinds of guidance, by the kind's name."""

    @classmethod
    def of(
        cls,
        task: Task,
        config: RunConfig,
        scenario: str | None = None,
        guidance: str | None = None,
        judge_by: str | None = None,
        labels_from: Path | None = None,
        eps_deg: float | None = None,
        scalars: Scalars | None = None,
    ) -> Any:
        """Return the default request; the only place where the rules of scenarios are applied.

        `config`: of the policy's training, whose frame and scalars the model uses. `guidance`, `judge_by`: None for
        what the scenario suggests, or the general default; a scenario's other suggestions apply to the kind that it
        suggests, its shares of a bound to judging on episodes. `eps_deg`: None for the label file's, that of given
        scalars, the scenario's, or the training's.
        """
        rules = task.scenario(scenario) if scenario else AS_IT_IS
        kind = guidances.resolve(guidance or rules.guidance or ReadingGuide.name)
        if kind.name != rules.guidance:
            rules = replace(rules, sizes={}, scalars={}, options={})  # these apply to the suggested kind
            if kind.by_evidence:
                rules = replace(rules, bound_deg=None, judge_by=None, judge_bounds=())
        labels = (by_reading.USUAL,) if kind.by_evidence else cls.labels
        if labels_from is not None:
            file = label_files.read(labels_from)
            eps_deg, labels = file.eps if eps_deg is None else eps_deg, (file.budget,)
        if scalars is None and eps_deg is None:
            eps_deg = rules.eps_deg
        own_scalars = by_model.settling(scalars or config.scalars, eps_deg)
        own = config.kinds.get(kind.name) or (kind.config and kind.config())
        return cls(
            task=rules.apply(config.task),
            labels=labels,
            bound_deg=() if rules.bound_deg is None else (rules.bound_deg,),
            guidance=kind.name,
            labels_from=labels_from,
            judge_by=judge_by or rules.judge_by or (LABELS if kind.by_evidence else task.judge_by(config.task)),
            judge_bounds=() if judge_by == LABELS else rules.judge_bounds,
            sizes=replace(by_model.SIZES, **{"frame": config.sizes.frame, **rules.sizes}),
            scalars=own_scalars if scalars else replace(own_scalars, **rules.scalars),
            kinds={kind.name: replace(own, **rules.options)} if own else {},
        )

    def run(self, subject: Subject, watch: Callable[[str], Tell] = lambda what: ignore_progress) -> AdaptedStudy:
        """Check the request and adapt; nothing is written. Raises UserError for an invalid or impossible request.

        `watch`: given the name of a step, returns the function that reports its progress.
        """
        release_programs()
        task, env, bases = subject.task, subject.env, subject.bases
        of, is_shared = self._adaptation(subject), lanes_in(bases) is None
        if not is_shared and self.seeds != AdaptRequest.seeds:
            raise UserError("several base policies are adapted each with its own seed: leave out --seeds")
        seeds = parse_seeds(self.seeds) if is_shared else subject.seeds
        budgets = self.labels if subject.rows is None else (len(subject.rows.obs),)
        file = self._labels(subject, of.guidance, Grid((of.guidance.name,), seeds, budgets))
        lanes = product(1, seeds, budgets, self._bounds(subject, of.guidance, file), one_each=not is_shared)
        how, rows, teacher = self._judging(subject, lanes.number), None, subject.teacher
        if file is not None:
            slots = label_slots(int(lanes.budget.max()), self.sizes)
            rows = label_files.for_lanes(file, lanes.seed, lanes.budget, slots)
        else:
            teacher = teacher or task.make_teacher(self.task, env, questions=int(lanes.budget.sum()))
            check_teacher(teacher, self.scalars)
        if subject.origin:  # a folder will hold the policy: UserError if it cannot
            plain = of.unread(bases) if isinstance(of, ReadingAdaptation) else of.policy(begin(of, lanes))
            serialization.to_json(plain)
        adapt: Any = by_reading.adapt if of.guidance.by_evidence else by_model.adapt
        return AdaptedStudy(adapt(of, lanes, how, teacher, rows, watch=watch), subject, self)

    def _adaptation(self, subject: Subject) -> Adaptation:
        """Return the settings that all lanes share. Raises UserError for settings that do not fit the world."""
        check_guide(self.sizes, self.scalars)
        for name, options in self.kinds.items():
            check_part(options, name)
        kind, env = guidances.resolve(self.guidance), subject.env
        if not kind.asks:
            raise UserError(f"guidance {kind.name!r} asks no questions, so nothing is learned: choose another kind")
        if subject.changes is not None and not kind.by_evidence:
            raise UserError(f"changes is given, but guidance {kind.name!r} does not use it: give guidance reading")
        guidance = guidances.make(kind.name, self.sizes, env, self.kinds.get(kind.name))
        shared = guidance, self.sizes, self.scalars, env, subject.bases
        if not kind.by_evidence:
            return Adaptation(*shared)
        if subject.changes is None:
            return ReadingAdaptation(*shared, declared_distortions(env))
        family = changes.family_of(subject.changes, env)
        changes.check_acts(family, env)
        return ReadingAdaptation(*shared, family, subject.changes_reference)

    def _labels(self, subject: Subject, guidance: Guide, grid: Grid) -> label_files.LabelFile | None:
        """Return the labels in place of questions; None: there are none. Raises UserError if they do not fit."""
        check_grid(grid, adapts=True)
        if guidance.by_evidence and (least := min(grid.labels)) < by_reading.LEAST:
            raise UserError(f"labels is {least}: give at least {by_reading.LEAST}, since each is predicted first")
        if (rows := subject.rows) is not None:
            spaces, form = spaces_of(subject.env), guidance.form
            assert form is not None  # a kind that asks has a form
            external_labels.check(rows, spaces, form)
            return label_files.LabelFile({}, form.name, spaces.actions, None, np.zeros(len(rows.obs), int), rows)
        if self.labels_from is None:
            return None
        return read_labels(self.labels_from, subject.task, self.task, self.sizes, self.scalars, grid)

    def _bounds(self, subject: Subject, guidance: Guide, file: label_files.LabelFile | None) -> tuple[float, ...]:
        """Return the bounds of corrections, in the space's unit. Raises UserError for those that nothing can reach."""
        space = actions_of(subject.env)
        if self.bound_deg:
            bounds = self.bound_deg
        elif guidance.by_evidence:
            bounds = (space.reach,)
        elif file is None:
            bounds = (max(by_model.BOUND * space.reach, space.grain),)
        elif lanes_in(subject.bases) is not None:
            raise UserError("the labels of several base policies differ in their largest change: give --bound-deg")
        else:
            reach = by_model.reach(space, subject.bases.policy, file.labels.obs, file.labels.action)
            bounds = (max(reach, self.scalars.eps_deg),)
        by_model.check_amounts(space, bounds, self.scalars, tries=not guidance.by_evidence)
        return bounds

    def _judging(self, subject: Subject, lanes: int) -> Judging:
        """Return how policies are judged. Raises UserError for invalid settings."""
        by, task, shares, env, pictures = self.judge_by, subject.task, self.judge_bounds, None, None
        if self.judge_episodes < 1:
            raise UserError(f"judge_episodes is {self.judge_episodes}: give a number from 1")
        if not all(0 < share < 1 for share in shares):
            text = " ".join(f"{share:g}" for share in shares)
            raise UserError(f"judge_bounds is {text}: give shares of the bound above 0 and below 1")
        if shares and by in (LABELS, PERSON):
            raise UserError("judge_bounds needs episodes to be tried on: give --judge-by a metric of the task")
        step = judging.step_of(subject.env)
        if by not in (names := ["reward", *step.metrics, *step.outcome, LABELS, PERSON]):
            raise UserError(f"judge_by is {by!r}, which is not a metric of {task.name}{suggestion(by, names)}")
        if by in task.less_is_better:
            raise UserError(f"judge_by is {by!r}, of which less is better: give one of which more is, as reward")
        if by != LABELS:
            env = task.environment(self.task, judging.SPLIT)
        if by == PERSON:
            if subject.prefer is None:
                raise UserError("judge_by is person: give judge_by= a function that compares two films")
            if lanes > 1:
                raise UserError("a person judges one policy: give one seed, one number of labels and one bound")
            pictures = task.pictures("judge by a metric")
            if pictures.check is not None:
                pictures.check(env)
        steps = task.longest(self.task) if task.longest else judging.STEPS
        return Judging(env, self.judge_episodes, steps, by, subject.prefer, pictures, shares)


class AdaptedStudy(NamedTuple):
    """The result of an adaptation, with its subject and its request."""

    result: AdaptationResult
    subject: Subject
    request: AdaptRequest

    def write(self, place: Place) -> None:
        """Write the policy folder. Raises UserError if the policy cannot be kept."""
        path, task, world = self.request.labels_from, self.subject.task, self.request.task
        inputs = {"labels_from": f"{path.stem} {label_files.digest(path)}" if path else None, "robot": task.robot}
        adapted.write(place, self.result, task, world, self.subject.origin, inputs)
