"""`cuelearner export`."""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from pathlib import Path

from cuelearner_jax.cli.options import Finished, Flag, out, parse, rows
from cuelearner_jax.cli.sources import source_and_options
from cuelearner_jax.config import digest, to_json
from cuelearner_jax.errors import UserError
from cuelearner_jax.export import contract, correction, decisions, lerobot
from cuelearner_jax.policies import uniform_in
from cuelearner_jax.runs import policy_sources
from cuelearner_jax.runs.policy_sources import LaneChoice, PolicySource


@dataclass(frozen=True, kw_only=True)
class Export(Finished, LaneChoice):
    """Write a policy as a file for a robot, with a contract; --check FOLDER replays one.

    The contract tells what goes in and comes out. For --format lerobot, --policy is the folder of a checkpoint."""

    format: str = "stablehlo"
    """stablehlo, onnx, numpy or lerobot."""
    out: Path = Path("exported")
    """Folder for the exported decision; a new or an empty one."""
    only_correction: Flag[bool] = False
    """Export only the correction of a policy folder: a function of observation and base action. The base policy stays
    on the robot and is not needed here."""
    check: Path | None = None
    """Instead: replay the golden cases of this exported folder."""


def run(arguments: list[str]) -> None:
    """Run the command. Raises UserError for what cannot be exported, or does not fulfil its contract."""
    if any(word.partition("=")[0] == "--check" for word in arguments):
        options = parse(Export, arguments, "export", Export())
        folder = options.check
        difference = contract.open_decision(folder)[1]
        out.print(f"{folder} is unchanged since its export; golden cases replayed, largest difference {difference:.1e}")
        return
    more = f"\n\nformats (--format):\n{rows({**contract.FORMATS, lerobot.NAME: lerobot.ABOUT})}"
    source, options = source_and_options(arguments, "export", Export, more)
    if options.format == lerobot.NAME:
        return _into_checkpoint(source, options)
    name = options.name_in(source, options.task)
    if policy_sources.POLICIES[name].taught:
        raise UserError(f"policy {name!r} asks the teacher, who needs the true state: choose another policy")
    contract.check_request(options.format, options.out)
    env = source.task.environment(options.task)
    if options.only_correction and (lanes := source.adapted) is not None and lanes.code is None:  # it is elsewhere
        values = {**lanes.values, "base_acts": None}
        source = replace(source, adapted=replace(lanes, code=uniform_in(env), values=values))
    policy, lane = options.lane_in(source, options.task, env)
    draw, view = (lambda: decisions.observations(env, policy)), env
    if options.only_correction:
        policy, view, draw = correction.correction_of(policy, env)
    origin = {
        "subject": source.folder.name,
        "policy": name,
        **lane,
        **({} if options.bound_deg is None else {"bound_deg": options.bound_deg}),
        "world": {"name": source.task.name, **to_json(options.task)},
        "config": digest(to_json(source.config)),
    }
    record = contract.write(policy, view, draw, options.format, options.out, origin)
    golden = record["golden"]
    out.print(
        f"{golden['cases']} golden cases replayed, largest difference {record['difference']:.1e} "
        f"({golden['steady']} of {golden['drawn']} decisions are insensitive to rounding); wrote {options.out}"
    )
    if "questions" in record.get("base", {}):
        out.print("the base is asked about other observations: those of decide.base_observations(observation)")


def _into_checkpoint(source: PolicySource, options: Export) -> None:
    """Write a LeRobot checkpoint with a correction. Raises UserError for a policy or checkpoint that does not fit."""
    if source.adapted is None or options.policy in (None, source.default_policy):
        raise UserError("--format lerobot is for a policy folder and a checkpoint: give both, the latter by --policy")
    env = source.task.environment(options.task)
    policy, _ = replace(options, policy=None).lane_in(source, options.task, env)
    names = tuple(getattr(options.task, "cue_names", ()))
    hand = json.loads(getattr(options.task, "hand", "") or "{}")
    checkpoint = lerobot.write(policy, env, names, Path(options.policy), options.out, hand)
    out.print(
        f"wrote {checkpoint}; run it with LeRobot, where the package lerobot_processor_cuelearner is installed: "
        f"lerobot-eval --policy.path={checkpoint}",
        soft_wrap=True,
    )
