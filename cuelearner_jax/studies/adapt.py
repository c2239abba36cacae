"""Adaptation as one request, filled alike by the command line and Python; applies the rules of scenarios.

request = suggested(source, scenario="rooms")    # the defaults
found = run(Subject(source), replace(request, labels=(250,)))
with policy_folders.place_of(out) as place:
    found.write(place)
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Generic, NamedTuple, TypeVar

import numpy as np

from cuelearner_jax import user_code
from cuelearner_jax.adaptation import by_model, by_reading, changes, judging, serialization
from cuelearner_jax.adaptation.by_model import AdaptationResult
from cuelearner_jax.adaptation.by_reading import ReadingAdaptation
from cuelearner_jax.adaptation.judging import Judging
from cuelearner_jax.adaptation.lanes import Adaptation, begin, one_each, product, side_by_side
from cuelearner_jax.asking import label_slots
from cuelearner_jax.config import GuideSizes, Scalars, check_guide, check_part
from cuelearner_jax.devices import release_programs
from cuelearner_jax.environment import Environment, actions_of, spaces_of
from cuelearner_jax.errors import UserError, suggestion
from cuelearner_jax.evaluate import Tell, ignore_progress
from cuelearner_jax.feedback import external_labels
from cuelearner_jax.feedback.answers import check_teacher
from cuelearner_jax.guides import registry as guidances
from cuelearner_jax.guides.base import Guide
from cuelearner_jax.guides.reading import KIND
from cuelearner_jax.policies import Common, lanes_in, policy_of
from cuelearner_jax.reading.families import declared_distortions
from cuelearner_jax.reading.policy import unread
from cuelearner_jax.runs import adapted, trained
from cuelearner_jax.runs.grid import Grid, check_grid, seeds_of
from cuelearner_jax.runs.order import read_labels
from cuelearner_jax.runs.trained import PolicySource
from cuelearner_jax.storage import label_files
from cuelearner_jax.storage.whole import Place
from cuelearner_jax.task import Scenario, Task
from cuelearner_jax.terminal import console
from cuelearner_jax.types import Label, Teacher

TaskT = TypeVar("TaskT")
KindsT = TypeVar("KindsT")

MOST_ENVS = 100_000  # more do not fit into memory
AS_IT_IS = Scenario("the world as it is", {})


@dataclass(frozen=True)
class BaseLanes:
    """Choice of the lanes of the folder to adapt."""

    policy: str = "agent"
    """Which of its policies."""
    guidance: str | None = None
    """Kind of guidance of the lanes to adapt (default: the run's last)."""
    labels: int | None = None
    """Label budget of the lanes to adapt (default: the largest)."""
    bound_deg: float | None = None
    """Bound of the lanes to adapt, for a policy folder (default: the largest) [deg]."""
    seeds: tuple[int, ...] = ()
    """Seeds of the lanes to adapt, each with labels of its own (default: the first lane)."""


@dataclass(frozen=True, kw_only=True)
class AdaptRequest(Generic[TaskT, KindsT]):
    """A request to adapt a policy."""

    task: TaskT
    labels: tuple[int, ...] = (500,)
    """Label budgets (default with --labels-from: all labels in the file)."""
    bound_deg: tuple[float, ...] = ()
    """How far corrections may lead from the policy's own actions [deg]. One bound or several (default: the scenario's,
    as far as the labels of a file reach, or else a quarter of the space's reach, 45)."""
    seeds: int = 1
    """Number of seeds. Several base policies are each adapted with their own seed, so leave this out then."""
    first_seed: int = 0
    """First seed; the others count up from it."""
    guidance: str = KIND.name
    """Kind of guidance: what is asked, and what a model makes of the answers."""
    scenario: str | None = None
    """A changed world, by its name. Options of the task (--task.…) come on top of it."""
    robot: str | None = None
    """Another robot, by its name (default: the task's own). With a folder, as anymal:FOLDER: one with your own walking
    policy."""
    labels_from: Path | None = None
    """Label file to use instead of asking the teacher."""
    judge_by: str = "reward"
    """What decides whether the correction is used: a metric on tuning episodes, or held-out answers (labels). A model
    that is not shown to make the policy better is not used."""
    judge_episodes: int = 50
    """Largest number of tuning episodes for judging a policy; 100 steps each where the task counts steps."""
    judge_every: int = 0
    """Measure the policy each time this many labels are new, into guide.parquet (0: only at the end)."""
    judge_bounds: tuple[float, ...] = ()
    """Also try the model within these shares of its bound, for instance 0.5 0.25, and use the bound that scores best on
    the tuning episodes."""
    sizes: GuideSizes = by_model.SIZES
    scalars: Scalars = field(default_factory=Scalars)
    kinds: KindsT = field(default_factory=dict)  # pyright: ignore[reportAssignmentType]
    """Options of kinds of guidance, by the kind's name."""


class Subject(NamedTuple):
    """The policy to adapt, and who answers."""

    source: PolicySource  # gives the task that acts, and the configuration of the policies' training
    base: BaseLanes = BaseLanes()  # which of the source's policies
    policy: Any = None  # a policy in place of one of the source's; None: use the source's
    named: str | None = None  # package.module:NAME of the code of `policy`, or of the code in the source's folder
    teacher: Teacher | None = None  # None: the task's teacher
    rows: Label | None = None  # labels (labels, ...) in place of questions; None: ask
    changes: Any = None  # what may have changed, as `changes.family_of` takes it; None: what the world declares
    changes_named: str = "code"  # package.module:NAME of `changes`


class AdaptedStudy(NamedTuple):
    """The result of an adaptation, with its request."""

    found: AdaptationResult
    subject: Subject
    request: AdaptRequest
    origin: dict[str, Any]  # the base policies, in plain values

    def write(self, place: Place) -> None:
        """Write the policy folder. Raises UserError if the policy cannot be kept."""
        path = self.request.labels_from
        used = {"labels_from": f"{path.name} {label_files.digest(path)}" if path else None, "robot": self.request.robot}
        adapted.write(place, self.found, self.subject.source.task, self.request.task, self.origin, used)


def suggested(
    source: PolicySource,
    scenario: str | None = None,
    guidance: str | None = None,
    judge_by: str | None = None,
    labels_from: Path | None = None,
    eps_deg: float | None = None,
    sizes: GuideSizes | None = None,
    scalars: Scalars | None = None,
) -> AdaptRequest:
    """Return the default request; the only place where the rules of scenarios are applied.

    Args:
        source: the origin of the policy to adapt; the model uses the frame and scalars of its training.
        scenario: the changed world. Its suggestions apply to the kind of guidance that it suggests, and its shares of
            a bound to judging on episodes.
        guidance, judge_by: the chosen values; None: as the scenario suggests, or the general default.
        labels_from: a label file, which determines budget and strength of answers.
        eps_deg: strength of an answer [deg]; None: the file's, that of given scalars, the scenario's, or the source's.
        sizes, scalars: complete values in place of the defaults.

    Raises:
        UserError: there is no such scenario or label file.
    """
    rules = source.task.scenario(scenario) if scenario else AS_IT_IS
    kind = guidances.resolve(guidance or rules.guidance or AdaptRequest.guidance)
    if kind.name != rules.guidance:
        rules = replace(rules, guidance=None, sizes={}, scalars={}, options={})  # these apply to the suggested kind
        if kind.by_evidence:
            rules = replace(rules, bound_deg=None, judge_by=None, judge_bounds=())
    if judge_by == judging.LABELS:
        rules = replace(rules, judge_bounds=())  # these need episodes to be tried on
    labels = (by_reading.USUAL,) if kind.by_evidence else AdaptRequest.labels
    if labels_from is not None:
        file = label_files.read(labels_from)
        eps_deg = file.eps if eps_deg is None else eps_deg
        labels = (file.budget,)
    frame, settling = {"frame": source.config.sizes.frame}, by_model.settling
    if kind.by_evidence:
        frame, settling = {}, by_reading.settling
    sizes = sizes or replace(by_model.SIZES, **{**frame, **rules.sizes})
    if scalars is None:
        eps_deg = rules.eps_deg if eps_deg is None else eps_deg
        scalars = replace(settling(source.config.scalars, eps_deg), **rules.scalars)
    elif kind.by_evidence:
        scalars = scalars if eps_deg is None else replace(scalars, eps_deg=eps_deg)
    else:
        scalars = settling(scalars, eps_deg)
    by = judging.LABELS if kind.by_evidence else source.task.judge_by(source.config.task)
    own = source.config.kinds.get(kind.name) or (kind.config and kind.config())
    return AdaptRequest(
        task=rules.apply(source.config.task),
        labels=labels,
        bound_deg=() if rules.bound_deg is None else (rules.bound_deg,),
        guidance=guidance or rules.guidance or AdaptRequest.guidance,
        scenario=scenario,
        labels_from=labels_from,
        judge_by=judge_by or rules.judge_by or by,
        judge_bounds=rules.judge_bounds,
        sizes=sizes,
        scalars=scalars,
        kinds={kind.name: replace(own, **rules.options)} if own else {},
    )


def reads_evidence(request: AdaptRequest[Any, Any]) -> bool:
    """Return whether answers are read as evidence of what changed, see `by_reading`."""
    return guidances.resolve(request.guidance).by_evidence


def run(
    subject: Subject,
    request: AdaptRequest,
    watch: Callable[[str], Tell] = lambda what: ignore_progress,
    note: Callable[[str], None] = console.print,
) -> AdaptedStudy:
    """Check a request and adapt; nothing is written. Raises UserError for an invalid or impossible request.

    `watch`: given the name of a step, returns the function that reports its progress. `note`: called with warnings.
    """
    release_programs()
    task, sizes, scalars = subject.source.task, request.sizes, request.scalars
    check_guide(sizes, scalars)
    kind = guidances.resolve(request.guidance)
    if not kind.asks:
        raise UserError(
            f"guidance {kind.name!r} asks no questions, so there is nothing to learn from: choose another kind"
        )
    if subject.changes is not None and not kind.by_evidence:
        raise UserError(f"changes is given, but guidance {kind.name!r} does not use it: give guidance reading")
    if kind.by_evidence:
        by_reading.check_unused(sizes, scalars, judge_bounds=request.judge_bounds)
    env = task.environment(request.task)
    for name, options in request.kinds.items():
        check_part(options, name)
    guidance = guidances.make(kind.name, sizes, env, request.kinds.get(kind.name))
    bases, seeds, origin = _bases(subject, request, env)
    shared = lanes_in(bases) is None
    if not shared and (request.seeds, request.first_seed) != (1, 0):
        raise UserError("several base policies are adapted each with its own seed: leave out --seeds and --first-seed")
    seeds = seeds_of(request.first_seed, request.seeds) if shared else seeds
    rows, request = _rows(subject, request, guidance, env, bases, seeds)
    if not kind.by_evidence and (note_of := by_model.check_amounts(actions_of(env), request.bound_deg, scalars)):
        note(note_of)
    varied = seeds, request.labels, request.bound_deg
    lanes = product(1, *varied) if shared else one_each(*varied)
    how = _judging(task, request, env)
    teacher = None
    if rows is None:
        teacher = subject.teacher or task.make_teacher(request.task, env, questions=int(lanes.budget.sum()))
        check_teacher(teacher, scalars)
    if rows is not None:
        rows = label_files.for_lanes(rows, lanes.seed, lanes.budget, label_slots(int(lanes.budget.max()), sizes))
    kept = subject.policy is None or subject.named  # written to a folder
    if kind.by_evidence:
        of = ReadingAdaptation(guidance, sizes, scalars, env, bases, *_family(subject, env))
        if kept:
            serialization.to_json(unread(bases, actions_of(env), of.family, env.obs_size))
        found = by_reading.adapt(of, lanes, how, teacher, rows, watch)
    else:
        of = Adaptation(guidance, sizes, scalars, env, bases)
        if kept:
            serialization.to_json(of.policy(begin(of, lanes)))
        found = by_model.adapt(of, lanes, how, teacher, rows, watch=watch)
    return AdaptedStudy(found, subject, request, origin)


def _family(subject: Subject, env: Environment) -> tuple[Any, str]:
    """Return what may have changed, and the name of its code. Raises UserError if the two do not fit."""
    if subject.changes is None:
        return declared_distortions(env), ""
    family = changes.family_of(subject.changes, env)
    changes.check_acts(family, env)
    return family, subject.changes_named


def _bases(subject: Subject, request: AdaptRequest, env: Any) -> tuple[Any, tuple[int, ...], dict[str, Any]]:
    """Return the base policies, their seeds, and their origin in plain values."""
    source, base, named = subject.source, subject.base, subject.named
    if subject.policy is not None:
        if base != BaseLanes(policy=source.default_policy):
            raise UserError(f"--base.… chooses among the lanes of a folder, but {named} is not a folder: leave it out")
        policy = policy_of(subject.policy, actions_of(env))
        user_code.acts_in(named or "policy", policy, env)
        return Common(policy), (0,), {"code": named}
    source.check(base.policy, request.task, base.guidance)
    if trained.POLICIES[base.policy].taught:
        raise UserError(f"policy {base.policy!r} asks the teacher, so there is nothing to adapt: choose another")
    if len(set(base.seeds)) < len(base.seeds):
        raise UserError("--base.seeds: give each seed once")
    policies, seeds = trained.several(
        source, request.task, base.policy, base.guidance, base.labels, base.seeds, base.bound_deg, env
    )
    told = {name: value for name, value in dataclasses.asdict(base).items() if value not in (None, ())}
    origin = {"folder": source.folder.name, **told, "seeds": list(seeds), **({"code": named} if named else {})}
    return Common(policies[0]) if len(policies) == 1 else side_by_side(policies), seeds, origin


def _rows(
    subject: Subject, request: AdaptRequest, guidance: Guide, env: Environment, bases: Any, seeds: tuple[int, ...]
) -> tuple[label_files.LabelFile | None, AdaptRequest]:
    """Return the labels used in place of questions (None: none), and the request with the labels' budgets and bounds.

    Raises UserError for labels that do not fit.
    """
    task, path, rows, space = subject.source.task, request.labels_from, subject.rows, actions_of(env)
    grid = Grid((guidance.name,), seeds, request.labels)
    check_grid(grid, adapts=True)
    if guidance.kind.by_evidence:
        if (least := min(request.labels)) < by_reading.LEAST:
            raise UserError(f"labels is {least}: give at least {by_reading.LEAST}, since each is predicted first")
        request = replace(request, bound_deg=request.bound_deg or (space.reach,))
    file, form = None, guidance.form
    assert form is not None  # a kind that asks has a form
    if path is not None:
        file = read_labels(path, task, request.task, request.sizes, request.scalars, grid)
    elif rows is not None:
        external_labels.check(rows, spaces_of(env), form)
        request = replace(request, labels=(len(rows.obs),))
        eps = request.scalars.eps_deg if form.by_eps else None
        file = label_files.LabelFile({}, form.name, space, eps, np.full(len(rows.obs), seeds[0]), rows)
    if request.bound_deg:
        return file, request
    widest = by_model.usual_bound(space)
    if file is not None:
        if lanes_in(bases) is not None:
            raise UserError("the labels of several base policies differ in their largest change: give --bound-deg")
        reach = by_model.reach(space, bases.policy, file.labels.obs, file.labels.action)
        widest = max(reach, request.scalars.eps_deg)
    return file, replace(request, bound_deg=(widest,))


def _judging(task: Task, request: AdaptRequest, env: Environment) -> Judging:
    """Return how policies are judged. Raises UserError for invalid settings."""
    by, envs, unit = request.judge_by, request.judge_episodes, request.sizes.labels_per_round
    if not 1 <= envs <= MOST_ENVS:
        raise UserError(f"judge_episodes is {envs}: give a number from 1 to {MOST_ENVS:,}")
    if request.judge_every < 0 or request.judge_every % unit:
        raise UserError(f"judge_every is {request.judge_every}: give a multiple of sizes.labels_per_round ({unit})")
    judging.check_bounds(request.judge_bounds, by)
    known = [*judging.metrics_of(env), judging.LABELS]
    if by not in known:
        raise UserError(f"judge_by is {by!r}, which is not a metric of {task.name}{suggestion(by, known)}")
    steps = task.longest(request.task) if task.longest else judging.STEPS
    plays = by != judging.LABELS or request.judge_every
    tuned = task.environment(request.task, "tuning") if plays else None
    return Judging(tuned, envs, steps, by, request.judge_every, bounds=request.judge_bounds)


def _worth(difference: np.ndarray, steps: np.ndarray) -> str:
    """Describe differences (lanes, 3) and rewarded steps (lanes,): one with its interval, or how many exclude 0."""
    count, told = len(steps), f"{int(np.mean(steps)):,} rewarded steps"
    if count > 1:
        above = int((difference[:, 1] > 0).sum())
        return f"the difference's 95% interval lies above 0 in {above} of {count} lanes; {told} a lane"
    ((estimate, lower, upper),) = difference
    zero = ", which includes 0" if lower <= 0 <= upper else ""
    return f"difference {estimate:+.3g} [{lower:+.3g}, {upper:+.3g}]{zero}; {told}"


def sentences(found: AdaptationResult) -> list[str]:
    """Describe an adaptation's result, one line per budget and bound."""
    if found.results:
        return by_reading.sentences(found)
    lanes, judged, lines = found.lanes, found.judged, []
    unit = actions_of(found.of.env).unit
    for bound, budget in sorted({*zip(lanes.bound_deg.tolist(), lanes.budget.tolist(), strict=True)}):
        own = (lanes.bound_deg == bound) & (lanes.budget == budget)
        before, after = (f"{float(np.mean(values[own])):.4g}" for values in (judged.before, judged.after))
        if judged.by == judging.LABELS:
            worth, worse = f"predicts {after} of held-out answers, always 'already right' {before}", "fewer than that"
        else:
            worth, worse = f"{judged.by} on tuning episodes {before} before, {after} after", "not shown to be better"
            worth += f" ({_worth(judged.difference[own], judged.rewarded_steps[own])})"
        lines.append(f"{budget} labels within {bound:g} {unit}: {worth}")
        if narrowed := sorted(
            {*judged.within_deg[own & judged.used].astype(float).round(3).tolist()} - {round(bound, 3)}
        ):
            lines[-1] += f", used within {' or '.join(f'{angle:g}' for angle in narrowed)} {unit}"
        left = lanes.seed[own & ~judged.used]
        if len(left):
            which = f"seed {left[0]}" if len(left) == 1 else f"{len(left)} of {int(own.sum())} seeds"
            lines[-1] += f"; {which}: {worse}, so the model is not used and the policy stays unchanged"
    return lines
