"""`cuelearner adapt`."""

from __future__ import annotations

import shlex
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any, Generic

from cuelearner_jax.adaptation import changes
from cuelearner_jax.api import correction
from cuelearner_jax.cli.parsing import about, out, parse, taken
from cuelearner_jax.cli.shared_options import Flag, KindsT, Outside, TaskT, kinds_type, subject_of, unprefixed
from cuelearner_jax.cli.sources import TASK_OPTIONS, code_of, is_code, source_of
from cuelearner_jax.errors import NotFinite, UserError
from cuelearner_jax.run_config import PARTS
from cuelearner_jax.runs.trained import PolicySource
from cuelearner_jax.storage import policy_folders
from cuelearner_jax.studies import adapt
from cuelearner_jax.studies.adapt import AdaptRequest, BaseLanes, Subject
from cuelearner_jax.task import Task
from cuelearner_jax.tasks import logs
from cuelearner_jax.terminal import progress_bars, watched_by


@dataclass(frozen=True, kw_only=True)
class Adapt(AdaptRequest[TaskT, KindsT], Outside, Generic[TaskT, KindsT]):
    """Correct a finished policy by labels about what the policy does in a changed world.

    The policy lies in a run folder or a policy folder; or, with --task, it is package.module:NAME, any function of
    observations, or a file in ONNX. With --labels-from of a page about recorded situations, no task is needed."""

    out: Path
    """Policy folder to write."""
    overwrite: Flag[bool] = False
    """Delete an existing policy folder. (A further option: --changes package.module:NAME gives a reading distortions
    of your own in place of those that the world declares.)"""
    base: BaseLanes = field(default_factory=BaseLanes)


OPTIONS = {"adapt": Adapt}
# Options that determine the defaults of others.
FIRST = {"scenario": "NAME", "guidance": "KIND", "judge_by": "METRIC", "labels_from": "a labels.parquet"}


def run(arguments: list[str]) -> None:
    """Run the command. Raises UserError for what cannot be adapted, NotFinite if a model could not be fitted."""
    source, code, named, rest = _source(arguments)
    changed, _ = taken(arguments, "--changes", "package.module:NAME")
    first = {name: taken(rest, f"--{name.replace('_', '-')}", wanted)[0] for name, wanted in FIRST.items()}
    file = Path(first["labels_from"]) if first["labels_from"] else None
    default = adapt.suggested(source, **{**first, "labels_from": file})
    kinds = kinds_type(default.kinds)
    kind = Adapt[source.task.config, Annotated[kinds, unprefixed]]  # pyright: ignore[reportInvalidTypeArguments]
    default = kind(
        **{**vars(default), "kinds": kinds()},
        out=Path("policies") / source.folder.name,
        base=BaseLanes(policy=source.default_policy),
    )
    subject = subject_of(source)
    told = about(Adapt, source.task, policies=True)
    asked = parse(kind, rest, f"adapt {subject.typed}", default, told, subject)
    asked = replace(asked, kinds=vars(asked.kinds))
    subject = Subject(source.on(asked.robot), asked.base, code, named)
    # otherwise the changes stand for the folder's code
    if changed is not None and (adapt.reads_evidence(asked) or source.adapted is None):
        subject = subject._replace(changes=changes.load(changed), changes_named=changed)
    with (
        policy_folders.place_of(asked.out, asked.overwrite) as place,
        progress_bars() as bars,
    ):
        outcome = adapt.run(subject, asked, watched_by(bars))
        outcome.write(place)
    for line in adapt.sentences(outcome.found):
        out.print(line)
    measure = ["cuelearner", "evaluate", str(asked.out), *_named_again(arguments, source.task, named)]
    out.print(f"wrote {asked.out} (measure it with: {shlex.join(measure)})", soft_wrap=True)
    if outcome.found.failed.any():
        raise NotFinite("a fit is no longer finite, so its model is not used: lower --scalars.feedback-learning-rate")


def _named_again(arguments: list[str], task: Task, code: str | None) -> list[str]:
    """Return the options that a command about the policy folder needs again: code that no file may have loaded."""
    world = task.origin or (task.named if (task.named or "").count(":") > 1 else None)
    options = {"--env": world, "--base": code}
    again = ("--changes", "--robot", *(f"--{part}" for part in PARTS), *(["--labels-from"] * (task.name == logs.NAME)))
    options |= {name: taken(arguments, name, "")[0] for name in again}
    return [word for name, value in options.items() if value for word in (name, value)]


def _source(arguments: list[str]) -> tuple[PolicySource, Any, str | None, list[str]]:
    """Return the policies' source, the code given in place of a policy, its name, and the other arguments.

    Raises UserError if they are not available.
    """
    if arguments and is_code(arguments[0]):
        named, rest = arguments[0], arguments[1:]
        if any(word.split("=")[0] in TASK_OPTIONS for word in rest):
            source, rest = source_of(rest, "adapt", Adapt)
        else:
            source = _of_labels(named, taken(rest, "--labels-from", FIRST["labels_from"])[0])
        return source, code_of(named), named, rest
    named, _ = taken(arguments, "--base", "package.module:NAME")
    source, rest = source_of(arguments, "adapt", Adapt)
    return source, None, named, rest


def _of_labels(named: str, path: str | None) -> PolicySource:
    """Return the situations of a label file as a task. Raises UserError unless its labels are about a recording."""
    found = None if path is None else correction.labels_from_file(Path(path))
    if found is None or found.config is None:
        why = "" if path is None else f", since {path} does not hold labels of a recording"
        raise UserError(
            f"{named} needs a task to act in{why}: give one, for instance --task navigation or --env gymnasium:NAME"
        )
    world = correction.world_of(found)
    return PolicySource(world.task, world.task.start(), None, Path(world.task.name))
