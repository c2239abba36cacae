"""The task protocol: configuration, bodies, teacher, presets, scenarios and pictures. Types only."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from pkgutil import resolve_name
from typing import Any, NamedTuple

import jax
from jaxtyping import Array, Float, PRNGKeyArray

from cuelearner_jax.config import GuideSizes, Scalars, check_types
from cuelearner_jax.environment import Environment, offers, view_of
from cuelearner_jax.errors import UserError, format_value, suggestion
from cuelearner_jax.run_config import RunConfig
from cuelearner_jax.types import EnvState, Policy, Reel, Sketch, Teacher

PAPER = "paper"  # preset that policies are assumed to be trained with, where no folder says so
QUICKSTART = "quickstart"  # preset that training starts from where none is named: it takes minutes

# (policy, environment, key, environments, steps, tell) -> values (environments,) by name, as `evaluate.Rollout.each`;
# now and then it calls `tell` with how far it is, and of how much
Rollout = Callable[[Any, Any, PRNGKeyArray, int, int, Callable[[int, int], None]], dict[str, Any]]


@dataclass(frozen=True)
class Preset:
    """A named starting point: a configuration and the lanes that a sweep runs by default."""

    about: str
    config: RunConfig
    guidance: tuple[str, ...] = ()  # kinds that it compares; empty: all that the task can have
    labels: tuple[int, ...] = (500, 1000)
    seeds: int = 5
    first_seed: int = 0
    takes: str = ""  # duration, and on which machine


class Pictures(NamedTuple):
    """The drawing functions of a body."""

    # (environment, policy, key, steps) -> what the next two draw, a frame a step; the reward of each step
    record: Callable[[Any, Any, PRNGKeyArray, int], tuple[list[Any], list[float]]]
    still: Callable[[Any, list[Any], Path], None]  # (environment, frames, file): one picture of them
    animate: Callable[[Any, list[Any], Path], None]  # (environment, frames, file): a film of all, .gif or .mp4
    # (environment, state, observation (obs,), action (action,), file): the situation as a person is asked about it,
    # with the action in question as an arrow; a PNG
    question: Callable[[Any, EnvState, Float[Array, " obs"], Float[Array, " action"], Path], None]
    # (environment, state): the situation as a person labels it in a browser; None: not possible
    sketch: Callable[[Any, EnvState], Sketch] | None = None
    # (environment, state, action (action,)): what the action leads to, to be seen in the sketch of the state
    # None, or no reel: there is none
    reel: Callable[[Any, EnvState, Float[Array, " action"]], Reel | None] | None = None
    # (environment, state, actions (n, action)): SVG elements of where each of the actions leads, to be seen in the
    # sketch of the state; they take their colour from the group around them
    trails: Callable[[Any, EnvState, Float[Array, "n action"]], list[str]] | None = None
    # (environment): raises UserError if it cannot be drawn, which for some only trying tells; None: all can
    check: Callable[[Any], None] | None = None
    legend: str = ""  # meaning of the trails, for a person
    # True if a reel shows the action's consequence; False: the recorded one, whatever the action
    simulates: bool = True


@dataclass(frozen=True)
class Body:
    """A robot or player that acts in a task. Policies act unchanged on each body of a task."""

    name: str
    about: str
    environment: Callable[[Any, str], Environment]  # (configuration, split); for the splits see `evaluate.SPLITS`
    engines: Mapping[str, Rollout | str] = field(default_factory=dict)  # roll-outs in other physics, or module:NAME
    # loads the drawing functions, when called; None: the body cannot be drawn
    pictures: Callable[[], Pictures] | None = None
    # a folder of the user's -> the body with what lies there; raises UserError if that is not for it; None: takes none
    made_of: Callable[[Path], Body] | None = None
    digest: str = ""  # meaning of that folder
    # (configuration, observations (n, obs), actions (n, action)) -> the environment with these in place of what files
    # hold; without them (None) of zeros, as far as shapes and views depend on it; None: as `environment` has it
    filled: Callable[[Any, Any, Any], Environment] | None = None

    def shape_environment(self, config: Any) -> Environment:
        """Return the environment of a configuration with the right shapes and views, but without worlds."""
        return self.environment(config, "training") if self.filled is None else self.filled(config, None, None)


@dataclass(frozen=True)
class Scenario:
    """A changed world that a finished policy may meet and be adapted to."""

    about: str
    changes: dict[str, Any]  # fields of the task's configuration
    bound_deg: float | None = None  # suggested bound of an adapted policy's corrections [deg]
    eps_deg: float | None = None  # suggested strength of a label in it [deg]
    # Defaults of `cuelearner adapt` in this scenario:
    guidance: str | None = None  # kind of guidance
    judge_by: str | None = None  # metric that judges whether a model is used
    judge_bounds: tuple[float, ...] = ()  # shares of the bound that are tried as well
    sizes: dict[str, Any] = field(default_factory=dict)  # fields of `GuideSizes`
    scalars: dict[str, Any] = field(default_factory=dict)  # fields of `Scalars`
    # options of the kind of guidance: fields of its `Kind.config`
    options: dict[str, Any] = field(default_factory=dict)

    def apply(self, config: Any) -> Any:
        """Return the configuration with the scenario's changes."""
        return dataclasses.replace(config, **self.changes)


@dataclass(frozen=True)
class Task:
    """One task. Raises ValueError where its parts do not fit together."""

    name: str
    about: str
    config: type  # class of its configuration: a dataclass with one line of help a field
    bodies: tuple[Body, ...]  # the task's own body comes first
    # (configuration, environment) -> teacher; None: the task has no teacher
    teacher: Callable[[Any, Any], Teacher] | None = None
    # (configuration, environment, questions) -> a teacher with the same answers that is faster for so few; None: none
    brief_teacher: Callable[[Any, Any, int], Teacher | None] | None = None
    # configuration -> digests of the user's own files that it names, by field; raises UserError if one is not there
    files: Callable[[Any], dict[str, str]] = lambda config: {}
    # configuration -> steps of its longest episode, where episodes count (`Step.outcome`); None: steps count
    longest: Callable[[Any], int] | None = None
    # metrics of which less is better, by which no correction is judged
    less_is_better: tuple[str, ...] = ("collision", "cost", "distance", "error", "foul", "timeout")
    wants: Callable[[Any], str] = lambda config: ""  # configuration -> the instruction for a person, a sentence
    # environment -> default policy whose actions people are asked about; None: uniform actions
    proposed: Callable[[Any], Policy] | None = None
    near_aims: bool = False  # True if people are asked near a situation's aims, since answers elsewhere say little
    presets: dict[str, Preset] = field(default_factory=dict)
    scenarios: dict[str, Scenario] = field(default_factory=dict)
    labels_hold: tuple[str, ...] = ()  # fields of the configuration that labels of another world may differ in
    command_name: str = ""  # its name in commands, if other than `name`: "gymnasium:FetchReach-v4"
    origin: str = ""  # "package.module:name" of a task from outside, set by the code that resolved it
    robot: str = field(default="", compare=False)  # as `on` was asked for it; empty: the task's own
    default: Any = None  # the default configuration; None: `config()`
    # configuration -> default metric that judges adapted policies
    judge_by: Callable[[Any], str] = lambda config: "reward"

    def __post_init__(self) -> None:
        fields = {entry.name for entry in dataclasses.fields(self.config)}
        if not self.name.isidentifier() or "name" in fields:
            raise ValueError(f"task {self.name!r}: its name must be an identifier, and no field of its configuration")
        names = [body.name for body in self.bodies]
        if len(set(names)) < len(names):
            raise ValueError(f"task {self.name}: each body needs another name, not {names}")
        if unknown := set(self.labels_hold) - fields:
            raise ValueError(f"task {self.name}: labels_hold names {unknown}, no fields of {self.config.__name__}")
        for name, scenario in self.scenarios.items():
            try:
                dataclasses.replace(GuideSizes(), **scenario.sizes)
                dataclasses.replace(Scalars(), **scenario.scalars)
                for base in [preset.config.task for preset in self.presets.values()] or [self.plain()]:
                    scenario.apply(base)
            except Exception as error:
                raise ValueError(f"task {self.name}: scenario {name!r} makes no configuration ({error})") from error

    def plain(self) -> Any:
        """Return the default configuration."""
        return self.config() if self.default is None else self.default

    def configure(self, scenario: str | None = None, **changes: Any) -> Any:
        """Return the task's configuration in a scenario, with fields changed. Raises UserError if there is no such."""
        config = self.plain() if scenario is None else self.scenario(scenario).apply(self.plain())
        return dataclasses.replace(config, **(check_types(config, "task", **changes) if changes else {}))

    def first_preset(self, default: str = PAPER) -> str:
        """Return the name of the default preset: `default`, or the first."""
        return default if default in self.presets else next(iter(self.presets))

    def start(self) -> RunConfig:
        """Return the configuration that a policy is assumed to be trained with, where no folder says so."""
        return self.presets[self.first_preset()].config if self.presets else RunConfig(self.plain())

    def environment(self, config: Any, split: str = "training") -> Environment:
        """Return the world of a configuration with the first body in it, for the episodes of a split."""
        return self.bodies[0].environment(config, split)

    def view(self, config: Any) -> Any:
        """Return what policies see in a configuration; worlds that no policy uses are not generated."""
        make = lambda: self.bodies[0].shape_environment(config)  # noqa: E731
        if not offers(jax.eval_shape(make), "view"):
            return self.environment(config)
        return jax.jit(lambda: view_of(make()))()

    def make_teacher(self, config: Any, env: Environment, questions: int | None = None) -> Teacher:
        """Return the teacher of a world, who gets so many questions, if known. Raises UserError if there is none."""
        if self.teacher is None:
            advice = "give --teacher module:NAME, --labels-from, or a guidance without labels"
            raise UserError(f"{self.name} has no teacher to ask: {advice}")
        brief = questions is not None and self.brief_teacher and self.brief_teacher(config, env, questions)
        return brief or self.teacher(config, env)

    def check_whole(self, config: Any, envs: int, steps: int, envs_option: str, steps_option: str) -> None:
        """Raise UserError if an episode may outlast the steps of each environment.

        Means over the episodes that ended in time would be means of short episodes only.
        """
        if self.longest is not None and steps // envs < self.longest(config):
            raise UserError(
                f"{steps_option} is {steps} for {envs} environments, {steps // envs} each, but an episode lasts up to "
                f"{self.longest(config)}: give {steps_option} {envs * self.longest(config)}, or a lower {envs_option}"
            )

    def check_evaluations(self, config: RunConfig) -> None:
        """Raise UserError unless the evaluations of a training see whole episodes."""
        options = "--schedule.eval-envs", "--schedule.eval-steps"
        self.check_whole(config.task, config.schedule.eval_envs, config.schedule.eval_steps, *options)

    def on(self, body: str | None) -> Task:
        """Return the task with that body first (None: unchanged); NAME:FOLDER adds the user's files in a folder."""
        if body is None:
            return self
        robot, (body, _, folder) = body, body.partition(":")
        if len(self.bodies) == 1:
            raise UserError(f"{self.name} has no robots to choose from: leave out --robot")
        bodies = {one.name: one for one in self.bodies}
        if body not in bodies:
            raise UserError(f"unknown robot {body!r}{suggestion(body, bodies)}")
        first = bodies.pop(body)
        if folder:
            if first.made_of is None:
                raise UserError(f"robot {body} takes no folder: leave out {folder!r}")
            first = first.made_of(Path(folder))
        return dataclasses.replace(self, bodies=(first, *bodies.values()), robot=robot)

    def engine(self, name: str | None) -> Rollout | None:
        """Return the first body's roll-out in other physics (None: its own). Raises UserError for an unknown engine."""
        engines = self.bodies[0].engines
        if name is None or name in engines:
            rollout = engines.get(name or "")
            return resolve_name(rollout) if isinstance(rollout, str) else rollout
        if name in (body.name for body in self.bodies):
            raise UserError(f"{name} is a robot of {self.name}, not an engine: give --robot {name}")
        if not engines:
            others = [body.name for body in self.bodies if body.engines]
            raise UserError(f"--engine {name} needs --robot: choose one of {', '.join(others) or 'none'}")
        raise UserError(f"unknown engine {name!r}{suggestion(name, engines)}")

    def pictures(self, otherwise: str = "evaluate it instead") -> Pictures:
        """Return the first body's drawing functions. Raises UserError, with the remedy `otherwise`, if none are."""
        if self.bodies[0].pictures is None:
            raise UserError(f"{self.name} has no pictures of {self.bodies[0].name}: {otherwise}")
        return self.bodies[0].pictures()

    def scenario(self, name: str) -> Scenario:
        """Return the scenario of that name. Raises UserError if there is none."""
        if not self.scenarios:
            raise UserError(f"{self.name} has no scenarios to choose from: leave out --scenario")
        if name not in self.scenarios:
            raise UserError(f"unknown scenario {format_value(name)}{suggestion(name, self.scenarios)}")
        return self.scenarios[name]


def shape_of(task: Task, config: Any) -> Any:
    """Return the environment of a configuration with shapes in place of arrays, at almost no cost."""
    return jax.eval_shape(lambda: task.bodies[0].shape_environment(config))
