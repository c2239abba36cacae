"""Instances of one environment, which reset, step and replay: the work of one process of the pool.

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

from cuelearner_jax.bridges.gymnasium.layout import NoVector, action_maker, actions_of, flatten, leaves_of
from cuelearner_jax.errors import UserError, user_code_error

SUCCESS = ("success", "is_success", "succeed")  # names in `info`
PLACE_BYTES = 8
MOST_INSTANCES = 1024  # spare instances, beyond those that one call needs
RECENT = 16  # an instance that was used within so many calls is kept


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
    """One instance and its current place."""

    def __init__(self, make: Callable[[], Any], whose: str, max_steps: int) -> None:
        """Make the instance. Raises UserError for one that cannot be made, or whose spaces cannot be vectors."""
        self.whose, self.max_steps = whose, max_steps
        try:
            self.env = make()
        except UserError:
            raise
        except Exception as error:
            raise user_code_error(f"environment {whose}, while it was made,", error) from error
        if hasattr(self.env, "num_envs"):
            raise UserError(
                f"environment {whose} is a vector of {self.env.num_envs} environments: give a function that makes a "
                "single one"
            )
        self.actions = actions_of(f"environment {whose}", self.env.action_space)
        self.leaves = leaves_of(f"environment {whose}", self.env.observation_space)
        self.to_action = action_maker(self.env.action_space)
        self.seed, self.steps, self.total, self.place = -1, 0, 0.0, b""
        self.used = -RECENT  # number of the call that used it last
        self.filmed = np.zeros((0, 0), np.float32)  # actions so far, where it is filmed
        self.reports_success = False

    def reset(self, seed: int) -> np.ndarray:
        """Begin an episode. Raises UserError for what the environment raises, or gives that is no observation."""
        self.seed, self.steps, self.total = seed, 0, 0.0
        when = f"its reset with seed {seed}"
        obs = self._vector(self._called(when, self.env.reset, seed=seed)[0], when)
        self.place = hashlib.blake2b(seed.to_bytes(8, "little") + obs.tobytes(), digest_size=PLACE_BYTES).digest()
        return obs

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, float]:
        """Execute an action (action,). Return observation, reward, terminated, truncated, success. Raise as `reset`."""
        obs, reward, terminated, truncated, success = self.execute(self.to_action(action))
        told = struct.pack("<d??d", reward, terminated, truncated, success)
        parts = self.place + action.tobytes() + obs.tobytes() + told
        self.place = hashlib.blake2b(parts, digest_size=PLACE_BYTES).digest()
        return obs, reward, terminated, truncated, success

    def execute(self, action: Any) -> tuple[np.ndarray, float, bool, bool, float]:
        """Like `step`, for an action as the environment takes it; `place` is not moved."""
        self.steps += 1
        when = f"step {self.steps} of the episode with seed {self.seed}"
        given, reward, terminated, truncated, info = self._called(when, self.env.step, action)
        obs = self._vector(given, when)
        try:
            reward = float(reward)
        except (TypeError, ValueError):
            raise UserError(f"environment {self.whose} gave no number as reward in {when}: mend it first") from None
        if not math.isfinite(reward):
            raise UserError(f"environment {self.whose} gave a reward of {reward} in {when}: mend it first")
        self.total += reward
        terminated = bool(terminated)
        truncated = (bool(truncated) or self.steps >= self.max_steps > 0) and not terminated
        return obs, reward, terminated, truncated, self._success(info)

    def _called(self, when: str, function: Callable[..., Any], *arguments: Any, **named: Any) -> Any:
        try:
            return function(*arguments, **named)
        except Exception as error:
            raise user_code_error(f"environment {self.whose}, in {when},", error) from error

    def _success(self, info: dict[str, Any]) -> float:
        """Return what `info` says of success; 0 where nothing. Raises UserError for neither true nor false."""
        name = next((name for name in SUCCESS if info.get(name) is not None), None)
        if name is None:
            return 0.0
        value = np.asarray(info[name])
        if value.size != 1 or value.dtype.kind not in "biuf" or not np.isfinite(value).all():
            raise UserError(f"environment {self.whose} says info[{name!r}] = {info[name]!r}: give True, False or None")
        self.reports_success = True
        return float(bool(value.ravel()[0]))

    def _vector(self, given: Any, when: str) -> np.ndarray:
        try:
            obs = flatten(self.leaves, given)
        except NoVector as error:
            raise UserError(f"environment {self.whose} gave {error} in {when}: keep its shapes") from None
        if not (math.isfinite(obs.sum()) or np.isfinite(obs).all()):
            ends = np.cumsum([leaf.size for leaf in self.leaves])
            leaf = self.leaves[int(np.searchsorted(ends, np.flatnonzero(~np.isfinite(obs))[0], "right"))]
            raise UserError(
                f"environment {self.whose} gave an observation {leaf.name!r} that is not finite in {when}: mend that"
            )
        return obs

    def picture(self) -> np.ndarray:
        """Return what `render` gives, (height, width, 3) uint8. Raises UserError where that is no picture."""
        try:
            found = self.env.render()
        except Exception as error:
            words = " ".join(str(error).split())[:160]
            raise UserError(
                f"environment {self.whose} cannot be drawn ({type(error).__name__}: {words}): if that is of OpenGL, "
                "set MUJOCO_GL to egl or osmesa"
            ) from error
        if isinstance(found, list) and found:
            found = found[-1]
        if not isinstance(found, np.ndarray) or found.dtype != np.uint8 or found.shape[2:] != (3,) or not found.size:
            raise UserError(
                f"environment {self.whose} gives no pictures: let it take render_mode='rgb_array', and render return "
                "uint8 (height, width, 3)"
            )
        return np.ascontiguousarray(found)

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
        self.cameras: dict[bool, Running] = {}  # the instances that are filmed: for stills (True), and for films
        self.calls = self.replays = 0  # number of calls, and of replayed steps

    def carry_out(self, requests: Sequence[Request]) -> list[Went | str | None]:
        """Return the result of each request: the words of an error, or None where its history is needed.

        The instance for a request stands at the place, or is the least recently used one, or new.
        """
        self.calls += all(row.history is None for row in requests)  # with histories, a call goes on
        standing: dict[bytes, list[Running]] = defaultdict(list)
        for one in self.running:
            standing[one.place].append(one)
        chosen = [standing[row.place].pop() if row.place and standing[row.place] else None for row in requests]
        for one in filter(None, chosen):
            one.used = self.calls
        free = iter(sorted((one for one in self.running if one.used < self.calls), key=lambda one: one.used))
        return [self._result(request, one, free) for request, one in zip(requests, chosen, strict=True)]

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
        wanted = one is not None and one.used > self.calls - RECENT
        if one is None or (wanted and replays and len(self.running) < MOST_INSTANCES):
            one = self._made()
            self.running.append(one)
        one.used = self.calls
        return one

    def _made(self) -> Running:
        one = Running(self.make, self.whose, self.max_steps)
        size = sum(leaf.size for leaf in one.leaves)
        if size != self.size:
            raise UserError(
                f"environment {self.whose} has observations of {size} entries, its task says {self.size}: name the "
                "environment anew"
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
                f"environment {self.whose} does not repeat itself: with seed {request.seed} and the same "
                f"{len(history)} actions it came elsewhere than before: let it draw from its own np_random alone, and "
                "reset everything in reset(seed=...)"
            )

    def film(self, seed: int, actions: np.ndarray, first: int) -> list[np.ndarray] | str:
        """Return pictures of an episode after its first `first` actions, or the words of an error.

        There are fewer pictures where the episode ends before its actions do.
        """
        still = first == len(actions)
        try:
            if still not in self.cameras:
                self.cameras[still] = self._made()
            one = self.cameras[still]
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
            if still in self.cameras:
                self.cameras.pop(still).close()
            return str(error)

    def close(self) -> None:
        """Close all instances."""
        for one in (*self.running, *self.cameras.values()):
            one.close()
        self.running, self.cameras = [], {}
