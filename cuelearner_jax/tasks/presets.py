"""Read a task's presets and scenarios from the TOML file of its name.

A table starts from the defaults, or from the earlier one that it names as `like`, and gives the fields that differ. A
preset's tables are the groups of a `RunConfig`; a part with a `name` (agent, arbiter) starts from its own defaults.
"""

from __future__ import annotations

import dataclasses
import tomllib
from pathlib import Path
from typing import Any

from cuelearner_jax.adaptation.by_model import plain_scalars
from cuelearner_jax.config import plain
from cuelearner_jax.run_config import RunConfig, kind_from_json, part_from_json
from cuelearner_jax.spaces import DIRECTIONS, Space
from cuelearner_jax.task import QUICKSTART, Preset, Scenario

GROUPS = [field.name for field in dataclasses.fields(RunConfig)]


def read(name: str, config: Any, space: Space = DIRECTIONS) -> dict[str, Any]:
    """Return `presets` and `scenarios` of a task from the file of a name: fields of `task.Task`.

    `config`: the task's default configuration. `space`: of the actions, in whose unit scalars are.
    """
    tables = tomllib.loads(Path(__file__).with_name(f"{name}.toml").read_text(encoding="utf-8"))
    presets, scenarios = {}, {}
    for key, own in tables["presets"].items():
        start = Preset("", RunConfig(config, scalars=plain_scalars(space)))
        start = presets.get(own.pop("like", None), start)
        groups = {group: own.pop(group) for group in GROUPS if group in own}
        presets[key] = _replace(start, own | {"config": with_groups(start.config, groups)})
    for key, own in tables.get("scenarios", {}).items():
        scenarios[key] = _replace(scenarios.get(own.pop("like", None), Scenario("", {})), own)
    return {"presets": presets, "scenarios": scenarios}


def with_groups(config: RunConfig, groups: dict[str, dict[str, Any]]) -> RunConfig:
    """Return a configuration with the fields of its groups that differ, as a TOML file gives these."""
    return dataclasses.replace(config, **{name: _group(config, name, values) for name, values in groups.items()})


def _group(start: RunConfig, name: str, values: dict[str, Any]) -> Any:
    if name == "kinds":
        return {kind: kind_from_json(kind, own) for kind, own in values.items()}
    return part_from_json(name, values) if "name" in values else _replace(getattr(start, name), values)


def _replace(start: Any, values: dict[str, Any]) -> Any:
    """Return a dataclass with fields changed; lists become tuples, also within a table."""
    tables = {
        key: {own: plain(part) for own, part in value.items()} for key, value in values.items() if type(value) is dict
    }
    return dataclasses.replace(start, **{key: plain(value) for key, value in values.items()} | tables)


def quickstart(
    config: Any, space: Space, num_envs: int, episodes: int, layers: tuple[int, ...], **lanes: Any
) -> Preset:
    """Return a preset of minutes for another library's environment; `episodes`: of an evaluation, `lanes`: fields."""
    start = read("other", config, space)["presets"][QUICKSTART].config
    every = num_envs * -(-1_000 // num_envs)  # the first multiple from 1,000 on
    counts = {"eval_every": every, "eval_envs": episodes, "eval_steps": episodes * config.max_steps}
    counts |= {"total_steps": 6 * every, "guidance_until": 3 * every, "checkpoint_every": 2 * every}
    run = dataclasses.replace(
        start,
        sizes=dataclasses.replace(start.sizes, num_envs=num_envs, feedback_layers=layers),
        schedule=dataclasses.replace(start.schedule, **counts),
        agent=dataclasses.replace(start.agent, replay_capacity=num_envs * -(-50_000 // num_envs)),
    )
    return Preset(f"small networks, {6 * every:,} steps a seed", run, **lanes)
