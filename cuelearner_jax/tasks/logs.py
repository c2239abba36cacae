"""Recorded situations as a task without simulator and reward; each step moves to the next situation.

    task = task_of("situations", cues="left,right;up,down;open,close")
    env = task.environment(task.plain())

The configuration gives the situations' path and the layout of observations and actions, so that a policy corrected by
labels about them is loaded without the folder.
"""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any, Literal, cast, get_args

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Float, Int, PRNGKeyArray

from cuelearner_jax.adaptation.by_model import plain_scalars
from cuelearner_jax.adaptation.judging import LABELS
from cuelearner_jax.config import Sizes
from cuelearner_jax.environment import BASE, EFFECT, PROPOSED, Features, Quantity, WholeObservations, offers
from cuelearner_jax.errors import UserError, suggestion
from cuelearner_jax.feedback.external_labels import action_error
from cuelearner_jax.guides.relative import Relative
from cuelearner_jax.policies import Heuristic, PolicyNode
from cuelearner_jax.run_config import RunConfig
from cuelearner_jax.spaces import DIRECTIONS, Box, Choices, Space, cues_from
from cuelearner_jax.spaces.box import SHARE
from cuelearner_jax.spaces.choices import STEPS
from cuelearner_jax.storage import situations
from cuelearner_jax.task import PAPER, Body, Preset, Task
from cuelearner_jax.tasks.logs_pictures import PICTURES
from cuelearner_jax.terminal import console
from cuelearner_jax.types import Action, Observation, Step

NAME = "logs"
Actions = Literal["box", "directions", "choices"]
Order = Literal["shuffled", "recorded"]
FARTHEST = 5.0  # networks' input entries are clipped at this many spreads from the centre
FRAME = "action"  # frame of the networks' input, computed by `Logs.features`


@dataclasses.dataclass(frozen=True)
class LogsConfig:
    """Path of recorded situations, and the layout of their observations and actions."""

    path: str = ""
    """Folder of the situations, or the path of their table."""
    digest: str = ""
    """Digest of the situations, which is verified (empty: accept any situations)."""
    rows: int = 1
    """Number of situations."""
    order: Order = "shuffled"
    """Order of the situations, from a random one on."""
    names: tuple[str, ...] = ("observation",)
    """Names of the slices of an observation."""
    entries: tuple[int, ...] = (1,)
    """Number of entries of each slice."""
    actions: Actions = "box"
    """Kind of action space."""
    low: tuple[float, ...] = (-1.0,)
    """Lower bound of each entry of a box."""
    high: tuple[float, ...] = (1.0,)
    """Upper bound of each entry of a box."""
    cues: tuple[str, ...] = ()
    """Words for more and less of each entry, as "left,right" (default: "more,less")."""
    cue_names: tuple[str, ...] = ()
    """A name for each cue (default: its words)."""
    keys: tuple[str, ...] = ()
    """Keys for more and less of each cue, as "q,a" (default: arrows for left and right, or letters of the words)."""
    centre: tuple[float, ...] = ()
    """Value subtracted from each entry of an observation before networks see it (default: 0)."""
    spread: tuple[float, ...] = ()
    """Value by which each entry is divided afterwards (default: 1)."""
    hand: str = ""
    """Kinematics of the robot whose hand's positions the actions are, as JSON (empty: they are the robot's own)."""


def space_of(config: LogsConfig) -> Space:
    """Return a configuration's action space. Raises UserError for bounds or cues that fit no space."""
    if config.actions == "directions":
        return DIRECTIONS
    unit = STEPS if config.actions == "choices" else SHARE
    cues = cues_from(config.cues, config.cue_names, unit) if config.cues else ()
    if cues and config.keys:
        pairs = [tuple(filter(None, pair.split(","))) for pair in config.keys]
        if len(pairs) != len(cues) or not {*map(len, pairs)} <= {0, 2}:
            raise UserError(f"task.keys is {' '.join(config.keys)}: give two keys for each of {len(cues)} cues, as q,a")
        cues = tuple(dataclasses.replace(cue, keys=pair) for cue, pair in zip(cues, pairs, strict=True))
    return Choices(len(config.low), *cues) if config.actions == "choices" else Box(config.low, config.high, cues)


class SituationState(struct.PyTreeNode):
    """Position in a walk over the situations."""

    row: Int[Array, ""]  # of the situation
    count: Int[Array, ""]  # number of situations before it in this episode


class Logs(WholeObservations, struct.PyTreeNode):
    """A walk over recorded situations in their order, from a random one on; after the last comes the first.

    An episode ends when it has met each situation once. There is no reward. The metric `change` is the distance of an
    action from the recorded action, in the space's unit.
    """

    observation: tuple[Quantity, ...] = struct.field(pytree_node=False)
    actions: Space = struct.field(pytree_node=False)
    centre: Float[Array, " obs"]
    scale: Float[Array, " obs"]
    rows: Any = None  # (n, obs); None in a view, which has no situations
    recorded: Any = None  # (n, action)
    places: Any = None  # (n,) each row's place in the recording
    path: str = struct.field(pytree_node=False, default="")

    def view(self) -> Logs:
        """Return the layout without the situations."""
        return Logs(self.observation, self.actions, self.centre, self.scale)

    def features(self, obs: Observation, actions: Float[Array, "*n action"]) -> Features:
        """Return the observation and actions, scaled to entries of the order of 1."""
        own = jnp.clip((obs - self.centre) / self.scale, -FARTHEST, FARTHEST)
        if not isinstance(self.actions, Box):
            return Features(own, jnp.asarray(actions))
        middle = jnp.broadcast_to(self.actions.spread(1)[0], jnp.shape(actions))
        return Features(own, 2 * self.actions.log(middle, actions))

    @property
    def heuristic(self) -> Callable[[Observation], Action] | None:
        """The proposed action of an observation that holds it; None where observations hold none."""
        if not self.observation or self.observation[-1].kind != PROPOSED:
            return None
        return lambda obs: self.actions.retract(obs[-self.actions.size :])

    def reset(self, key: PRNGKeyArray) -> tuple[SituationState, Observation]:
        """Return a random situation."""
        row = jax.random.randint(key, (), 0, len(self.rows))
        return SituationState(row, jnp.zeros((), jnp.int32)), self.rows[row]

    def step(self, key: PRNGKeyArray, state: SituationState, action: Action) -> tuple[SituationState, Step]:
        """Return the next situation, whatever the action; after all of them a random one."""
        following = SituationState((state.row + 1) % len(self.rows), state.count + 1)
        final_obs, (anew, first) = self.rows[following.row], self.reset(key)
        change = self.actions.to_unit(self.actions.distance(self.recorded[state.row], action))
        ended = following.count >= len(self.rows)
        state, obs = jax.tree.map(partial(jnp.where, ended), (anew, first), (following, final_obs))
        return state, Step(obs, final_obs, final_obs, jnp.zeros(()), jnp.array(False), ended, {"change": change}, {})


class Recorded(PolicyNode):
    """The recorded actions: those of the states' rows, or else of the nearest recorded observations."""

    KIND = "recorded"

    env: Logs

    def act(self, key: PRNGKeyArray, states: Any, obs: Float[Array, "n obs"]) -> Float[Array, "n action"]:
        """Return the recorded actions (n, action)."""
        env = self.env
        nearest = lambda one: jnp.argmin(jnp.square(env.rows - one[None]).sum(-1))  # noqa: E731
        return env.actions.retract(env.recorded[jax.lax.map(nearest, obs) if states is None else states.row])


def task_of(
    folder: str | Path,
    cues: str | Sequence[Any] = "",
    low: Sequence[float] | None = None,
    high: Sequence[float] | None = None,
    actions: str = "box",
    note: Callable[[str], None] = console.print,
) -> Task:
    """Return a folder of situations as a task.

    Args:
        folder: see `storage.situations`; a LeRobot dataset folder is read too.
        cues: words for more and less of each entry of an action, "left,right;up,down" (default: "more,less").
        low, high: bounds of the actions, one per entry (default: the recorded actions' range, reported by `note`).
        actions: kind of action space, "box", "directions" or "choices".
        note: called with one line about each value that had to be chosen.
    """
    recording = situations.read_once(Path(folder))
    if actions not in get_args(Actions):
        raise UserError(f"actions is {actions!r}{suggestion(actions, get_args(Actions))}")
    size, names = recording.actions.shape[1], ()
    bounds: Any = (0.0,) * size, (1.0,) * size
    if actions == "box":
        if recording.about and low is None and high is None:
            low, high = recording.about["low"], recording.about["high"]
        names, bounds = recording.entries, bounds_of(recording.actions, low, high, recording.entries, note)
    elif low is not None or high is not None:
        raise UserError(f"low and high are bounds of a box, but actions are {actions}: leave them out")
    words = cues or ["more,less"] * len(names)
    pairs = cues_from(words, names) if words else ()
    centre, spread = scales_of(recording.observations)
    config = LogsConfig(
        path=str(Path(folder)),
        digest=recording.digest,
        rows=len(recording.observations),
        names=tuple(quantity.name for quantity in recording.slices),
        entries=tuple(quantity.size for quantity in recording.slices),
        actions=cast(Actions, actions),
        low=tuple(map(float, bounds[0])),
        high=tuple(map(float, bounds[1])),
        cues=tuple(",".join(cue.words) for cue in pairs),
        cue_names=names if pairs else (),
        centre=centre,
        spread=spread,
        hand=json.dumps(recording.about["hand"]) if "hand" in recording.about else "",
    )
    space = space_of(config)
    near = space.size == size and np.abs(space.retract(recording.actions) - recording.actions) <= action_error(space)
    if not np.all(near):  # what `retract` makes NaN is not near either
        remedy = "bounds that hold the recorded actions" if actions == "box" else "another kind of actions"
        raise UserError(
            f"{folder}: its actions are not all {space.about} ({space.name}, {space.size} entries): give {remedy}"
        )
    return configured(config)


def configured(config: LogsConfig, body: Body | None = None) -> Task:
    """Return the task of a configuration; `body` gives it other situations."""
    run = RunConfig(config, Sizes(frame=FRAME), plain_scalars(space_of(config)))
    preset = Preset("labels about recorded situations", run, (Relative.name,), (200,))
    return dataclasses.replace(LOGS, default=config, presets={PAPER: preset}, bodies=(body or BODY,))


def scales_of(observations: Float[np.ndarray, "n obs"]) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Return `centre` and `spread` of a configuration: mean and standard deviation per entry (1 if constant)."""
    rounded = lambda values: tuple(float(f"{value:.6g}") for value in values)  # noqa: E731
    with np.errstate(over="ignore"):
        spread = observations.std(0, dtype=np.float64)
    still = ~(spread > 1e-6 * np.maximum(np.abs(observations).max(0), 1e-12))
    return rounded(observations.mean(0, dtype=np.float64)), rounded(np.where(still, 1.0, spread))


def bounds_of(
    actions: Float[np.ndarray, "n action"],
    low: Sequence[float] | None,
    high: Sequence[float] | None,
    entries: Sequence[str] = (),
    note: Callable[[str], None] = console.print,
) -> tuple[Sequence[float], Sequence[float]]:
    """Return the bounds of a box of actions: the given ones, or the range of the actions, reported by `note`."""
    if low is not None and high is not None:
        return low, high
    if low is not None or high is not None:
        raise UserError(f"{'low' if high is None else 'high'} is given alone: give both low and high")
    least, most = actions.min(0).tolist(), actions.max(0).tolist()
    names = entries or [f"entry {number}" for number in range(1, len(least) + 1)]
    if still := [name for name, a, b in zip(names, least, most, strict=True) if not b > a]:
        raise UserError(f"{still[0]} of the actions never changes, so its bounds are unknown: give low and high")
    ranges = ", ".join(f"{name} {a:.3g} to {b:.3g}" for name, a, b in zip(names, least, most, strict=True))
    note(f"bounds of the actions are their range ({ranges}): give low and high for others")
    return least, most


def filled(config: LogsConfig, observations: Any = None, actions: Any = None) -> Logs:
    """Return the environment of situations (n, obs) and (n, action) in their order; zeros where none are given."""
    space, size = space_of(config), sum(config.entries)
    slices = [Quantity(name, size, "1", "as recorded") for name, size in zip(config.names, config.entries, strict=True)]
    if slices[-1].name == BASE and slices[-1].size == space.size:
        slices[-1] = slices[-1]._replace(kind=PROPOSED)
        if slices[-2:][0].name == EFFECT:
            slices[-2] = slices[-2]._replace(kind=EFFECT)
    if observations is None:
        observations, actions = jnp.zeros((config.rows, size)), jnp.zeros((config.rows, space.size))
    centre = jnp.asarray(config.centre or (0.0,) * size, jnp.float32)
    scale = jnp.asarray(config.spread or (1.0,) * size, jnp.float32)
    rows, recorded, places = jnp.asarray(observations), jnp.asarray(actions), jnp.arange(len(observations))
    return Logs(tuple(slices), space, centre, scale, rows, recorded, places, config.path)


def _environment(config: LogsConfig, split: str) -> Logs:
    """Return the situations of a configuration, which are equal in every split."""
    if not config.path:
        raise UserError("no situations are given: name their folder, as logs:FOLDER or by --task.path")
    recording, layout = situations.read_once(Path(config.path)), filled(config)
    if config.digest not in ("", recording.digest):
        raise UserError(f"{config.path} holds other situations than before: restore the folder, or collect new labels")
    sizes = (recording.observations.shape[1], recording.actions.shape[1])
    if sizes != (own := (layout.obs_size, layout.actions.size)):
        raise UserError(f"{config.path} has observations and actions of {sizes} entries, not {own}: give another")
    places = np.arange(len(recording.observations))
    if config.order == "shuffled":
        places = np.random.default_rng(0).permutation(places)
    env = filled(config, recording.observations[places], recording.actions[places])
    return env.replace(places=jnp.asarray(places, jnp.int32))


BODY = Body("recording", "situations as they were recorded", _environment, pictures=lambda: PICTURES, filled=filled)
LOGS = Task(
    name=NAME,
    about="recorded situations, without a simulator: name their folder, as logs:FOLDER",
    config=LogsConfig,
    bodies=(BODY,),
    proposed=lambda env: Heuristic(env.view()) if offers(env, "heuristic") else Recorded(env),
    # A label depends on what was seen and proposed, wherever the files lie now.
    labels_hold=("path", "digest", "rows", "order", "cues", "cue_names", "keys", "centre", "spread"),
    files=lambda config: {"path": config.digest} if config.path else {},
    judge_by=lambda config: LABELS,
    less_is_better=(*Task.less_is_better, "change"),
)
