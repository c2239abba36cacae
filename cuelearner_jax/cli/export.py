"""`cuelearner export`."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Generic

from cuelearner_jax.cli.parsing import out, taken
from cuelearner_jax.cli.shared_options import Flag, Lane, Outside, TaskT, asked_of_source
from cuelearner_jax.config import digest, to_json
from cuelearner_jax.errors import UserError
from cuelearner_jax.export import contract, correction, decisions
from cuelearner_jax.export.formats import FORMATS
from cuelearner_jax.policies import uniform_in
from cuelearner_jax.runs import trained


@dataclass(frozen=True, kw_only=True)
class Export(Outside, Lane, Generic[TaskT]):
    """Write a policy as a file for a robot, with a contract; --check FOLDER replays one.

    The contract tells what goes in and comes out."""

    task: TaskT
    format: str = "stablehlo"
    """stablehlo, onnx or numpy."""
    out: Path = Path("exported")
    """Folder for the exported decision; a new or an empty one."""
    only_correction: Flag[bool] = False
    """Export only the correction of a policy folder: a function of observation and base action. The base policy stays
    on the robot and is not needed here."""
    scenario: str | None = None
    """A changed world, by its name, whose observations the golden cases are. Options of the task
    (--task.…) come on top of it."""


OPTIONS = {"export": Export}


def run(arguments: list[str]) -> None:
    """Run the command. Raises UserError for what cannot be exported, or does not fulfil its contract."""
    folder, rest = taken(arguments, "--check", "the folders that were exported")
    if folder is not None:
        if rest:
            raise UserError(f"--check takes a folder and nothing else: leave out {rest[0]}")
        _check(Path(folder))
        return
    formats = "\n".join(f"  {name:<11}{one.about}" for name, one in FORMATS.items())
    source, asked = asked_of_source(arguments, "export", Export, f"\n\nformats (--format):\n{formats}")
    name = asked.name_in(source, asked.task)
    if trained.POLICIES[name].taught:
        raise UserError(f"policy {name!r} asks the teacher, who needs the true state: choose another policy")
    contract.check_request(asked.format, asked.out)
    env = source.task.environment(asked.task)
    if asked.only_correction and source.adapted is not None:
        source = replace(source, adapted=replace(source.adapted, code=source.adapted.code or uniform_in(env)))
    policy = asked.policy_in(source, asked.task, env)
    drawn, seen = (lambda: decisions.observations(env, policy)), env
    if asked.only_correction:
        policy, seen = correction.correction_of(policy, env)
        drawn = lambda: correction.cases(env)  # noqa: E731
    origin = {
        "subject": source.folder.name,
        "policy": name,
        **{option.replace("-", "_"): value for option, value in asked.chosen.items()},
        "world": {"name": source.task.name, **to_json(asked.task)},
        "config": digest(to_json(source.config)),
    }
    written = contract.write(policy, seen, drawn, asked.format, asked.out, origin)
    golden = written["golden"]
    out.print(
        f"{golden['cases']} golden cases replayed, largest difference {written['difference']:.1e} "
        f"({golden['steady']} of {golden['drawn']} decisions are insensitive to rounding); wrote {asked.out}"
    )


def _check(folder: Path) -> None:
    difference = contract.replay_golden_cases(folder)
    if others := contract.unlisted_files(folder):
        out.print(f"{folder} also holds files that its contract does not list: {', '.join(others)}")
    out.print(f"{folder} is unchanged since its export; golden cases replayed, largest difference {difference:.1e}")
