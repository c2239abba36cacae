"""`cuelearner label`."""

from __future__ import annotations

import dataclasses
import os
import shlex
import webbrowser
from argparse import Namespace
from dataclasses import dataclass, field
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import Annotated, Any, Literal

import jax
import tyro

from cuelearner_jax import config as configuration
from cuelearner_jax.adaptation import changes
from cuelearner_jax.adaptation.by_model import check_amounts
from cuelearner_jax.cli.options import Flag, NewWorld, Word, about, as_options, check_numbers, look_ahead_of, out, parse
from cuelearner_jax.cli.sources import code_of, is_code, preset_of, recorded_or_task, source_in, with_cues
from cuelearner_jax.cli.train import asking_kind
from cuelearner_jax.config import GuideScalars, GuideSizes
from cuelearner_jax.environment import PROPOSED, actions_of, offers
from cuelearner_jax.errors import UserError
from cuelearner_jax.feedback.answers import RELATIVE
from cuelearner_jax.guides import registry as guidances
from cuelearner_jax.guides.base import Guide, ReadingGuide
from cuelearner_jax.labelling import controls
from cuelearner_jax.labelling.plan import Base, SessionPlan
from cuelearner_jax.policies import NearAims, policy_of, uniform_in
from cuelearner_jax.reading.families import declared_distortions
from cuelearner_jax.run_config import RunConfig
from cuelearner_jax.runs.grid import LARGEST_SEED
from cuelearner_jax.runs.policy_sources import LaneChoice, PolicySource
from cuelearner_jax.spaces import Space
from cuelearner_jax.storage import label_files
from cuelearner_jax.storage.folders import claimed
from cuelearner_jax.studies.adapt import AdaptRequest
from cuelearner_jax.studies.train import preset_kinds
from cuelearner_jax.task import PAPER, QUICKSTART, Preset, Task, shape_of
from cuelearner_jax.tasks import logs, shipped
from cuelearner_jax.terminal import Interrupted, console, interruptible

UNIFORM, NEAR_AIMS = "uniform", "near_aims"
REACH = 1.5  # distance of questions from an aim, in turns by eps
MOST_LABELS = 100_000
UNDRAWN = "the page has nothing to show; give its Body `pictures` with a `sketch`, or choose another --robot"


@dataclass(frozen=True, kw_only=True)
class LabelOptions(NewWorld):
    """Label actions in a browser: uniform ones, a policy's, or recorded ones.

    Name a policy after the task: a run folder, a policy folder, or package.module:NAME of a function of observations.
    In place of a task, a folder of recorded situations may be named: its recorded actions are asked about."""

    policy: Annotated[Word, tyro.conf.arg(metavar="POLICY")] = None
    """Policy to ask about: a run folder, a policy folder, a shipped agent, or package.module:NAME of a function."""
    sizes: GuideSizes = field(default_factory=GuideSizes)
    scalars: GuideScalars = field(default_factory=GuideScalars)
    out: Path = Path("labels/NAME")
    """Folder for the labels. A folder with labels of this session is continued."""
    labels: int = 500
    """Number of answers to collect; to continue later, give more (about a policy: as many as `adapt` asks for)."""
    guidance: str = ""
    """Kind of guidance that is fitted while you label; it determines the form of the answers."""
    who: str = "anonymous"
    """Your name, recorded with each label."""
    seed: int = 0
    """Seed of the situations and of the labels."""
    cues: str = ""
    """Words for more and less of each entry of an action, such as "left,right;up,down" (default: the task's)."""
    one_cue: Flag[bool] = False
    """With several cues: one press about one cue is the whole answer; nothing is said of the others."""
    bound_deg: Annotated[float | None, tyro.conf.arg(aliases=("--bound",))] = None
    """Largest distance of the questions from the policy's own actions [deg] (default: the scenario's bound, or no
    bound)."""
    again: Path | None = None
    """Ask the questions of this page's file again, for a second opinion. Leave out the policy and --seed then."""
    questions: Literal["uniform", "near_aims", "proposed"] = UNIFORM
    """Actions to ask about without a policy: uniform ones, ones near the task's aims (where it has aims), or those
    that a recording proposes."""
    port: int = 0
    """Port on 127.0.0.1 (0: any free port)."""
    open: Flag[bool] = False
    """Open the page in a browser of this machine."""
    base: LaneChoice = field(default_factory=LaneChoice)


def run(arguments: list[str]) -> None:
    """Run the command. Raises UserError for bad input or a port or folder in use; Interrupted once all is saved."""
    server = page_module("server")
    ahead = look_ahead_of(arguments, "label", LabelOptions)
    task = recorded_or_task(ahead)
    policy = ahead.words[1] if len(ahead.words) > 1 else None
    usual = QUICKSTART if policy is None and task.proposed is None else PAPER
    name, preset = preset_of(task, ahead.preset, usual)
    source = None
    if policy is not None and not is_code(policy):
        base = None if ahead.base is None else code_of(ahead.base)
        source = source_in(shipped.folder_of(policy), task, base, ahead.changes)
    elif ahead.base is not None:
        raise UserError("--base names the code in a policy folder: give that folder, or leave it out")
    default = _defaults(task, preset, source, ahead, policy)
    options = parse(LabelOptions, arguments, "label", default, about(LabelOptions, task, preset=usual))
    plan = make_plan(task, preset.config, options, source)
    config = preset.config if source is None else dataclasses.replace(preset.config, task=default.task)
    again = shlex.join(["cuelearner", "label", *arguments])
    commands = server.Commands(again, partial(_following, task, name, config, options))
    # The port comes first, so that nothing has been written where it is refused.
    with server.bind(options.port) as port, claimed(options.out), interruptible("the answer of the moment") as stopping:
        ending = _serve(server, plan, options, port, stopping, commands)
    if ending is None:
        raise Interrupted(f"stopped; every answer is in {options.out}: repeat the same command to continue")
    out.print(f"done: {ending.line}\nnext: {ending.following}")


def _defaults(
    task: Task, preset: Preset, source: PolicySource | None, ahead: Namespace, policy: str | None
) -> LabelOptions:
    """Return the default options; labels that are to correct a policy are asked for as `adapt` corrects it.

    Those of a second opinion are the first one's.
    """
    config, again = source.config if source else preset.config, ahead.again and label_files.read(Path(ahead.again))
    reads = policy is not None or (not again and _has_proposals(task, config.task))
    kind = ReadingGuide.name if reads else asking_kind(preset_kinds(task, preset))
    adapts = policy is not None or task.proposed is not None
    usual = PROPOSED if task.proposed is not None else NEAR_AIMS if task.near_aims else UNIFORM
    request = AdaptRequest.of(task, config, ahead.scenario, ahead.guidance[0] if ahead.guidance else kind)
    here = {"path": task.plain().path} if task.name == logs.NAME else {}  # of the recording, wherever it lay before
    world = configuration.from_json(task.config, again.task | here) if again else request.task
    scalars = _values(GuideScalars, (request if adapts else config).scalars)
    scalars |= {"eps_deg": again.eps} if again and again.eps is not None else {}
    return LabelOptions(
        task=world if ahead.cues is None else with_cues(task, world, ahead.cues),
        sizes=GuideSizes(**_values(GuideSizes, (request if adapts else config).sizes)),
        scalars=GuideScalars(**scalars),
        out=Path("labels") / task.name,
        guidance=kind,
        bound_deg=next(iter(request.bound_deg), None) if adapts else None,
        labels=max(preset.labels) if policy is None else request.labels[0],
        questions=usual if policy is None else UNIFORM,
    )


def make_plan(task: Task, config: RunConfig, options: LabelOptions, source: PolicySource | None = None) -> SessionPlan:
    """Return the plan of the session. Raises UserError for an invalid request."""
    settings = dataclasses.replace(
        config,
        task=options.task,
        sizes=dataclasses.replace(config.sizes, **dataclasses.asdict(options.sizes)),
        scalars=dataclasses.replace(config.scalars, **dataclasses.asdict(options.scalars)),
    )
    configuration.check_guide(settings.sizes, settings.scalars)
    check_numbers(options, labels=(1, MOST_LABELS), seed=(0, LARGEST_SEED - 1), port=(0, 65535))
    if settings.sizes.candidates > 1:
        raise UserError("--sizes.candidates is above 1, but the page takes situations as they come: leave it out")
    usual, task = task.bodies[0].name, task.on(options.robot or (source and source.task.robot) or None)
    body = task.bodies[0]
    if task.pictures(UNDRAWN).sketch is None:
        raise UserError(f"{task.name} has no sketch of a situation: {UNDRAWN}")
    env = shape_of(task, options.task)
    if options.bound_deg is not None:
        check_amounts(actions_of(env), (options.bound_deg,), None)
    guidance = settings.guide_in(env, guidances.kind_name(options.guidance))
    _check_guidance(guidance, task, options, actions_of(env))
    family: Any = ()
    if guidance.by_evidence:
        path = options.changes
        family = declared_distortions(env) if path is None else changes.family_of(changes.load(path), env)
    plan = SessionPlan(
        task,
        settings,
        guidance,
        _base(task, options, source, env) if options.again is None else Base(uniform_in(env), ""),
        labels=options.labels,
        seed=options.seed,
        who=options.who.strip(),
        bound_deg=options.bound_deg,
        robot="" if body.name == usual else f"{body.name} {body.digest}".strip(),
        family=family,
        one_cue=options.one_cue,
    )
    return plan if options.again is None else _second(plan, options, options.again)


def _check_guidance(guidance: Guide, task: Task, options: LabelOptions, space: Space) -> None:
    """Raise UserError for guidance that a page cannot collect answers for."""
    if guidance.form is None or guidance.sees_base:
        asking = [kind.name for kind in guidances.guides().values() if kind.asks and not kind.sees_base]
        raise UserError(f"guidance {guidance.name!r} asks for no labels: give --guidance {' or '.join(asking)}")
    controls.check(guidance.form, space)
    if options.one_cue and not (guidance.form.by_eps and len(space.cues) > 1):
        raise UserError("--one-cue is for relative answers about several cues: leave it out")
    if guidance.by_evidence:
        has_proposals = options.questions == PROPOSED and _has_proposals(task, options.task)
        if (options.policy is None and not has_proposals) or options.again is not None:
            raise UserError("guidance reading asks about a policy: name one after the task, and leave out --again")


def _has_proposals(task: Task, config: Any) -> bool:
    """Return whether observations hold the action that a policy elsewhere proposes."""
    return any(part.kind == PROPOSED for part in getattr(shape_of(task, config), "observation", ()))


def _second(plan: SessionPlan, options: LabelOptions, path: Path) -> SessionPlan:
    """Return a plan with the questions of another page's file. Raises UserError if they are not of this world."""
    file = label_files.read(path)
    if file.session is None or file.people is None:
        raise UserError(f"{path} was not written by the labelling page: its questions cannot be asked again")
    if options.policy is not None or options.seed or options.bound_deg is not None:
        raise UserError("--again repeats another page's questions: leave out the policy, --seed and --bound-deg")
    world = file.task | {"robot": file.session.get("robot", ""), "answers": file.answers, "eps": file.eps}
    for name, value in (plan.world | {"robot": plan.robot, "answers": plan.form.name, "eps": plan.eps}).items():
        is_place = name == "path" and plan.task.name == logs.NAME  # a recording may lie elsewhere
        if not is_place and (before := world.get(name)) != value:
            raise UserError(f"{path} asked in a world with another {name} ({before!r}, not {value!r}): give the same")
    place = label_files.found_in(path)
    assert place is not None  # the file was read above
    again = tuple(row for _, row in sorted({row["item"]: row for row in label_files.history(place)}.items()))
    base = plan.base._replace(name=f"{file.session['base']} {file.session['base_digest']}".strip())
    count, seed, digest = min(plan.labels, len(again)), int(file.session["seed"]), label_files.digest(path)
    return dataclasses.replace(plan, base=base, seed=seed, labels=count, again=again, again_of=digest)


def _base(task: Task, options: LabelOptions, source: PolicySource | None, env: Any) -> Base:
    """Return the policy to ask about. Raises UserError if it is not available, or needs other observations."""
    lane, policy, questions = options.base, options.policy, options.questions
    if policy is not None and questions != UNIFORM:
        raise UserError(f"--questions is {questions}, but the questions are about {policy}: leave out one of them")
    if source is not None:
        name = lane.name_in(source, options.task)
        return Base(lane.lane_in(source, options.task)[0], f"{source.folder.resolve().name}, {name}")
    if lane != LaneChoice():
        raise UserError("--base.… chooses a folder's lane, but no folder is given: leave it out")
    if policy is not None:
        return Base(policy_of(code_of(policy), actions_of(env)), policy)
    if questions == UNIFORM:
        return Base(uniform_in(env), UNIFORM)
    if questions == PROPOSED:
        if task.proposed is None:
            raise UserError(f"--questions is {PROPOSED}, but {task.name} is not a recording: give {UNIFORM}")
        return Base(task.proposed(task.environment(options.task)), PROPOSED)
    if not offers(env, "aims"):
        raise UserError(f"--questions is {NEAR_AIMS}, but {task.name} has no aims in this world: give {UNIFORM}")
    reach = float(actions_of(env).from_unit(REACH * options.scalars.eps_deg))
    return Base(NearAims(task.view(options.task), reach), NEAR_AIMS)


def page_module(name: str) -> Any:
    """Import a module of `labelling` that serves a page. Raises UserError if its packages are not installed."""
    try:
        module = import_module(f"cuelearner_jax.labelling.{name}")
    except ImportError as error:
        advice = "run `make setup`, or pip install -c constraints.txt -e '.[label]' in the project's folder"
        raise UserError(f"the page needs packages that are not installed ({error.name}): {advice}") from error
    # Set before JAX starts: each thread's computations run in that thread, at its priority (`learner`).
    jax.config.update("jax_cpu_enable_async_dispatch", False)
    return module


def _serve(server: Any, plan: SessionPlan, options: LabelOptions, port: Any, stopping: Any, commands: Any) -> Any:
    """Serves a session until it is finished (returns how, an `Ending`) or stopped (None)."""
    from cuelearner_jax.labelling.session import Record, Session

    Record(plan, options.out).close()  # refuses the file of another session before anything is compiled
    leads_there = options.out / "open.html"  # command lines, unlike this file, can be read by every user of the machine

    def open_page(address: str) -> None:
        out.print(f"open {address}")
        if options.open:
            leads_there.unlink(missing_ok=True)
            with os.fdopen(os.open(leads_there, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "w") as file:
                file.write(f'<!doctype html><meta http-equiv="refresh" content="0; url={address}">\n')
            webbrowser.open(leads_there.absolute().as_uri())

    make = partial(Session, plan, options.out, lambda words: console.print(f"{words} ..."))
    try:
        return server.serve(make, f"label {plan.task.name}", port, stopping, open_page, commands)
    finally:
        leads_there.unlink(missing_ok=True)


def _following(task: Task, preset: str, config: RunConfig, options: LabelOptions, labels: int) -> str:
    """Return the command that uses the labels: `train` for labels of uniform actions, `adapt` for a policy's.

    `config`: the preset's configuration.
    """
    name, out, policy = task.origin or task.command_name or task.name, str(options.out), options.policy
    bound = [] if options.bound_deg is None else ["--bound-deg", f"{options.bound_deg:g}"]
    if options.again is not None:
        return shlex.join(["cuelearner", "labels", "inspect", str(options.again), out])
    if policy is None and options.questions == PROPOSED and _has_proposals(task, options.task):
        return shlex.join(["cuelearner", "adapt", "--labels-from", out, *bound, "--out", f"policies/{Path(out).name}"])
    is_recorded = task.name == logs.NAME
    if is_recorded and guidances.resolve(options.guidance).form is not RELATIVE:  # no command adapts to these
        return shlex.join(["cuelearner", "labels", "inspect", out])
    if policy is None and (options.questions == PROPOSED or is_recorded):
        return f'cl.correct(policy, "{out}")  # in Python, after: import cuelearner_jax as cl'
    if policy is None:
        words, place, again = ["train", name, "--preset", preset], "runs", ("robot",)
        parts = {"task": task.config, "sizes": GuideSizes, "scalars": GuideScalars}
    else:
        is_folder = shipped.is_shipped(policy) or Path(policy).is_dir()
        words, place, again = ["adapt", policy], "policies", ("preset", "scenario", "robot", "changes")
        words += [] if is_recorded or (is_folder and ":" not in name) else ["--task", name]
        words += ["--base", options.code] if options.code else []
        lane = {key: value for key, value in vars(options.base).items() if value not in (None, ())}
        words += as_options("base", lane)
        parts = {} if is_recorded else {"task": task.config}  # labels hold the world of a recording
    words += [word for option in again if (value := getattr(options, option)) for word in (f"--{option}", value)]
    words += ["--guidance", options.guidance, "--labels-from", out, "--labels", str(labels)]
    words += [] if policy is None else bound
    for part, kind in parts.items():
        before, now = (_values(kind, getattr(of, part)) for of in (config, options))
        words += as_options(part, {field: value for field, value in now.items() if value != before[field]})
    return shlex.join(["cuelearner", *words, "--out", f"{place}/{Path(out).name}"])


def _values(kind: type, config: Any) -> dict[str, Any]:
    return {entry.name: getattr(config, entry.name) for entry in dataclasses.fields(kind)}
