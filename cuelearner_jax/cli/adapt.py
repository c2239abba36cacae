"""`cuelearner adapt`."""

from __future__ import annotations

import shlex
from contextlib import nullcontext
from dataclasses import dataclass, field, replace
from pathlib import Path

from cuelearner_jax.adaptation import changes
from cuelearner_jax.adaptation.judging import PERSON
from cuelearner_jax.cli.label import page_module
from cuelearner_jax.cli.options import Finished, Flag, Kinds, about, look_ahead_of, out, parse
from cuelearner_jax.cli.sources import source_of
from cuelearner_jax.errors import NotFinite
from cuelearner_jax.guides import registry as guidances
from cuelearner_jax.runs.policy_sources import LaneChoice
from cuelearner_jax.storage import policy_folders
from cuelearner_jax.studies.adapt import AdaptRequest, subject_of
from cuelearner_jax.task import Task
from cuelearner_jax.tasks import logs
from cuelearner_jax.terminal import progress_bars, watched_by


@dataclass(frozen=True, kw_only=True)
class Adapt(Finished, AdaptRequest):
    """Correct a finished policy by labels about what the policy does in a changed world.

    The policy lies in a run folder or a policy folder; or, with --task, it is package.module:NAME, any function of
    observations, or a file in ONNX. With --labels-from of a page about recorded situations, no task is needed."""

    out: Path = Path("policies/NAME")
    """Policy folder to write."""
    overwrite: Flag[bool] = False
    """Delete an existing policy folder."""
    base: LaneChoice = field(default_factory=LaneChoice)
    kinds: Kinds = field(default_factory=dict)


def run(arguments: list[str]) -> None:
    """Run the command. Raises UserError for what cannot be adapted, NotFinite if a model could not be fitted."""
    ahead = look_ahead_of(arguments, "adapt", Adapt)
    source = source_of(ahead, is_policy=True)
    code = ahead.base if source.code is None else ahead.words[0]
    kind = ahead.guidance[0] if ahead.guidance else None
    file = None if ahead.labels_from is None else Path(ahead.labels_from)
    default = Adapt.of(source.task, source.config, ahead.scenario, kind, ahead.judge_by, file)
    default = replace(default, out=Path("policies") / source.folder.name)
    options = parse(Adapt, arguments, "adapt", default, about(Adapt, source.task, policies=True))
    with policy_folders.place_of(options.out, options.overwrite) as place, progress_bars() as bars:
        subject = subject_of(source.on(options.robot), options.task, options.base, code)
        # otherwise the changes stand for the folder's code
        if options.changes is not None and (guidances.resolve(options.guidance).by_evidence or source.adapted is None):
            subject = subject._replace(changes=changes.load(options.changes), changes_reference=options.changes)
        announce = lambda address: out.print(f"open {address}", soft_wrap=True)  # noqa: E731
        with page_module("films").film_page(announce) if options.judge_by == PERSON else nullcontext() as prefer:
            outcome = options.run(subject._replace(prefer=prefer), watched_by(bars))
        outcome.write(place)
    for line in outcome.result.words:
        out.print(line)
    measure = ["cuelearner", "evaluate", str(options.out), *_named_again(options, source.task, code)]
    out.print(f"wrote {options.out} (measure it with: {shlex.join(measure)})", soft_wrap=True)
    if outcome.result.failed.any():
        raise NotFinite("a fit is no longer finite, so its model is not used: lower --scalars.feedback-learning-rate")


def _named_again(options: Adapt, task: Task, code: str | None) -> list[str]:
    """Return the options that a command about the policy folder needs again: code that no file may have loaded."""
    again = {
        "--env": task.origin or (task.command_name if (task.command_name or "").count(":") > 1 else None),
        "--base": code,
        "--changes": options.changes,
        "--robot": options.robot,
        "--agent": options.agent_part,
        "--arbiter": options.arbiter_part,
        "--labels-from": "OTHER_LABELS" if task.name == logs.NAME else None,  # not those that made it
    }
    return [str(word) for name, value in again.items() if value for word in (name, value)]
