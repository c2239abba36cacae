"""Any Gymnasium environment as a task: `gymnasium:FetchReach-v4`, or a class or function of the user's own.

    task = task_of("FetchReach-v4")
    env = task.environment(task.plain())

The configuration describes observations and actions, so that a policy is loaded without its environment. Reading a
folder imports no code beyond that of Gymnasium's own registry.
"""

from __future__ import annotations

import contextlib
import dataclasses
import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pkgutil import resolve_name
from typing import Annotated, Any

import numpy as np

from cuelearner_jax import plugins
from cuelearner_jax.bridges.gymnasium.environment import SUCCESS, GymnasiumTask
from cuelearner_jax.bridges.gymnasium.instances import Actions, Running
from cuelearner_jax.bridges.gymnasium.source import Source, check_installed, registry_spec
from cuelearner_jax.config import EPISODE, Bounds, check_part
from cuelearner_jax.environment import UNKNOWN_UNIT, Quantity, checked_quantities
from cuelearner_jax.errors import UserError, format_value
from cuelearner_jax.spaces import Box, Choices, Space, cues_from
from cuelearner_jax.task import QUICKSTART, Body, Task
from cuelearner_jax.tasks import fetch_layout
from cuelearner_jax.tasks.presets import quickstart
from cuelearner_jax.terminal import console

FAMILY = "gymnasium"
FRAMES = "cuelearner_jax.tasks.frames"  # whose Pillow is not loaded for every command
NUM_ENVS = 8
FIRST_EPISODES = 1_600  # most steps of all first episodes of quickstart, which are never guided
UNLIMITED = 1_000  # steps of an episode, where neither environment nor caller gives a limit
TRIED = 1_000  # most steps of an episode, to find out whether the environment reports success


@dataclass(frozen=True)
class GymnasiumConfig:
    """Configuration of a Gymnasium environment. Every field is an option `--task.…`; its docstring is the help.

    The fields from `slices` on describe observations and actions, so that a stored policy is read without the
    environment.
    """

    environment: str = ""
    """Id in Gymnasium's registry, or the name of code; gymnasium:NAME fills this field and the layout below."""
    arguments: str = "{}"
    """Arguments of the environment by name, as JSON."""
    max_steps: Annotated[int, EPISODE] = 1
    """Largest number of steps of an episode, after which it is truncated."""
    processes: Annotated[int, Bounds(0, 256)] = 0
    """Number of processes that run environments (0: one per processor; 1: run them in the training process)."""
    slices: tuple[str, ...] = ()
    """Layout: names of an observation's slices."""
    slice_sizes: tuple[int, ...] = ()
    """Layout: numbers in each slice."""
    units: tuple[str, ...] = ()
    """Layout: unit of each slice; those in m or rad may shift, by what answers say."""
    slice_kinds: tuple[str, ...] = ()
    """Layout: own, for a slice that a robot measures of itself, directions, or "beams 10", 10 degrees apart."""
    low: tuple[float, ...] = ()
    """Layout: lower bounds of actions."""
    high: tuple[float, ...] = ()
    """Layout: upper bounds of actions."""
    choices: int = 0
    """Layout: number of actions to choose from (0: actions lie between the bounds)."""
    cues: tuple[str, ...] = ()
    """Layout: words for more and less of each entry of an action, as "left,right" (default: "more,less")."""
    cue_names: tuple[str, ...] = ()
    """Layout: a name for each cue (default: its words)."""
    succeeds: bool = False
    """Layout: whether the environment reports success."""

    @property
    def observation(self) -> tuple[Quantity, ...]:
        """The slices of an observation. Raises UserError for an unknown unit or kind."""
        kinds = (kind.partition(" ") for kind in self.slice_kinds)
        rows = zip(self.slices, self.slice_sizes, self.units, kinds, strict=True)
        texts = {quantity.name: quantity.about for quantity in fetch_layout.layout_of(self.environment) or ()}
        try:
            return checked_quantities(
                Quantity(name, size, unit, texts.get(name, ""), kind, float(step or 0))
                for name, size, unit, (kind, _, step) in rows
            )
        except ValueError:
            about = f"task.slice_kinds is {format_value(self.slice_kinds)}"
            raise UserError(f"{about}: give a size, unit and kind for each slice, as 'beams 10'") from None

    @property
    def space(self) -> Space:
        """The space of actions. Raises UserError for bounds or cues that fit none."""
        if self.choices and self.cues:
            advice = "leave it out"
            raise UserError(f"cues is {format_value(self.cues)}, but actions are choices without an order: {advice}")
        if self.choices:
            return Choices(self.choices)
        return Box(self.low, self.high, cues_from(self.cues, self.cue_names) if self.cues else ())


def make_environment(factory: Callable[..., Any] | None, config: GymnasiumConfig, split: str) -> GymnasiumTask:
    """Return the environment of a configuration; Gymnasium is loaded only when it is reset.

    `factory` makes it (None: Gymnasium's registry). Raises UserError for an invalid value.
    """
    if not (name := config.environment):
        raise UserError(f"task.environment is empty: name the task {FAMILY}:ENVIRONMENT, as {FAMILY}:FetchReach-v4")
    check_part(config, "task")
    _arguments(config.arguments)
    if factory is None and ":" in name:  # the configuration is a file's
        factory = partial(_refuse, name)
    observation = config.observation
    size = sum(quantity.size for quantity in observation)
    source = Source(name, config.arguments, config.max_steps, config.processes, size, factory)
    return GymnasiumTask(source, observation, config.space, config.succeeds)


def _arguments(text: str) -> dict[str, Any]:
    try:
        return dict(**json.loads(text))
    except (ValueError, TypeError):
        raise UserError(f"task.arguments is {text!r}: give arguments by name as JSON, '{{\"size\": 3}}'") from None


def _refuse(name: str, **arguments: Any) -> Any:
    advice = f"name it again, by --env {FAMILY}:{name} or cl.from_gymnasium"
    raise UserError(f"environment {name} is code, which is not imported because a file names it: {advice}")


def _body(factory: Callable[..., Any] | None = None) -> Body:
    make = partial(make_environment, factory)
    return Body(FAMILY, "Gymnasium's own simulation", make, pictures=partial(resolve_name, f"{FRAMES}:GYMNASIUM"))


GYMNASIUM = Task(
    name=FAMILY,
    about="any environment of Gymnasium, as gymnasium:FetchReach-v4; of your own, as gymnasium:package.module:NAME",
    config=GymnasiumConfig,
    bodies=(_body(),),
    longest=lambda config: config.max_steps,
    judge_by=lambda config: SUCCESS if config.succeeds else "return",
    labels_hold=("max_steps", "processes", "succeeds", "cues", "cue_names"),  # a label is about one observation
)


def task_of(name: str, arguments: str = "{}") -> Task:
    """Return the task of an environment: an id of Gymnasium's registry, module:id, or package.module:NAME.

    `arguments`: in JSON. The module is imported, so never give a name from a file. Raises UserError where none is.
    """
    if plugins.REFERENCE.fullmatch(name):
        return task_from(plugins.load(name, object, "an environment"), _arguments(arguments), called=name)
    module, _, own = name.rpartition(":")
    if module:  # Gymnasium's own way to name an id that a package registers
        plugins.load(f"{module}:__name__", str, "a module that registers environments")
    return task_from(own, _arguments(arguments))


def task_from(
    source: Any,
    arguments: Mapping[str, Any] | None = None,
    *,
    called: str | None = None,
    num_envs: int = NUM_ENVS,
    max_steps: int | None = None,
    processes: int = 0,
    cues: Any = (),
    observation: Sequence[Any] | None = None,
    units: Mapping[str, str] | None = None,
) -> Task:
    """Return an environment as a task. One instance is made and plays an episode, to find out its layout.

    `called`: name of code in messages and files (default: its module:NAME). For the others see `cl.from_gymnasium`.
    """
    check_installed()
    check_part(GymnasiumConfig(max_steps=1 if max_steps is None else max_steps), "task")
    factory, name, fetch = None, source, None
    if isinstance(source, str):
        fetch, max_steps = fetch_layout.layout_of(source), max_steps or registry_spec(source).max_episode_steps
    elif callable(source):
        if isinstance(source, partial) and not source.args:  # whose arguments a file would lose
            source, arguments = source.func, {**source.keywords, **(arguments or {})}
        factory = source
        name = called or f"{getattr(source, '__module__', '')}:{getattr(source, '__qualname__', type(source).__name__)}"
    else:
        advice = "give an id of Gymnasium's registry, or a class or function that gives environments"
        raise UserError(f"env is {format_value(source)}: {advice}")
    text = _as_json(dict(arguments or {}))
    actions, slices, limit, succeeds = _tried(Source(name, text, max_steps or 0, 1, factory=factory))
    slices = _with_names(name, slices, observation or fetch, units or {})
    pairs = cues.split(";") if isinstance(cues, str) else cues
    words = tuple(pair if isinstance(pair, str) else ",".join(pair) for pair in pairs if pair)
    is_fetch = not words and fetch is not None
    names, sizes, slice_units, *_ = zip(*slices, strict=True)
    config = GymnasiumConfig(
        environment=name,
        arguments=text,
        max_steps=max_steps or limit or UNLIMITED,
        processes=processes,
        slices=names,
        slice_sizes=sizes,
        units=slice_units,
        slice_kinds=tuple(f"{one.kind} {one.step_deg}" if one.step_deg else one.kind for one in slices),
        **actions._asdict(),
        cues=fetch_layout.CUES if is_fetch else words,
        cue_names=fetch_layout.CUE_NAMES if is_fetch else (),
        succeeds=succeeds,
    )
    _ = config.observation  # raises for units or kinds that do not fit
    lanes: dict[str, Any] = {"guidance": ("none", "relative"), "labels": (100,), "seeds": 1}
    several = min(num_envs, max(1, FIRST_EPISODES // config.max_steps))
    preset = quickstart(config, config.space, several, 10, (64, 64), **lanes)
    changes: dict[str, Any] = {"default": config, "bodies": (_body(factory),), "presets": {QUICKSTART: preset}}
    return dataclasses.replace(GYMNASIUM, about=f"Gymnasium's {name}", **changes)


def _as_json(arguments: dict[str, Any]) -> str:
    with contextlib.suppress(TypeError, ValueError):
        if json.loads(text := json.dumps(arguments, default=np.generic.item)) == arguments:
            return text
    raise UserError(f"arguments are {format_value(arguments)}, which JSON does not keep: give a function that has them")


def _tried(source: Source) -> tuple[Actions, list[Quantity], int, bool]:
    """Play an episode of one instance.

    Return its actions, the slices of an observation, the limit of steps (0: none), and whether it reports success.
    """
    from gymnasium.spaces import flatten

    one, terminated, truncated = Running(source.make, source.name, 0), False, False
    try:
        slices = [Quantity(leaf.name, leaf.size, UNKNOWN_UNIT) for leaf in one.leaves if leaf.size]
        limit, first = _limit(one.env), one.reset(0)
        one.space.seed(0)
        while not (terminated or truncated) and one.steps < min(limit or TRIED, TRIED):
            _, _, terminated, truncated, _ = one.step(np.asarray(flatten(one.space, one.space.sample())))
        if not np.array_equal(first, one.reset(0)):
            raise UserError(
                f"{one.whose} does not repeat itself: with the same seed, its reset gives another observation after an "
                "episode: leave out wrappers that remember, such as NormalizeObservation"
            )
        if all(np.array_equal(first, one.reset(seed)) for seed in (1, 2, 3)):
            console.print(f"{one.whose}: all episodes begin alike, whatever their seed; results hold for this start")
        if not (source.max_steps or limit or truncated):
            console.print(
                f"{one.whose} names no limit of steps: an episode that goes on is truncated after {UNLIMITED:,}, or "
                "after --task.max-steps (in Python max_steps)"
            )
    finally:
        one.close()
    return one.actions, slices, limit, one.reports_success


def _limit(env: Any) -> int:
    """Return the number of steps after which an environment truncates an episode; 0: unknown."""
    limit = getattr(getattr(env, "spec", None), "max_episode_steps", None)
    while not limit and env is not None:
        limit, env = getattr(env, "_max_episode_steps", None), getattr(env, "env", None)
    return int(limit or 0)


def _with_names(
    name: str, slices: Sequence[Quantity], names: Sequence[Any] | None, units: Mapping[str, str]
) -> tuple[Quantity, ...]:
    """Return the slices with names and units that the caller, or this package, knows."""
    rows: Sequence[Any] = names or slices
    try:
        own = [Quantity(*one) for one in rows]
        total, size = (sum(quantity.size for quantity in row) for row in (own, slices))
    except TypeError as error:
        advice = 'give (name, entries, unit) for each slice, as ("goal", 3, "m")'
        raise UserError(f"observation is {format_value(names)}: {advice}") from error
    if any(quantity.origin or quantity.follows for quantity in own):
        raise UserError("observation has an origin or a slice to follow: leave both out, and give adapt the changes=")
    if total != size:
        raise UserError(f"observation names {total} entries, and {name} has {size}: name each entry once")
    vector, order = ([(one.name, one.size) for one in row] for row in (slices, own))
    if vector != order and {*dict(vector)} == {*dict(order)}:
        raise UserError(f"observation is in another order or size than {name}'s vector, {vector}: give these in order")
    if unknown := sorted(set(units) - {quantity.name for quantity in own}):
        there = ", ".join(quantity.name for quantity in own)
        raise UserError(f"units names {unknown[0]!r}, the slices are {there}: name one of them")
    return tuple(quantity._replace(unit=units.get(quantity.name, quantity.unit)) for quantity in own)
