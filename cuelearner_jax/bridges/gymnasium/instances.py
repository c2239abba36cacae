"""Instances of one environment, which reset, step and replay: the work of one process of the pool.

Observations become vectors, and vectors become actions. This module imports neither JAX nor, by itself, Gymnasium, so
that worker processes start quickly.

Where an instance stands is named by a chain of hashes: of the seed and the first observation, then of each action with
the observation, reward and end that followed. Equal places have equal names. An environment that does not repeat itself
comes to another name, which is reported.
"""

from __future__ import annotations

import contextlib
import hashlib
import math
import operator
import struct
from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from functools import reduce
from typing import Any, NamedTuple

import numpy as np

from cuelearner_jax.errors import UserError, first_line, format_value, user_code_error

SUCCESS = ("success", "is_success", "succeed")  # names in `info`
PLACE_BYTES = 8
MOST_INSTANCES = 1024  # spare instances, beyond those that one call needs
RECENT = 16  # an instance that was used within so many calls is kept
RESET, STEP = ("observation", "info"), ("observation", "reward", "terminated", "truncated", "info")
LARGEST = 1e30  # a bound from here on is none: float32's own largest number, say


class Leaf(NamedTuple):
    """One entry of a (nested) space of observations."""

    path: tuple[Any, ...]  # keys and places that lead to it
    space: Any  # Box, Discrete, MultiDiscrete or MultiBinary of Gymnasium

    @property
    def size(self) -> int:
        """Number of entries that the leaf fills in the vector."""
        from gymnasium.spaces import flatdim

        return flatdim(self.space)

    @property
    def name(self) -> str:
        """The leaf's keys, joined by dots."""
        return ".".join(map(str, self.path)) or "observation"

    def vector(self, obs: Any) -> np.ndarray:
        """Return the leaf of an observation as a vector, choices one-hot. Raises ValueError for no value of its space.

        Bounds of a Box are not checked, and its numbers are not cast to its type: many environments keep to neither.
        """
        value, wrong = reduce(operator.getitem, self.path, obs), f"not of {self.space}"
        if type(self.space).__name__ == "Box":
            value = np.asarray(value, np.float32)
            if value.shape == self.space.shape:
                if np.isfinite(value).all():
                    return value.ravel()
                wrong = "not finite"
        elif self.space.contains(value):
            from gymnasium.spaces import flatten

            return np.asarray(flatten(self.space, value), np.float32)
        raise ValueError(f"{self.name!r} is {format_value(value)}, {wrong}")


def leaves_of(whose: str, space: Any, path: tuple[Any, ...] = ()) -> tuple[Leaf, ...]:
    """Return the entries of a space of observations, in the order of the space; `whose`: for the message."""
    kind = type(space).__name__
    if kind in ("Dict", "Tuple"):
        parts = space.spaces.items() if kind == "Dict" else enumerate(space.spaces)
        return tuple(leaf for key, inner in parts for leaf in leaves_of(whose, inner, (*path, key)))
    leaf, is_box = Leaf(path, space), kind == "Box"
    is_image = is_box and len(space.shape) + (space.dtype == np.uint8) >= 3
    if is_image or not (is_box or kind in ("Discrete", "MultiDiscrete", "MultiBinary")):
        raise UserError(
            f"{whose}: observation {leaf.name!r} is {'an image, ' * is_image}{space}: give numbers, as Box, Discrete, "
            "MultiDiscrete or MultiBinary, or a Dict or Tuple of these; pictures for people come from "
            "render_mode='rgb_array'"
        )
    return (leaf,)


class Actions(NamedTuple):
    """A space of actions as vectors: a box between bounds, or choices."""

    low: tuple[float, ...] = ()
    high: tuple[float, ...] = ()
    choices: int = 0  # above 0: one of so many


def actions_of(whose: str, space: Any) -> Actions:
    """Return a space of actions as vectors. Raises UserError for one that is neither a bounded box nor choices."""
    kind = type(space).__name__
    if kind == "Discrete":
        return Actions(choices=int(space.n))
    if kind != "Box":
        raise UserError(f"{whose}: its actions are a {kind}: wrap the environment so that they are a Box or Discrete")
    low, high = (np.ravel(bound).astype(float).tolist() for bound in (space.low, space.high))
    for number, (least, most) in enumerate(zip(low, high, strict=True), 1):
        if not max(-least, most) < LARGEST:
            raise UserError(f"{whose}: entry {number} of its actions has no bounds: wrap it, as in RescaleAction")
    return Actions(tuple(low), tuple(high))


class Request(NamedTuple):
    """One row of a call."""

    seed: int  # seed of the episode
    place: bytes = b""  # place before the action; empty: unknown
    action: np.ndarray | None = None  # (action,); None: begin the episode, or draw
    next_seed: int = 0  # seed of the next episode, where this one ends
    history: Any = ()  # (steps, action) that lead to the place


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
        if (count := getattr(self.env, "num_envs", 0)) or not hasattr(self.env, "action_space"):
            kind = f"vector of {count} environments" if count else type(self.env).__name__
            raise UserError(f"{self.whose} is a {kind}: give a class or function that makes a single gymnasium.Env")
        self.space = self.env.action_space
        self.actions = actions_of(self.whose, self.space)
        self.leaves = leaves_of(self.whose, self.env.observation_space)
        self.seed, self.steps, self.total, self.place = -1, 0, 0.0, b""
        self.last_use = -RECENT  # number of the call that used it last
        self.reports_success = False

    def reset(self, seed: int) -> np.ndarray:
        """Begin an episode."""
        self.seed, self.steps, self.total = seed, 0, 0.0
        obs = self._vector(self._called(RESET, self.env.reset, seed=seed)[0])
        self.place = hashlib.blake2b(seed.to_bytes(8, "little") + obs.tobytes(), digest_size=PLACE_BYTES).digest()
        return obs

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, float]:
        """Execute an action (action,). Return observation, reward, terminated, truncated, success."""
        self.steps += 1
        raw, reward, terminated, truncated, info = self._called(STEP, self.env.step, self._own_action(action))
        obs, reward, terminated = self._vector(raw), self._number("a reward", reward), bool(terminated)
        self.total += reward
        truncated = (bool(truncated) or self.steps >= self.max_steps > 0) and not terminated
        name = next((name for name in SUCCESS if info and info.get(name) is not None), None)
        success = float(name is not None and self._number(f"info[{name!r}]", info[name]) != 0)
        self.reports_success |= name is not None
        outcome = struct.pack("<d??d", reward, terminated, truncated, success)
        parts = self.place + action.tobytes() + obs.tobytes() + outcome
        self.place = hashlib.blake2b(parts, digest_size=PLACE_BYTES).digest()
        return obs, reward, terminated, truncated, success

    @property
    def _when(self) -> str:
        step = f"step {self.steps} of the episode" if self.steps else "its reset"
        return f"{step} with seed {self.seed}"

    def _called(self, parts: Sequence[str], function: Callable[..., Any], *arguments: Any, **options: Any) -> Any:
        """Call a function of the environment. Raises UserError unless it returns the parts that Gymnasium's API has."""
        try:
            result = function(*arguments, **options)
        except Exception as error:
            raise user_code_error(f"{self.whose}, in {self._when},", error) from error
        if not isinstance(result, tuple) or len(result) != len(parts):
            api = f"return ({', '.join(parts)}), which is Gymnasium's API"
            raise UserError(f"{self.whose} returned {format_value(result)} in {self._when}: {api}")
        return result

    def _own_action(self, vector: np.ndarray) -> Any:
        """Return the environment's own form of an action (action,), within the bounds after rounding too."""
        if self.actions.choices:
            return int(vector.argmax()) + int(self.space.start)
        if np.issubdtype(self.space.dtype, np.integer):
            vector = np.round(vector)
        return np.clip(vector.reshape(self.space.shape).astype(self.space.dtype), self.space.low, self.space.high)

    def _number(self, called: str, value: Any) -> float:
        """Return a number of the environment. Raises UserError for anything but one finite number."""
        try:
            number = float(np.asarray(value).item())
        except (TypeError, ValueError):
            number = math.nan
        if not math.isfinite(number):
            advice = "give a finite number, True or False"
            raise UserError(f"{self.whose} gave {called} of {format_value(value)} in {self._when}: {advice}")
        return number

    def _vector(self, obs: Any) -> np.ndarray:
        try:
            return np.concatenate([leaf.vector(obs) for leaf in self.leaves])
        except (KeyError, IndexError, TypeError, ValueError) as error:
            words = first_line(error)
            raise UserError(f"{self.whose} gave an observation outside its space in {self._when}: {words}") from None

    def picture(self) -> np.ndarray:
        """Return what `render` gives, (height, width, 3). Raises UserError where that is no picture."""
        try:
            frame = self.env.render()
        except Exception as error:
            raise UserError(
                f"{self.whose} cannot be drawn ({type(error).__name__}: {first_line(error)}): if that is of OpenGL, "
                "set MUJOCO_GL to egl or osmesa"
            ) from error
        if not isinstance(frame, np.ndarray):
            raise UserError(f"{self.whose} gives no pictures: let it take render_mode='rgb_array'")
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
        self.calls = self.replays = 0  # number of calls, and of replayed steps

    def carry_out(self, requests: Sequence[Request]) -> list[Went | str] | str:
        """Return the result of each request, or the words of the first error.

        The instance for a request stands at the place, or is the least recently used one, or new.
        """
        self.calls += 1
        standing: dict[bytes, list[Running]] = defaultdict(list)
        for one in self.running:
            standing[one.place].append(one)
        instances = [standing[row.place].pop() if standing[row.place] else None for row in requests]
        for one in filter(None, instances):
            one.last_use = self.calls
        free = iter(sorted((one for one in self.running if one.last_use < self.calls), key=lambda one: one.last_use))
        results = [self._result(request, one, free) for request, one in zip(requests, instances, strict=True)]
        return next((one for one in results if isinstance(one, str)), results)

    def _result(self, request: Request, one: Running | None, free: Iterator[Running]) -> Went | str:
        try:
            if one is None:
                one = self._vacated(free, len(request.history) > 0)
                if request.action is not None:
                    self._replay(one, request)
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
        is_recent = one is not None and one.last_use > self.calls - RECENT
        if one is None or (is_recent and replays and len(self.running) < MOST_INSTANCES):
            one = self._new()
        one.last_use = self.calls
        return one

    def _new(self) -> Running:
        one = Running(self.make, self.whose, self.max_steps)
        inner = lambda each: getattr(each.env, "unwrapped", each.env)  # noqa: E731
        if any(inner(one) is inner(other) for other in self.running):
            raise UserError(f"{one.whose} is the same instance each time: let the function make a new environment")
        if (size := sum(leaf.size for leaf in one.leaves)) != self.size:
            advice = "name the environment anew"
            raise UserError(f"{one.whose} has observations of {size} entries, its task says {self.size}: {advice}")
        self.running.append(one)
        return one

    def _replay(self, one: Running, request: Request) -> None:
        """Bring an instance to a place. Raises UserError if the environment does not repeat itself."""
        one.reset(request.seed)
        for action in request.history:
            one.step(action)
        self.replays += len(request.history)
        if request.place and one.place != request.place:
            pictures = ", so pictures would show other situations" if request.action is None else ""
            raise UserError(
                f"{one.whose} does not repeat itself: with seed {request.seed} and the same {len(request.history)} "
                f"actions it came elsewhere than before{pictures}: let it draw from its own np_random alone, and reset "
                "everything in reset(seed=...), or use recorded situations (logs:FOLDER)"
            )

    def film(self, request: Request, actions: np.ndarray) -> list[np.ndarray] | str:
        """Return a picture of a request's place and one after each of the actions, or the words of an error.

        There are fewer pictures where the episode ends before its actions do.
        """
        try:
            one = self.running[0] if self.running else self._new()
            self._replay(one, request)
            frames = [one.picture()]
            for action in actions:
                *_, terminated, truncated, _ = one.step(action)
                frames.append(one.picture())
                if terminated or truncated:
                    break
            return frames
        except UserError as error:
            self.close()
            return str(error)

    def close(self) -> None:
        """Close all instances."""
        while self.running:
            self.running.pop().close()
