"""Instances of one environment, which reset, step and replay: the work of one process of the pool.

Observations become vectors, and vectors become actions. This module imports neither JAX nor Gymnasium, so that worker
processes start quickly.

Where an instance stands is named by a chain of hashes: of the seed and the first observation, then of each action with
the observation, reward and end that followed. Equal places have equal names. An environment that does not repeat itself
comes to another name, which is reported.
"""

from __future__ import annotations

import contextlib
import hashlib
import math
import struct
from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np

from cuelearner_jax.errors import UserError, format_value, user_code_error

SUCCESS = ("success", "is_success", "succeed")  # names in `info`
PLACE_BYTES = 8
MOST_INSTANCES = 1024  # spare instances, beyond those that one call needs
RECENT = 16  # an instance that was used within so many calls is kept
LARGEST_FLOAT = np.finfo(np.float32).max
LARGEST = 1e30  # a bound from here on is none: float32's own largest number, say


class Leaf(NamedTuple):
    """One entry of a (nested) space of observations."""

    path: tuple[Any, ...]  # keys and places that lead to it
    shape: tuple[int, ...]  # shape of the environment's value
    choices: tuple[int, ...] = ()  # number of values of each entry, which the vector holds one-hot; (): as they are
    start: tuple[int, ...] = ()  # the first value of each entry with choices

    @property
    def size(self) -> int:
        """Number of entries that the leaf fills in the vector."""
        return sum(self.choices) or int(np.prod(self.shape, dtype=int))

    @property
    def name(self) -> str:
        """The leaf's keys, joined by dots."""
        return ".".join(map(str, self.path)) or "observation"

    def vector(self, obs: Any) -> np.ndarray:
        """Return the leaf of an observation as a vector. Raises ValueError, which says what is wrong with it."""
        try:
            for key in self.path:
                obs = obs[key]
            value = np.asarray(obs)
        except (KeyError, IndexError, TypeError, ValueError):
            raise ValueError(f"no numbers {self.name!r} in its observation, which its space has") from None
        if value.shape != self.shape or value.dtype.kind not in "biuf":
            raise ValueError(f"an observation {self.name!r} of shape {value.shape}, where its space has {self.shape}")
        if not (np.abs(value) <= LARGEST_FLOAT).all():
            raise ValueError(f"an observation {self.name!r} that is not finite")
        if not self.choices:
            return value.ravel()
        places = value.ravel().astype(int) - np.array(self.start, int)
        if ((places < 0) | (places >= self.choices)).any():
            raise ValueError(f"an observation {self.name!r} of {value}, beyond {self.choices} values from {self.start}")
        rows = np.zeros(self.size, np.float32)
        rows[places + np.cumsum((0, *self.choices[:-1]), dtype=int)] = 1.0
        return rows


def leaves_of(whose: str, space: Any, path: tuple[Any, ...] = ()) -> tuple[Leaf, ...]:
    """Return the entries of a space of observations, in the order of the space; `whose`: for the message."""
    kind = type(space).__name__
    if kind in ("Dict", "Tuple"):
        parts = space.spaces.items() if kind == "Dict" else enumerate(space.spaces)
        return tuple(leaf for key, inner in parts for leaf in leaves_of(whose, inner, (*path, key)))
    leaf = Leaf(path, tuple(space.shape or ()))
    if kind in ("Discrete", "MultiDiscrete"):
        counts = getattr(space, "nvec", getattr(space, "n", 0))
        return (leaf._replace(choices=tuple(np.ravel(counts).tolist()), start=tuple(np.ravel(space.start).tolist())),)
    if kind not in ("Box", "MultiBinary"):
        raise UserError(
            f"{whose}: observation {leaf.name!r} is a {kind}: give one of Box, Discrete, MultiDiscrete or MultiBinary, "
            "or a Dict or Tuple of these"
        )
    if kind == "Box" and len(leaf.shape) + (space.dtype == np.uint8) >= 3:
        raise UserError(
            f"{whose}: observation {leaf.name!r} is an image of shape {leaf.shape}: give one with observations of "
            "numbers (a vector, or a dictionary of vectors); pictures for people come from render_mode='rgb_array'"
        )
    return (leaf,)


def flatten(leaves: tuple[Leaf, ...], obs: Any) -> np.ndarray:
    """Return an observation as a vector (obs,) of float32. Raises ValueError for an observation outside its space."""
    return np.concatenate([leaf.vector(obs) for leaf in leaves], dtype=np.float32, casting="unsafe")


class Actions(NamedTuple):
    """A space of actions as vectors: a box between bounds, or choices."""

    low: tuple[float, ...] = ()
    high: tuple[float, ...] = ()
    choices: int = 0  # above 0: one of so many


def actions_of(whose: str, space: Any) -> Actions:
    """Return a space of actions as vectors. Raises UserError for one that is neither a bounded box nor choices."""
    kind = type(space).__name__
    if kind == "Discrete":
        if int(space.n) < 2:
            raise UserError(f"{whose}: there is only one action: give an environment with a choice")
        return Actions(choices=int(space.n))
    if kind != "Box":
        raise UserError(f"{whose}: its actions are a {kind}: wrap the environment so that they are a Box or Discrete")
    low, high = np.ravel(space.low).astype(float), np.ravel(space.high).astype(float)
    for number, (least, most) in enumerate(zip(low, high, strict=True), 1):
        if least == most:
            raise UserError(f"{whose}: entry {number} of its actions can only be {least:g}: wrap it to leave it out")
        if not max(-least, most) < LARGEST:
            raise UserError(f"{whose}: entry {number} of its actions has no bounds: wrap it, as in RescaleAction")
    return Actions(tuple(low.tolist()), tuple(high.tolist()))


def action_maker(space: Any) -> Callable[[np.ndarray], Any]:
    """Return the function that makes an environment's action from a vector (action,)."""
    if type(space).__name__ == "Discrete":
        return lambda vector: int(vector.argmax()) + int(space.start)
    shape, dtype = space.shape, space.dtype
    if np.issubdtype(dtype, np.integer):
        return lambda vector: np.round(vector).reshape(shape).astype(dtype)
    return lambda vector: vector.reshape(shape).astype(dtype)


class Request(NamedTuple):
    """One row of a call."""

    seed: int  # seed of the episode
    place: bytes = b""  # place before the action; empty: the episode begins
    action: np.ndarray | None = None  # (action,); None: begin the episode
    next_seed: int = 0  # seed of the next episode, where this one ends
    history: np.ndarray | None = None  # (steps, action) that lead to the place; None: not sent yet


class Went(NamedTuple):
    """The result of a request."""

    obs: np.ndarray  # (obs,) to act on next
    final_obs: np.ndarray  # (obs,) what the action led to
    reward: float
    terminated: bool
    truncated: bool
    success: float
    total: float  # the rewards of the episode so far
    place: bytes  # the instance's place now


class Running:
    """One instance and its current place. Its methods raise UserError for what the environment raises or gives."""

    def __init__(self, make: Callable[[], Any], whose: str, max_steps: int) -> None:
        """Make the instance. Raises UserError for one that cannot be made, or whose spaces cannot be vectors."""
        self.whose, self.max_steps = f"environment {whose}", max_steps
        try:
            self.env = make()
        except UserError:
            raise
        except Exception as error:
            raise user_code_error(f"{self.whose}, while it was made,", error) from error
        if hasattr(self.env, "num_envs"):
            raise UserError(
                f"{self.whose} is a vector of {self.env.num_envs} environments: give a function that makes a single one"
            )
        self.actions = actions_of(self.whose, self.env.action_space)
        self.leaves = leaves_of(self.whose, self.env.observation_space)
        self.to_action = action_maker(self.env.action_space)
        self.seed, self.steps, self.total, self.place = -1, 0, 0.0, b""
        self.last_use = -RECENT  # number of the call that used it last
        self.filmed = np.zeros((0, 0), np.float32)  # actions so far, where it is filmed
        self.reports_success = False

    def reset(self, seed: int) -> np.ndarray:
        """Begin an episode."""
        self.seed, self.steps, self.total = seed, 0, 0.0
        obs = self._vector(self._called(self.env.reset, seed=seed)[0])
        self.place = hashlib.blake2b(seed.to_bytes(8, "little") + obs.tobytes(), digest_size=PLACE_BYTES).digest()
        return obs

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, float]:
        """Execute an action (action,). Return observation, reward, terminated, truncated, success."""
        obs, reward, terminated, truncated, success = self.execute(self.to_action(action))
        outcome = struct.pack("<d??d", reward, terminated, truncated, success)
        parts = self.place + action.tobytes() + obs.tobytes() + outcome
        self.place = hashlib.blake2b(parts, digest_size=PLACE_BYTES).digest()
        return obs, reward, terminated, truncated, success

    def execute(self, action: Any) -> tuple[np.ndarray, float, bool, bool, float]:
        """Like `step`, for an action as the environment takes it; `place` is not moved."""
        self.steps += 1
        raw, reward, terminated, truncated, info = self._called(self.env.step, action)
        obs = self._vector(raw)
        try:
            number = float(reward)
        except (TypeError, ValueError):
            number = math.nan
        if not math.isfinite(number):
            raise UserError(
                f"{self.whose} gave a reward of {format_value(reward)} in {self._when}: give a finite number"
            )
        self.total += number
        terminated = bool(terminated)
        truncated = (bool(truncated) or self.steps >= self.max_steps > 0) and not terminated
        return obs, number, terminated, truncated, self._success(info)

    @property
    def _when(self) -> str:
        step = f"step {self.steps} of the episode" if self.steps else "its reset"
        return f"{step} with seed {self.seed}"

    def _called(self, function: Callable[..., Any], *arguments: Any, **options: Any) -> Any:
        try:
            return function(*arguments, **options)
        except Exception as error:
            raise user_code_error(f"{self.whose}, in {self._when},", error) from error

    def _success(self, info: dict[str, Any]) -> float:
        """Return what `info` says of success; 0 where nothing. Raises UserError for neither true nor false."""
        name = next((name for name in SUCCESS if info.get(name) is not None), None)
        if name is None:
            return 0.0
        value = np.asarray(info[name])
        if value.size != 1 or value.dtype.kind not in "biuf" or not np.isfinite(value).all():
            raise UserError(f"{self.whose} says info[{name!r}] = {info[name]!r}: give True, False or None")
        self.reports_success = True
        return float(bool(value.ravel()[0]))

    def _vector(self, obs: Any) -> np.ndarray:
        try:
            return flatten(self.leaves, obs)
        except ValueError as error:
            raise UserError(f"{self.whose} gave {error} in {self._when}: keep to its observation space") from None

    def picture(self) -> np.ndarray:
        """Return what `render` gives, (height, width, 3) uint8. Raises UserError where that is no picture."""
        try:
            frame = self.env.render()
        except Exception as error:
            words = " ".join(str(error).split())[:160]
            raise UserError(
                f"{self.whose} cannot be drawn ({type(error).__name__}: {words}): if that is of OpenGL, set MUJOCO_GL "
                "to egl or osmesa"
            ) from error
        if isinstance(frame, list) and frame:
            frame = frame[-1]
        if not isinstance(frame, np.ndarray) or frame.dtype != np.uint8 or frame.shape[2:] != (3,) or not frame.size:
            raise UserError(
                f"{self.whose} gives no pictures: let it take render_mode='rgb_array', and render return uint8 "
                "(height, width, 3)"
            )
        return np.ascontiguousarray(frame)

    def close(self) -> None:
        """Close the environment, whatever its closing raises."""
        with contextlib.suppress(Exception):
            self.env.close()


class Instances:
    """The instances of one process."""

    def __init__(self, make: Callable[[], Any], whose: str, max_steps: int, size: int) -> None:
        """`make` returns an environment; `size`: entries of an observation by the task."""
        self.make, self.whose, self.max_steps, self.size = make, whose, max_steps, size
        self.running: list[Running] = []
        self.camera: Running | None = None  # the instance that is filmed
        self.calls = self.replays = 0  # number of calls, and of replayed steps

    def carry_out(self, requests: Sequence[Request]) -> list[Went | str | None]:
        """Return the result of each request: the words of an error, or None where its history is needed.

        The instance for a request stands at the place, or is the least recently used one, or new.
        """
        self.calls += all(row.history is None for row in requests)  # with histories, a call goes on
        standing: dict[bytes, list[Running]] = defaultdict(list)
        for one in self.running:
            standing[one.place].append(one)
        instances = [standing[row.place].pop() if row.place and standing[row.place] else None for row in requests]
        for one in filter(None, instances):
            one.last_use = self.calls
        free = iter(sorted((one for one in self.running if one.last_use < self.calls), key=lambda one: one.last_use))
        return [self._result(request, one, free) for request, one in zip(requests, instances, strict=True)]

    def _result(self, request: Request, one: Running | None, free: Iterator[Running]) -> Went | str | None:
        if one is None and request.place and request.history is None:
            return None
        try:
            if one is None:
                one = self._vacated(free, request.history is not None and len(request.history) > 0)
                if request.history is not None:
                    self._replay(one, request, request.history)
            if request.action is None:
                obs = one.reset(request.seed)
                return Went(obs, obs, 0.0, False, False, 0.0, 0.0, one.place)
            final_obs, reward, terminated, truncated, success = one.step(request.action)
            total, ended = one.total, terminated or truncated
            obs = one.reset(request.next_seed) if ended else final_obs
            return Went(obs, final_obs, reward, terminated, truncated, success, total, one.place)
        except UserError as error:
            if one is not None:
                one.close()
                self.running.remove(one)
            return str(error)

    def _vacated(self, free: Iterator[Running], replays: bool) -> Running:
        """Return the least recently used instance, or a new one where a state in use would be lost."""
        one = next(free, None)
        wanted = one is not None and one.last_use > self.calls - RECENT
        if one is None or (wanted and replays and len(self.running) < MOST_INSTANCES):
            one = self._new()
            self.running.append(one)
        one.last_use = self.calls
        return one

    def _new(self) -> Running:
        one = Running(self.make, self.whose, self.max_steps)
        size = sum(leaf.size for leaf in one.leaves)
        if size != self.size:
            raise UserError(
                f"{one.whose} has observations of {size} entries, its task says {self.size}: name the environment anew"
            )
        return one

    def _replay(self, one: Running, request: Request, history: np.ndarray) -> None:
        """Bring an instance to a place. Raises UserError if the environment does not repeat itself."""
        one.reset(request.seed)
        for action in history:
            one.step(action)
        self.replays += len(history)
        if one.place != request.place:
            raise UserError(
                f"{one.whose} does not repeat itself: with seed {request.seed} and the same {len(history)} actions it "
                "came elsewhere than before: let it draw from its own np_random alone, and reset everything in "
                "reset(seed=...)"
            )

    def film(self, seed: int, actions: np.ndarray, first: int) -> list[np.ndarray] | str:
        """Return pictures of an episode after its first `first` actions, or the words of an error.

        There are fewer pictures where the episode ends before its actions do.
        """
        try:
            one = self.camera = self.camera or self._new()
            goes_on = one.seed == seed and one.steps <= first and len(one.filmed) == one.steps
            if not goes_on or not np.array_equal(one.filmed, actions[: one.steps]):
                one.reset(seed)
            frames = [one.picture()] if one.steps == first else []
            for action in actions[one.steps :]:
                *_, terminated, truncated, _ = one.step(action)
                if one.steps >= first:
                    frames.append(one.picture())
                if terminated or truncated:
                    break
            one.filmed = actions[: one.steps]
            return frames
        except UserError as error:
            if self.camera is not None:
                self.camera.close()
            self.camera = None
            return str(error)

    def close(self) -> None:
        """Close all instances."""
        for one in (*self.running, *filter(None, [self.camera])):
            one.close()
        self.running, self.camera = [], None
