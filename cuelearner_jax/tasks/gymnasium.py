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
from typing import Any

import numpy as np

from cuelearner_envs.bounds import MOST_STEPS, check_number
from cuelearner_jax import plugins
from cuelearner_jax.adaptation.by_model import plain_scalars
from cuelearner_jax.agents import ddqn
from cuelearner_jax.arbiters import Paced
from cuelearner_jax.bridges.gymnasium.environment import SUCCESS, GymnasiumTask
from cuelearner_jax.bridges.gymnasium.instances import Running, success_in
from cuelearner_jax.bridges.gymnasium.layout import Actions, actions_of
from cuelearner_jax.bridges.gymnasium.source import Source, check_installed, registry_spec
from cuelearner_jax.config import Schedule, Sizes
from cuelearner_jax.environment import UNKNOWN_UNIT, Quantity, checked_quantities
from cuelearner_jax.errors import UserError, format_value, user_code_error
from cuelearner_jax.plugins import REFERENCE
from cuelearner_jax.run_config import RunConfig
from cuelearner_jax.spaces import Box, Choices, Space, cues_from
from cuelearner_jax.task import Body, Pictures, Preset, Task
from cuelearner_jax.tasks import fetch_layout
from cuelearner_jax.terminal import console

FAMILY = "gymnasium"
NUM_ENVS = 8
UNLIMITED = 1_000  # steps of an episode, where neither environment nor caller gives a limit
TRIED = 1_000  # most steps of an episode, to find out whether the environment reports success
MOST_PROCESSES = 256


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
    max_steps: int = 1
    """Largest number of steps of an episode, after which it is truncated."""
    processes: int = 0
    """Number of processes that run environments (0: one per processor; 1: run them in the training process)."""
    slices: tuple[str, ...] = ()
    """Layout: names of an observation's slices."""
    slice_sizes: tuple[int, ...] = ()
    """Layout: numbers in each slice."""
    units: tuple[str, ...] = ()
    """Layout: unit of each slice; those in m or rad may shift, by what answers say."""
    slice_kinds: tuple[str, ...] = ()
    """Layout: own, for a slice that a robot measures of itself, or beams, or directions."""
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
        """The slices of an observation. Raises UserError where their columns do not fit together."""
        rows = self.slices, self.slice_sizes, self.units, self.slice_kinds
        if not self.slices or len({len(row) for row in rows}) > 1 or not all(size > 0 for size in self.slice_sizes):
            raise UserError(
                f"task.slices is {format_value(self.slices)} of task.slice_sizes {format_value(self.slice_sizes)}: "
                f"give a name, a size, a unit and a kind for each slice, or name the task {FAMILY}:ENVIRONMENT, which "
                "fills them"
            )
        known = {quantity.name: quantity.about for quantity in fetch_layout.layout_of(self.environment) or ()}
        return checked_quantities(
            Quantity(name, size, unit, known.get(name, ""), kind) for name, size, unit, kind in zip(*rows, strict=True)
        )

    @property
    def space(self) -> Space:
        """The space of actions. Raises UserError where none fits."""
        return space_of(Actions(self.low, self.high, self.choices), self.cues, self.cue_names)


def space_of(actions: Actions, cues: Sequence[str] = (), cue_names: Sequence[str] = ()) -> Space:
    """Return the space of actions. Raises UserError for bounds or cues that fit none."""
    if actions.choices:
        if cues:
            raise UserError(
                f"cues is {format_value(tuple(cues))}, but actions are choices without an order: leave it out, and "
                "choose a guidance without relative answers"
            )
        return Choices(actions.choices)
    if cues and len(cues) != actions.size:
        raise UserError(
            f"cues are {len(cues)} pairs of words, and an action has {actions.size} entries: give a pair for each"
        )
    return Box(actions.low, actions.high, cues_from(cues, cue_names) if cues else ())


def _refusal(config: GymnasiumConfig) -> str:
    """Return why a configuration from a file cannot be made (it names code); empty if it can."""
    if ":" not in config.environment:
        return ""
    return (
        f"environment {config.environment} is code, which is not imported because a file names it: name it again, as "
        f"{FAMILY}:{config.environment} in place of the task, or by cl.from_gymnasium"
    )


def make_environment(factory: Callable[..., Any] | None, config: GymnasiumConfig, split: str) -> GymnasiumTask:
    """Return the environment of a configuration; Gymnasium is loaded only when it is reset.

    Args:
        factory: makes the environment; None: Gymnasium's registry.
        config: the configuration.
        split: has no effect, since episodes differ only in their keys.

    Raises:
        UserError: an invalid value.
    """
    if not config.environment:
        raise UserError(f"task.environment is empty: name the task {FAMILY}:ENVIRONMENT, as {FAMILY}:FetchReach-v4")
    check_number("max_steps", config.max_steps, 1, MOST_STEPS, whole=True)
    check_number("processes", config.processes, 0, MOST_PROCESSES, whole=True)
    check_number("choices", config.choices, 0, MOST_STEPS, whole=True)
    observation = config.observation
    size = sum(quantity.size for quantity in observation)
    _arguments(config.arguments)
    return GymnasiumTask(
        source=Source(config.environment, config.arguments, config.max_steps, config.processes, size, factory),
        observation=observation,
        actions=config.space,
        succeeds=config.succeeds,
        refusal="" if factory else _refusal(config),
    )


def _arguments(text: str) -> dict[str, Any]:
    try:
        found = json.loads(text)
    except ValueError:
        found = None
    if not isinstance(found, dict):
        raise UserError(
            f"task.arguments is {format_value(text)}: give arguments by name as JSON, such as " + "'{\"size\": 3}'"
        )
    return found


def _longest(config: GymnasiumConfig) -> int:
    return config.max_steps


def _judge_by(config: GymnasiumConfig) -> str:
    return SUCCESS if config.succeeds else "return"


def _pictures() -> Pictures:
    from cuelearner_jax.tasks import gymnasium_pictures  # Pillow's loading is not for every command

    return gymnasium_pictures.PICTURES


def body(factory: Callable[..., Any] | None = None) -> Body:
    """Return the body that acts in the task."""
    return Body(FAMILY, "Gymnasium's own simulation", partial(make_environment, factory), pictures=_pictures)


GYMNASIUM = Task(
    name=FAMILY,
    about="any environment of Gymnasium, as gymnasium:FetchReach-v4; of your own, as gymnasium:package.module:NAME",
    config=GymnasiumConfig,
    bodies=(body(),),
    longest=_longest,
    judge_by=_judge_by,
    labels_hold=("max_steps", "processes", "succeeds"),  # a label depends on one observation only
)


def task_of(name: str) -> Task:
    """Return the task of an environment: an id of Gymnasium's registry, module:id, or package.module:NAME.

    The module is imported.

    Call this only with names from a caller or the command line, never from a file. Raises UserError if the environment
    is not available.
    """
    if REFERENCE.fullmatch(name):
        return task_from(plugins.load(name, object, "an environment"), called=name)
    module, _, own = name.rpartition(":")
    if module:  # Gymnasium's own way to name an id that a package registers
        plugins.load(f"{module}:__name__", str, "a module that registers environments")
    return task_from(own, called=own)


def task_from(
    given: Any,
    arguments: Mapping[str, Any] | None = None,
    *,
    called: str | None = None,
    num_envs: int = NUM_ENVS,
    max_steps: int | None = None,
    processes: int = 0,
    cues: Any = (),
    observation: Sequence[Any] | None = None,
    units: Mapping[str, str] | None = None,
    note: Callable[[str], None] = console.print,
) -> Task:
    """Return an environment as a task. One instance is made and plays an episode, to find out its layout.

    Args:
        given: an id of Gymnasium's registry, or a class or function that returns an environment.
        arguments: arguments of the environment, by name.
        called: name of code in messages and files (default: its module:NAME).
        num_envs, max_steps, processes, cues, observation, units: see `cl.from_gymnasium`.
        note: called with one line if a limit of steps had to be chosen.

    Raises:
        UserError: the environment cannot be made, or its spaces are not supported.
    """
    check_installed()
    factory = None if isinstance(given, str) else given
    if factory is not None and not callable(factory):
        raise UserError(
            f"env is {format_value(given)}: give an id of Gymnasium's registry, or a class or function that "
            "gives environments"
        )
    name = given if isinstance(given, str) else called or _called(given)
    if factory is None and not max_steps:
        max_steps = registry_spec(name).max_episode_steps
    text = _kept(name, arguments or {})
    source = Source(name, text, max_steps or 0, 1, factory=factory)
    actions, slices, limit, succeeds, ends = _seen(source)
    if not max_steps and not limit:
        if not ends:
            note(
                f"environment {name} has no limit of steps: an episode is truncated after {UNLIMITED:,} (give "
                "--task.max-steps, or max_steps in Python, for another limit)"
            )
        limit = UNLIMITED
    fetch = fetch_layout.layout_of(name) if factory is None else None
    slices = _named(name, slices, observation or fetch, units or {})
    pairs = cues.split(";") if isinstance(cues, str) else cues
    words = [pair if isinstance(pair, str) else ",".join(pair) for pair in pairs if pair]
    names: tuple[str, ...] = ()
    if not words and fetch and len(actions.low) == len(fetch_layout.CUES):
        words, names = list(fetch_layout.CUES), fetch_layout.CUE_NAMES
    config = GymnasiumConfig(
        environment=name,
        arguments=text,
        max_steps=max_steps or limit,
        processes=processes,
        slices=tuple(quantity.name for quantity in slices),
        slice_sizes=tuple(quantity.size for quantity in slices),
        units=tuple(quantity.unit for quantity in slices),
        slice_kinds=tuple(quantity.kind for quantity in slices),
        low=actions.low,
        high=actions.high,
        choices=actions.choices,
        cues=tuple(words),
        cue_names=names,
        succeeds=succeeds,
    )
    _ = config.space, config.observation  # raises for cues, units or kinds that do not fit
    return dataclasses.replace(
        GYMNASIUM,
        about=f"Gymnasium's {name}",
        default=config,
        bodies=(body(factory),),
        presets=presets(config, num_envs),
    )


def _kept(name: str, arguments: Mapping[str, Any]) -> str:
    """Return arguments as JSON for a file."""
    try:
        return json.dumps(dict(arguments))
    except (TypeError, ValueError) as error:
        raise UserError(
            f"the arguments of {name} cannot be kept in a file ({error}): give a function that makes the environment "
            "with them"
        ) from error


def _called(code: Any) -> str:
    """Return the name of code for files; nothing is imported by this name."""
    inner = getattr(code, "func", code)
    return f"{getattr(inner, '__module__', '')}:{getattr(inner, '__qualname__', type(inner).__name__)}"


def _seen(source: Source) -> tuple[Actions, list[Quantity], int, bool, bool]:
    """Return an environment's layout: actions, slices of an observation, limit of steps (0: none), whether it reports
    success within an episode, and whether that episode ended by itself."""
    whose, when, succeeds = f"environment {source.name}", "in its first reset,", False
    try:
        env = source.make()
    except UserError:
        raise
    except Exception as error:
        raise user_code_error(f"{whose}, while it was made,", error) from error
    try:
        if hasattr(env, "num_envs"):
            raise UserError(
                f"{whose} is a vector of {env.num_envs} environments: give a function that makes a single one"
            )
        actions = actions_of(whose, env.action_space)
        one = Running(env, source.name)
        slices = [Quantity(leaf.name, leaf.size, UNKNOWN_UNIT) for leaf in one.leaves if leaf.size]
        if not slices:
            raise UserError(f"{whose}: an observation has no entries: give one with some")
        limit = _limit(env)
        first, ended, cut = one.reset(0), False, False
        env.action_space.seed(0)
        for number in range(1, 1 + min(limit or TRIED, TRIED)):
            when = f"in step {number} of its first episode,"
            _, _, ended, cut, info = env.step(env.action_space.sample())
            succeeds = succeeds or success_in(source.name, info) is not None
            if ended or cut:
                break
        when = "in a second reset with the same seed,"
        if not np.array_equal(first, one.reset(0)):
            raise UserError(
                f"{whose} does not repeat itself: with the same seed, its reset gives another observation after an "
                "episode: leave out wrappers that remember, such as NormalizeObservation"
            )
    except UserError:
        raise
    except Exception as error:
        raise user_code_error(f"{whose}, {when}", error) from error
    finally:
        with contextlib.suppress(Exception):  # what closing raises is no fault of the episodes
            env.close()
    return actions, slices, limit, succeeds, bool(ended or cut)


def _limit(env: Any) -> int:
    """Return the number of steps after which an environment truncates an episode; 0: unknown."""
    spec = getattr(env, "spec", None)
    limit = getattr(spec, "max_episode_steps", None)
    while not limit and env is not None:
        limit, env = getattr(env, "_max_episode_steps", None), getattr(env, "env", None)
    return int(limit or 0)


def _named(
    name: str, slices: list[Quantity], given: Sequence[Any] | None, units: Mapping[str, str]
) -> tuple[Quantity, ...]:
    """Return the slices with names and units that the caller, or this package, knows."""
    if given is not None:
        try:
            rest = list(Quantity("", 0, ""))[3:]  # said by a whole Quantity alone
            found = tuple(one if isinstance(one, Quantity) else Quantity._make([*one, *rest]) for one in given)
            total = sum(quantity.size for quantity in found)
        except TypeError as error:
            raise UserError(
                f'observation is {format_value(given)}: give (name, entries, unit) for each slice, as ("goal", 3, "m") '
                'or cuelearner_jax.environment.Quantity("goal", 3, "m", kind="own")'
            ) from error
        wanted = sum(quantity.size for quantity in slices)
        if total != wanted:
            raise UserError(f"observation names {total} entries, and {name} has {wanted}: name each entry once")
    else:
        found = tuple(slices)
    known = {quantity.name for quantity in found}
    if unknown := sorted(set(units) - known):
        raise UserError(f"units names {unknown[0]!r}, and the slices are {', '.join(sorted(known))}: name one of them")
    return tuple(quantity._replace(unit=units.get(quantity.name, quantity.unit)) for quantity in found)


def presets(config: GymnasiumConfig, num_envs: int = NUM_ENVS) -> dict[str, Preset]:
    """Return the presets of one environment."""
    every = num_envs * -(-1_000 // num_envs)
    eval_envs = 10
    run = RunConfig(
        config,
        Sizes(num_envs=num_envs, feedback_layers=(64, 64), fit_steps=400, fit_batch_size=64),
        dataclasses.replace(plain_scalars(config.space), discount=0.95, max_grad_norm=10.0),
        Schedule(
            total_steps=6 * every,
            random_steps=500,
            learn_after=500,
            guidance_until=3 * every,
            eval_every=every,
            eval_steps=eval_envs * config.max_steps,
            eval_envs=eval_envs,
            checkpoint_every=2 * every,
        ),
        ddqn.Config(
            q_layers=(128, 128),
            directions=256,
            target_directions=64,
            batch_size=64,
            replay_capacity=num_envs * -(-50_000 // num_envs),
            optimizer="adam",
            learning_rate=0.001,
            polyak=0.05,
        ),
        Paced(),
    )
    about = f"small networks, {6 * every:,} steps a seed"
    return {"quickstart": Preset(about, run, guidance=("none", "relative"), labels=(100,), seeds=1)}
