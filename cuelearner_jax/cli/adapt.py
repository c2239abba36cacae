"""`cuelearner adapt`."""

from __future__ import annotations

import shlex
from argparse import Namespace
from contextlib import nullcontext
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from cuelearner_jax.adaptation import changes
from cuelearner_jax.adaptation.judging import PERSON
from cuelearner_jax.api.adaptation import world_of
from cuelearner_jax.api.labels import labels_from_file
from cuelearner_jax.cli.label import page_module
from cuelearner_jax.cli.options import Finished, Flag, Kinds, about, look_ahead_of, out, parse
from cuelearner_jax.cli.sources import code_of, is_code, source_of
from cuelearner_jax.errors import NotFinite, UserError
from cuelearner_jax.guides import registry as guidances
from cuelearner_jax.runs.trained import PolicySource
from cuelearner_jax.storage import policy_folders
from cuelearner_jax.studies.adapt import AdaptRequest, BaseLanes, subject_of
from cuelearner_jax.task import Task
from cuelearner_jax.tasks import logs
from cuelearner_jax.terminal import progress_bars, watched_by


@dataclass(frozen=True, kw_only=True)
class Adapt(Finished, AdaptRequest[Any, Kinds]):
    """Correct a finished policy by labels about what the policy does in a changed world.

    The policy lies in a run folder or a policy folder; or, with --task, it is package.module:NAME, any function of
    observations, or a file in ONNX. With --labels-from of a page about recorded situations, no task is needed."""

    out: Path = Path("policies/NAME")
    """Policy folder to write."""
    overwrite: Flag[bool] = False
    """Delete an existing policy folder."""
    base: BaseLanes = field(default_factory=BaseLanes)


def run(arguments: list[str]) -> None:
    """Run the command. Raises UserError for what cannot be adapted, NotFinite if a model could not be fitted."""
    ahead = look_ahead_of(arguments, "adapt", Adapt)
    source, code = _source(ahead)
    named = ahead.base if code is None else ahead.words[0]
    kind = ahead.guidance[0] if ahead.guidance else None
    file = None if ahead.labels_from is None else Path(ahead.labels_from)
    default = Adapt.of(source.task, source.config, ahead.scenario, kind, ahead.judge_by, file)
    base, place = BaseLanes(policy=source.default_policy), Path("policies") / source.folder.name
    default = replace(default, out=place, base=base)
    options = parse(Adapt, arguments, "adapt", default, about(Adapt, source.task, policies=True))
    with policy_folders.place_of(options.out, options.overwrite) as place, progress_bars() as bars:
        subject = subject_of(source.on(options.robot), options.task, options.base, code, named)
        # otherwise the changes stand for the folder's code
        if options.changes is not None and (guidances.resolve(options.guidance).by_evidence or source.adapted is None):
            subject = subject._replace(changes=changes.load(options.changes), changes_named=options.changes)
        with _person(options.judge_by) as prefer:
            outcome = options.run(subject._replace(prefer=prefer), watched_by(bars))
        outcome.write(place)
    for line in outcome.found.words:
        out.print(line)
    measure = ["cuelearner", "evaluate", str(options.out), *_named_again(options, source.task, named)]
    out.print(f"wrote {options.out} (measure it with: {shlex.join(measure)})", soft_wrap=True)
    if outcome.found.failed.any():
        raise NotFinite("a fit is no longer finite, so its model is not used: lower --scalars.feedback-learning-rate")


def _person(judge_by: str) -> Any:
    """Return a context with the function by which a person judges, on a page; None where none does."""
    if judge_by != PERSON:
        return nullcontext()
    return page_module("films").film_page(0, lambda address: out.print(f"open {address}", soft_wrap=True))


def _named_again(options: Adapt, task: Task, code: str | None) -> list[str]:
    """Return the options that a command about the policy folder needs again: code that no file may have loaded."""
    again = {
        "--env": task.origin or (task.named if (task.named or "").count(":") > 1 else None),
        "--base": code,
        "--changes": options.changes,
        "--robot": options.robot,
        "--agent": options.agent_part,
        "--arbiter": options.arbiter_part,
        "--labels-from": options.labels_from if task.name == logs.NAME else None,
    }
    return [str(word) for name, value in again.items() if value for word in (name, value)]


def _source(ahead: Namespace) -> tuple[PolicySource, Any]:
    """Return the policies' source, and the code that is named in place of a policy.

    Raises UserError if they are not available.
    """
    if ahead.words and is_code(ahead.words[0]) and ahead.task is None and ahead.env is None:
        return _of_labels(ahead.words[0], ahead.labels_from), code_of(ahead.words[0])
    source = source_of(ahead)
    return replace(source, code=None), source.code


def _of_labels(named: str, path: str | None) -> PolicySource:
    """Return the situations of a label file as a task. Raises UserError unless its labels are about a recording."""
    labels = None if path is None else labels_from_file(Path(path))
    if labels is None or labels.task.get("name") != logs.NAME:
        why = "" if path is None else f", since {path} does not hold labels of a recording"
        raise UserError(
            f"{named} needs a task to act in{why}: give one, for instance --task navigation or --env gymnasium:NAME"
        )
    world = world_of(labels)
    return PolicySource(world.task, world.task.start(), None, Path(world.task.name))
