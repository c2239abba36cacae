"""The configuration of a run except its lanes: options that all parts share, and the options of each part."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass
from operator import attrgetter
from typing import Any, Generic, NamedTuple, TypeVar, cast

from cuelearner_jax import config as configuration
from cuelearner_jax import plugins
from cuelearner_jax.agents import ddqn
from cuelearner_jax.agents.protocol import AGENTS, AgentFunctions
from cuelearner_jax.arbiters import ARBITERS, Episodes
from cuelearner_jax.config import Scalars, Schedule, Sizes, check_guide, check_multiple, check_part
from cuelearner_jax.environment import spaces_of
from cuelearner_jax.errors import UserError
from cuelearner_jax.guides import registry as guidances
from cuelearner_jax.guides.base import Guide
from cuelearner_jax.spaces import Box

KindsT = TypeVar("KindsT")

GROUPS: Mapping[str, type] = {"sizes": Sizes, "scalars": Scalars, "schedule": Schedule}
PARTS: Mapping[str, dict[str, Any]] = {"agent": AGENTS, "arbiter": ARBITERS}


class Settings(NamedTuple):
    """The traced inputs of a compiled program: numbers that cost no new compile."""

    scalars: Scalars
    schedule: Schedule
    agent: Any  # options of the agent
    arbiter: Any  # options of the arbiter


@dataclass(frozen=True)
class RunConfig(Generic[KindsT]):
    """The configuration of a run except its lanes (seeds, label budgets) and its kind of guidance."""

    task: Any
    sizes: Sizes = dataclasses.field(default_factory=Sizes)
    scalars: Scalars = dataclasses.field(default_factory=Scalars)
    schedule: Schedule = dataclasses.field(default_factory=Schedule)
    agent: Any = dataclasses.field(default_factory=ddqn.DDQNConfig)
    """Options of the agent."""
    arbiter: Any = dataclasses.field(default_factory=Episodes)
    """Options of the arbiter."""
    kinds: KindsT = dataclasses.field(default_factory=dict)  # pyright: ignore[reportAssignmentType]
    """Options of kinds by their names; a kind that is not there has its defaults."""

    @property
    def bootstraps(self) -> bool:
        """Whether targets use the next observation (discount above 0)."""
        return self.scalars.discount > 0

    def agent_in(self, env: Any) -> AgentFunctions:
        """Return the agent's functions for an environment. Raises UserError for a frame that it does not support."""
        return self.agent.make(self.sizes.frame, spaces_of(env))

    def guide_in(self, env: Any, kind: str) -> Guide:
        """Return the guide of a kind for an environment. Raises UserError for options that do not suit either."""
        guide, space = guidances.make(kind, self.sizes, env, self.options_of(kind)), spaces_of(env).actions
        if self.sizes.ask_from == "middle" and not isinstance(space, Box):
            raise UserError(f"sizes.ask_from is middle, but only a box has one, not {space.name}: leave it out")
        if self.sizes.store_labelled and guide.form is not None and guide.form.correct is None:
            why = f"sizes.store_labelled executes what answers ask for, but {guide.form.name} answers name no action"
            raise UserError(f"{why}: leave it out, or leave out guidance {kind}")
        return guide

    def options_of(self, kind: str) -> Any:
        """Return the options of a kind of guidance: None for its defaults, plain values for an unknown kind's."""
        own = cast(dict[str, Any], self.kinds).get(kind)
        return kind_from_json(kind, own) if isinstance(own, dict) else own

    @property
    def settings(self) -> Settings:
        """Return the inputs of programs at each call."""
        return Settings(self.scalars, self.schedule, self.agent, self.arbiter)


def check(config: RunConfig) -> None:
    """Raise UserError with one line for the first value that cannot work."""
    sizes, schedule = config.sizes, config.schedule
    check_part(schedule, "schedule")
    check_guide(sizes, config.scalars)
    if sizes.store_labelled and (sizes.candidates > 1 or sizes.question_every > 1):
        raise UserError("sizes.store_labelled keeps every step: leave out sizes.candidates and sizes.question_every")
    check_part(config.agent, "agent")
    check_part(config.arbiter, "arbiter")
    for name in config.kinds:
        if not isinstance(own := config.options_of(name), dict | None):
            check_part(own, name)
    config.agent.check(sizes, config.bootstraps)
    if config.scalars.discount >= 1:
        raise UserError(f"scalars.discount is {config.scalars.discount}: give a number below 1")
    for name, unit in (
        ("agent.replay_capacity", "sizes.num_envs"),
        ("schedule.eval_every", "sizes.num_envs"),
        ("schedule.total_steps", "schedule.eval_every"),
        ("schedule.checkpoint_every", "schedule.eval_every"),
        ("schedule.eval_steps", "schedule.eval_envs"),
        ("schedule.guide_eval_every", "sizes.labels_per_round"),
    ):
        check_multiple(attrgetter(name)(config), attrgetter(unit)(config), name, unit)


def to_json(config: RunConfig) -> dict[str, Any]:
    """Return the options as JSON values without the task's; a part's options stand beside the part's name."""
    shared = {name: configuration.to_json(getattr(config, name)) for name in GROUPS}
    parts = {name: part_to_json(getattr(config, name)) for name in PARTS}
    return {**shared, **parts, "kinds": {name: kind_to_json(own) for name, own in config.kinds.items()}}


def from_json(task: Any, values: Mapping[str, Any]) -> RunConfig:
    """Return the configuration of JSON values; code that a file names is never loaded."""
    shared = {name: configuration.from_json(kind, values[name]) for name, kind in GROUPS.items()}
    parts = {sort: part_from_json(sort, values[sort]) for sort in PARTS}
    kinds = {name: kind_from_json(name, own) for name, own in values["kinds"].items()}
    return RunConfig(task, **shared, **parts, kinds=kinds)


def kind_to_json(options: Any) -> Any:
    """Return the options of a kind of guidance as JSON values; None where there are none."""
    return options if options is None or isinstance(options, dict) else configuration.to_json(options)


def kind_from_json(name: str, values: dict[str, Any] | None) -> Any:
    """Return the options of a kind from JSON values; for an unknown kind from outside the plain values.

    Raises as `from_json`, and UserError for a value out of bounds or a kind without options.
    """
    if values is None or (kind := guidances.guides().get(name)) is None:
        return values
    if kind.config is None:
        raise UserError(f"guidance {name!r} has no options: leave them out")
    options = configuration.from_json(kind.config, values)
    check_part(options, name)
    return options


def part_to_json(options: Any) -> dict[str, Any]:
    """Return a part's options as JSON values beside its name."""
    return {"name": options.NAME, **configuration.to_json(options)}


def part_from_json(sort: str, values: Mapping[str, Any]) -> Any:
    """Return a part's options from JSON values. Raises as `from_json`."""
    return configuration.from_json(plugins.find(PARTS[sort], values["name"], sort), dict(values))
