"""Recorded situations as a task: no simulator, no reward; a step goes on to the next situation whatever is done.

    task = task_of("situations", cues="left,right;up,down;open,close")
    env = task.environment(task.plain())

Its configuration says where the situations lie, and how an observation and an action are made up: a policy that was
corrected by labels about them is loaded without the folder.
"""

from __future__ import annotations

import dataclasses
import io
from collections.abc import Callable, Sequence
from functools import lru_cache, partial
from pathlib import Path
from typing import Any, Literal, cast, get_args

import imageio.v2 as imageio
import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Float, Int, PRNGKeyArray

from cuelearner_jax import pictures
from cuelearner_jax.adaptation.by_model import plain_scalars
from cuelearner_jax.adaptation.judging import LABELS
from cuelearner_jax.config import Sizes
from cuelearner_jax.environment import Features, Quantity, WholeObservations
from cuelearner_jax.errors import UserError, suggestion
from cuelearner_jax.guides.relative import KIND
from cuelearner_jax.policies import PolicyNode
from cuelearner_jax.run_config import RunConfig
from cuelearner_jax.spaces import DIRECTIONS, Box, Choices, Space, cues_from
from cuelearner_jax.spaces.box import SHARE
from cuelearner_jax.spaces.choices import STEPS
from cuelearner_jax.storage import situations
from cuelearner_jax.storage.situations import Situations
from cuelearner_jax.task import PAPER, Body, Pictures, Preset, Task
from cuelearner_jax.terminal import console
from cuelearner_jax.types import Reel, Sketch, Step

NAME = "logs"
Actions = Literal["box", "directions", "choices"]
Order = Literal["shuffled", "recorded"]
CLIP_FRAMES, CLIP_PERIOD = 60, 0.1  # of a clip, at most; between two of them [s]
FARTHEST = 5.0  # spreads from the centre, beyond which entries of an observation look alike to networks
FRAME = "action"  # in which networks see: by `Layout.features`


@dataclasses.dataclass(frozen=True)
class LogsConfig:
    """Where situations lie, and what an observation and an action of theirs are."""

    path: str = ""
    """Folder of the situations, or their table."""
    digest: str = ""
    """What tells these situations from others (empty: any will do)."""
    rows: int = 1
    """Number of situations."""
    order: Order = "shuffled"
    """In which they come, one after another from a random one on."""
    names: tuple[str, ...] = ("observation",)
    """Slices of an observation."""
    entries: tuple[int, ...] = (1,)
    """Entries of each slice."""
    actions: Actions = "box"
    """Kind of actions."""
    low: tuple[float, ...] = (-1.0,)
    """Of a box: the lower bound of each entry."""
    high: tuple[float, ...] = (1.0,)
    """Of a box: the upper bound of each entry."""
    cues: tuple[str, ...] = ()
    """Words for more and less of each entry, as "left,right" (default: "more,less")."""
    cue_names: tuple[str, ...] = ()
    """A name for each cue (default: its words)."""
    keys: tuple[str, ...] = ()
    """Keys for more and less of each cue, as "q,a" (default: arrows for left and right, or letters of the words)."""
    centre: tuple[float, ...] = ()
    """What networks subtract of each entry of an observation (default: nothing)."""
    spread: tuple[float, ...] = ()
    """What networks divide the rest by (default: nothing)."""


def space_of(config: LogsConfig) -> Space:
    """The actions of a configuration. Raises UserError for bounds or cues that fit no space."""
    if config.actions == "directions":
        return DIRECTIONS
    unit = STEPS if config.actions == "choices" else SHARE
    cues = cues_from(config.cues, config.cue_names, unit) if config.cues else ()
    if cues and config.keys:
        pairs = [tuple(pair.split(",")) for pair in config.keys]
        if len(pairs) != len(cues) or not all(len(pair) == 2 and all(pair) for pair in pairs):
            raise UserError(f"task.keys is {config.keys}: give two keys for each cue, as q,a")
        cues = tuple(dataclasses.replace(cue, keys=pair) for cue, pair in zip(cues, pairs, strict=True))
    return Choices(len(config.low), *cues) if config.actions == "choices" else Box(config.low, config.high, cues)


class Layout(WholeObservations, struct.PyTreeNode):
    """What policies look at of recorded situations: how they are made up, and how networks see them."""

    observation: tuple[Quantity, ...] = struct.field(pytree_node=False)
    actions: Space = struct.field(pytree_node=False)
    centre: Float[Array, " obs"]
    scale: Float[Array, " obs"]

    def features(self, obs: Float[Array, " obs"], actions: Float[Array, "*n action"]) -> Features:
        """The observation and the actions, each entry of the order of one."""
        own = jnp.clip((obs - self.centre) / self.scale, -FARTHEST, FARTHEST)
        if not isinstance(self.actions, Box):
            return Features(own, jnp.asarray(actions))
        middle = jnp.broadcast_to(self.actions.spread(1)[0], jnp.shape(actions))
        return Features(own, 2 * self.actions.log(middle, actions))


class Place(struct.PyTreeNode):
    """Where a walk is."""

    row: Int[Array, ""]  # of the situation
    met: Int[Array, ""]  # situations of this episode before it


class Logs(Layout):
    """A walk over recorded situations, from a random one on in their order; the first follows the last.

    An episode ends when it has met each situation once. Nothing is rewarded. The metric `change` is how far an action
    is from the recorded one, in the space's unit.
    """

    rows: Float[Array, "n obs"]
    recorded: Float[Array, "n action"]
    places: Int[Array, " n"]  # in the recording, of each row
    path: str = struct.field(pytree_node=False, default="")

    def view(self) -> Layout:
        """The same without the situations."""
        return Layout(self.observation, self.actions, self.centre, self.scale)

    def reset(self, key: PRNGKeyArray) -> tuple[Place, Float[Array, " obs"]]:
        """A random situation."""
        row = jax.random.randint(key, (), 0, len(self.rows))
        return Place(row, jnp.zeros((), jnp.int32)), self.rows[row]

    def step(self, key: PRNGKeyArray, state: Place, action: Float[Array, " action"]) -> tuple[Place, Step]:
        """The next situation, whatever the action is; after all of them a random one."""
        following = Place((state.row + 1) % len(self.rows), state.met + 1)
        final_obs, (anew, first) = self.rows[following.row], self.reset(key)
        change = self.actions.to_unit(self.actions.distance(self.recorded[state.row], action))
        ended = following.met >= len(self.rows)
        state, obs = jax.tree.map(partial(jnp.where, ended), (anew, first), (following, final_obs))
        reward = jnp.zeros(())
        return state, Step(obs, final_obs, final_obs, reward, jnp.array(False), ended, {"change": change}, {})


class Recorded(PolicyNode):
    """The recorded actions: of a state that of its row, else that of the nearest recorded observation."""

    env: Logs

    def act(self, key: PRNGKeyArray, states: Any, obs: Float[Array, "n obs"]) -> Float[Array, "n action"]:
        """What was done, or proposed."""
        env = self.env
        nearest = lambda one: jnp.argmin(jnp.square(env.rows - one[None]).sum(-1))  # noqa: E731
        rows = jax.lax.map(nearest, obs) if states is None else states.row
        return env.actions.retract(env.recorded[rows])

    def describe(self) -> dict[str, Any]:
        """By its name."""
        return {"policy": "recorded"}


def task_of(
    folder: str | Path,
    cues: str | Sequence[Any] = "",
    low: Sequence[float] | None = None,
    high: Sequence[float] | None = None,
    actions: str = "box",
    order: str = "shuffled",
    note: Callable[[str], None] = console.print,
) -> Task:
    """A folder of situations as a task.

    Args:
        folder: see `storage.situations`; a LeRobot dataset folder will do.
        cues: words for more and less of each entry of an action, "left,right;up,down" (default: "more,less").
        low, high: bounds of the actions, one an entry (default: the range of the recorded ones, which `note` is told).
        actions: their kind, "box", "directions" or "choices".
        order: of the situations, "shuffled" or "recorded".
        note: is told what was chosen for want of better, in one line.

    Raises:
        UserError: the situations cannot be read, or bounds or cues do not fit their actions.
    """
    path, found = Path(folder), _read(Path(folder))
    centre, spread = scales_of(found.observations)
    for name, value, kind in (("actions", actions, Actions), ("order", order, Order)):
        if value not in get_args(kind):
            raise UserError(f"{name} is {value!r}{suggestion(value, get_args(kind))}")
    size = found.actions.shape[1]
    if actions == "box":
        bounds = bounds_of(found.actions, low, high, found.entries, note)
    elif low is not None or high is not None:
        raise UserError(f"low and high bound a box, and actions are {actions}: leave them out")
    else:
        bounds = (0.0,) * size, (1.0,) * size
    names = found.entries if actions == "box" else ()
    words = cues or (["more,less"] * size if names else ())
    pairs = cues_from(words, names) if words else ()
    config = LogsConfig(
        path=str(path),
        digest=found.digest,
        rows=len(found.observations),
        order=cast(Order, order),
        names=tuple(quantity.name for quantity in found.slices),
        entries=tuple(quantity.size for quantity in found.slices),
        actions=cast(Actions, actions),
        low=tuple(map(float, bounds[0])),
        high=tuple(map(float, bounds[1])),
        cues=tuple(",".join(cue.words) for cue in pairs),
        cue_names=names if pairs else (),
        centre=centre,
        spread=spread,
    )
    _check_actions(path, found, space_of(config))
    return configured(config)


def configured(config: LogsConfig, body: Body | None = None) -> Task:
    """The task of a configuration, with other situations in it where a `body` holds some."""
    sizes, scalars = Sizes(frame=FRAME), plain_scalars(space_of(config))
    run = RunConfig(config, sizes, scalars)
    preset = Preset("labels about recorded situations", run, (KIND.name,), (200,))
    return dataclasses.replace(LOGS, default=config, presets={PAPER: preset}, bodies=(body or BODY,))


def scales_of(observations: Float[np.ndarray, "n obs"]) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """`centre` and `spread` of a configuration: mean and standard deviation of each entry, 1 where it never changes."""
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
    """Bounds of a box of actions: those that are given, or the range of the actions, which `note` is told.

    Raises UserError for one bound without the other, or an entry that never changes.
    """
    if (low is None) != (high is None):
        raise UserError(f"{'high' if low is None else 'low'} is given alone: give low and high, a number an entry each")
    if low is not None and high is not None:
        return low, high
    least, most = actions.min(0).tolist(), actions.max(0).tolist()
    names = entries or [f"entry {number}" for number in range(1, len(least) + 1)]
    if still := [name for name, a, b in zip(names, least, most, strict=True) if not b > a]:
        raise UserError(f"{still[0]} of the actions never changes, so its bounds are unknown: give low and high")
    told = ", ".join(f"{name} {a:.3g} to {b:.3g}" for name, a, b in zip(names, least, most, strict=True))
    note(f"bounds of the actions are their range ({told}): give low and high for others")
    return least, most


def _check_actions(path: Path, found: Situations, space: Space) -> None:
    """Raises UserError unless the recorded actions are some of a space."""
    if space.size != found.actions.shape[1]:
        raise UserError(
            f"{path} has actions of {found.actions.shape[1]} entries, {space.name} have {space.size}: give another kind"
        )
    apart = np.abs(np.asarray(space.retract(found.actions)) - found.actions).max(-1)
    wrong = np.flatnonzero(~(apart <= 1e-3 * max(1.0, float(np.abs(found.actions).max()))))
    if len(wrong):
        action = ", ".join(f"{value:.3g}" for value in found.actions[wrong[0]])
        what = "bounds that hold the recorded actions" if space.name == "box" else "another kind of actions"
        raise UserError(f"{path}: the action of row {wrong[0]} ({action}) is none of {space.about}: give {what}")


@lru_cache(maxsize=4)
def _read(path: Path) -> Situations:
    """Situations, read once."""
    return situations.read(path)


def filled(config: LogsConfig, observations: Any = None, actions: Any = None) -> Logs:
    """The environment of situations (n, obs) and (n, action) in their order; of zeros where none are given.

    Raises UserError for a configuration that describes none.
    """
    space, size = space_of(config), sum(config.entries)
    sound = len(config.names) == len(config.entries) and min(config.entries, default=0) > 0 and config.rows > 0
    if not sound or not all(len(part) in (0, size) for part in (config.centre, config.spread)):
        raise UserError(
            "task.names, entries, rows, centre or spread describe no situations: give the folder by logs:FOLDER"
        )
    if not all(value > 0 for value in config.spread):
        raise UserError(f"task.spread is {config.spread}: give a number above 0 for each entry of an observation")
    slices = (Quantity(name, size, "1", "as recorded") for name, size in zip(config.names, config.entries, strict=True))
    if observations is None:
        observations, actions = jnp.zeros((config.rows, size)), jnp.zeros((config.rows, space.size))
    centre = jnp.asarray(config.centre or (0.0,) * size, jnp.float32)
    scale = jnp.asarray(config.spread or (1.0,) * size, jnp.float32)
    rows, recorded, places = jnp.asarray(observations), jnp.asarray(actions), jnp.arange(len(observations))
    return Logs(tuple(slices), space, centre, scale, rows, recorded, places, config.path)


def _environment(config: LogsConfig, split: str) -> Logs:
    """The situations of a configuration, which are the same in every split.

    Raises UserError where they are not there, or are others.
    """
    if not config.path:
        raise UserError("no situations are given: name their folder, as logs:FOLDER or by --task.path")
    found, layout = _read(Path(config.path)), filled(config)
    if config.digest not in ("", found.digest):
        raise UserError(f"{config.path} holds other situations than it did: give the folder as it was, or label anew")
    if (found.observations.shape[1], found.actions.shape[1]) != (layout.obs_size, layout.actions.size):
        raise UserError(
            f"{config.path} has observations of {found.observations.shape[1]} entries and actions of "
            f"{found.actions.shape[1]}, not {layout.obs_size} and {layout.actions.size}: give another folder"
        )
    places = np.arange(len(found.observations))
    if config.order == "shuffled":
        places = np.random.default_rng(0).permutation(places)
    made = filled(config, found.observations[places], found.actions[places])
    return made.replace(places=jnp.asarray(places, jnp.int32))


# --- pictures --------------------------------------------------------------------------------------------------------


def _picture(env: Logs, row: Any) -> tuple[situations.Picture, int]:
    """The picture of a row, and its place in the recording. Raises UserError if there is none."""
    if not env.path:
        raise UserError("these situations are those of labels, without pictures: name their folder, as logs:FOLDER")
    place = int(env.places[row])
    found = _read(Path(env.path)).picture(place)
    if found is None:
        raise UserError(f"{env.path} has no picture of row {place}: add a column `picture` with the name of its file")
    return found, place


def _frames(picture: situations.Picture) -> list[Any]:
    """The frames of a picture, of a clip several. Raises UserError if it cannot be read."""
    if picture.kind.startswith("image/") and picture.kind != "image/gif":
        return [picture.data]
    try:
        suffix = "." + picture.kind.partition("/")[2]
        found = imageio.mimread(io.BytesIO(picture.data), format=suffix, memtest=False)  # pyright: ignore
    except Exception as error:  # readers of films raise many kinds
        raise UserError(f"a clip cannot be read ({' '.join(str(error).split())[:80]}): give GIF or MP4") from error
    chosen = np.unique(np.linspace(0, len(found) - 1, min(len(found), CLIP_FRAMES)).round().astype(int))
    return [np.ascontiguousarray(np.asarray(found[number])[..., :3]) for number in chosen]


def _sketch(env: Logs, state: Place) -> Sketch:
    """The picture of a situation; of a clip its first frame."""
    picture, place = _picture(env, state.row)
    return pictures.sketch(_frames(picture)[0], f"situation {place}")


def _reel(env: Logs, state: Place, action: Any) -> Reel | None:
    """A situation's clip, as recorded; None: it has a picture alone."""
    frames = _frames(_picture(env, state.row)[0])
    return pictures.clip(frames, CLIP_PERIOD, "as recorded") if len(frames) > 1 else None


def _record(env: Logs, policy: Any, key: PRNGKeyArray, steps: int) -> tuple[list[Any], list[float]]:
    """A picture a situation, one after another; there are no rewards."""
    rows = [row % len(env.rows) for row in range(steps)]
    return [pictures.pixels(_frames(_picture(env, row)[0])[0]) for row in rows], [0.0] * steps


def _question(env: Logs, state: Place, obs: Any, action: Any, file: Path) -> None:
    """The picture of a situation as PNG."""
    pictures.still(_frames(_picture(env, state.row)[0])[:1], file)


PICTURES = Pictures(
    record=_record,
    still=lambda env, frames, file: pictures.still(frames, file),
    animate=lambda env, frames, file: pictures.animate(frames, file, fps=4.0),
    question=_question,
    sketch=_sketch,
    reel=_reel,
    simulates=False,
)
BODY = Body("recording", "situations as they were recorded", _environment, pictures=lambda: PICTURES, filled=filled)
LOGS = Task(
    name=NAME,
    about="recorded situations, without a simulator: name their folder, as logs:FOLDER",
    config=LogsConfig,
    bodies=(BODY,),
    proposed=Recorded,
    # A label is of what was seen and proposed, wherever that lies now.
    labels_hold=("path", "digest", "rows", "order", "cues", "cue_names", "keys", "centre", "spread"),
    files=lambda config: {"path": config.digest} if config.path else {},
    judge_by=lambda config: LABELS,
)
