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
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np

from cuelearner_jax.bridges.gymnasium.layout import NoVector, action_maker, actions_of, flatten, leaves_of
from cuelearner_jax.errors import UserError, user_code_error

SUCCESS = ("success", "is_success", "succeed")  # names in `info`
PLACE_BYTES = 8


class Order(NamedTuple):
    """An instruction to one instance."""

    slot: int  # number of the instance
    seed: int  # seed of the episode
    place: bytes  # place before the action; empty: the episode begins
    action: np.ndarray | None  # (action,); None: begin the episode
    next_seed: int = 0  # seed of the next episode, where this one ends
    replay: np.ndarray | None = None  # (steps, action): go there first; None: it stands there
    steps: int = 0  # number of steps so far in the episode


class Went(NamedTuple):
    """The result of an order."""

    obs: np.ndarray  # (obs,) to act on next
    final_obs: np.ndarray  # (obs,) what the action led to
    reward: float
    terminated: bool
    truncated: bool
    success: float
    total: float  # the rewards of the episode so far
    place: bytes  # the instance's place now


class Shot(NamedTuple):
    """A request for pictures of an episode."""

    slot: int
    seed: int  # seed of the episode
    actions: np.ndarray  # (steps, action) from its beginning
    first: int  # number of the first step that is filmed


def success_in(whose: str, info: dict[str, Any]) -> bool | None:
    """Return what `info` says of success; None: nothing. Raises UserError where that is neither true nor false."""
    name = next((name for name in SUCCESS if info.get(name) is not None), None)
    if name is None:
        return None
    value = np.asarray(info[name])
    if value.size != 1 or value.dtype.kind not in "biuf" or not np.isfinite(value).all():
        raise UserError(f"environment {whose} says info[{name!r}] = {info[name]!r}: give True, False or None")
    return bool(value.ravel()[0])


class Running:
    """One instance and its current place."""

    def __init__(self, env: Any, whose: str) -> None:
        """Raise UserError for an environment whose spaces cannot be vectors."""
        self.env, self.whose = env, whose
        self.leaves = leaves_of(whose, env.observation_space)
        actions_of(whose, env.action_space)
        self.to_action = action_maker(env.action_space)
        self.seed, self.steps, self.total, self.place = -1, 0, 0.0, b""

    def reset(self, seed: int) -> np.ndarray:
        """Begin an episode. Raises UserError for what the environment raises, or gives that is no observation."""
        self.seed, self.steps, self.total = seed, 0, 0.0
        try:
            given, _ = self.env.reset(seed=seed)
        except Exception as error:
            raise user_code_error(f"environment {self.whose}, in its reset with seed {seed},", error) from error
        obs = self._vector(given, f"its reset with seed {seed}")
        self.place = hashlib.blake2b(seed.to_bytes(8, "little") + obs.tobytes(), digest_size=PLACE_BYTES).digest()
        return obs

    def step(self, action: np.ndarray, max_steps: int) -> tuple[np.ndarray, float, bool, bool, float]:
        """Execute an action (action,). Return observation, reward, terminated, truncated, success. Raise as `reset`."""
        self.steps += 1
        when = f"step {self.steps} of the episode with seed {self.seed}"
        try:
            given, reward, terminated, truncated, info = self.env.step(self.to_action(action))
        except Exception as error:
            raise user_code_error(f"environment {self.whose}, in {when},", error) from error
        obs = self._vector(given, when)
        try:
            reward = float(reward)
        except (TypeError, ValueError):
            raise UserError(f"environment {self.whose} gave no number as reward in {when}: mend it first") from None
        if not math.isfinite(reward):
            raise UserError(f"environment {self.whose} gave a reward of {reward} in {when}: mend it first")
        terminated = bool(terminated)
        truncated = (bool(truncated) or self.steps >= max_steps) and not terminated
        success = float(success_in(self.whose, info) or 0.0)
        self.total += reward
        told = struct.pack("<d??d", reward, terminated, truncated, success)
        parts = self.place + action.tobytes() + obs.tobytes() + told
        self.place = hashlib.blake2b(parts, digest_size=PLACE_BYTES).digest()
        return obs, reward, terminated, truncated, success

    def _vector(self, given: Any, when: str) -> np.ndarray:
        try:
            obs = flatten(self.leaves, given)
        except NoVector as error:
            raise UserError(f"environment {self.whose} gave {error} in {when}: keep its shapes") from None
        if not (math.isfinite(obs.sum()) or np.isfinite(obs).all()):
            start = 0
            for leaf in self.leaves:
                if not np.isfinite(obs[start : start + leaf.size]).all():
                    break
                start += leaf.size
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


class Instances:
    """The instances of one process."""

    def __init__(self, make: Callable[[], Any], whose: str, max_steps: int, size: int) -> None:
        """`make` returns an environment; `size`: entries of an observation by the task (0: unknown)."""
        self.make, self.whose, self.max_steps, self.size = make, whose, max_steps, size
        self.running: dict[int, Running] = {}
        self.filmed: dict[int, np.ndarray] = {}  # actions (steps, action) of the episodes that are filmed

    def carry_out(self, orders: Sequence[Order | Shot]) -> list[Any]:
        """Carry out orders. Return a `Went` for each order, and pictures [(height, width, 3) uint8] for each shot.

        Where one fails, its result is the words of the error, and its instance is dropped.
        """
        found: list[Any] = []
        for order in orders:
            try:
                found.append(self._filmed(order) if isinstance(order, Shot) else self._one(order))
            except UserError as error:
                self.drop(order.slot)
                found.append(str(error))
        return found

    def _one(self, order: Order) -> Went:
        one = self._instance(order.slot)
        if order.action is None:
            obs = one.reset(order.seed)
            return Went(obs, obs, 0.0, False, False, 0.0, 0.0, one.place)
        if order.replay is not None:
            self._go(one, order)
        obs, reward, terminated, truncated, success = one.step(order.action, self.max_steps)
        total, final_obs = one.total, obs
        if terminated or truncated:
            obs = one.reset(order.next_seed)
        return Went(obs, final_obs, reward, terminated, truncated, success, total, one.place)

    def _go(self, one: Running, order: Order) -> None:
        """Bring an instance to the place that an order names.

        Raises UserError if the environment does not repeat itself.
        """
        assert order.replay is not None
        one.reset(order.seed)
        for action in order.replay:
            one.step(action, self.max_steps)
        if one.place != order.place:
            raise UserError(
                f"environment {self.whose} does not repeat itself: with seed {order.seed} and the same "
                f"{len(order.replay)} actions it came elsewhere than before: let it draw from its own np_random alone, "
                "and reset everything in reset(seed=...)"
            )

    def _filmed(self, shot: Shot) -> list[np.ndarray]:
        """Return pictures of an episode; fewer where the episode ends before its actions do."""
        one = self._instance(shot.slot)
        before = self.filmed.get(shot.slot, shot.actions[:0])
        goes_on = one.seed == shot.seed and len(before) <= shot.first and len(before) == one.steps
        if not goes_on or not np.array_equal(before, shot.actions[: len(before)]):
            one.reset(shot.seed)
        frames = [one.picture()] if one.steps >= shot.first else []
        for action in shot.actions[one.steps :]:
            *_, terminated, truncated, _ = one.step(action, self.max_steps)
            if one.steps >= shot.first:
                frames.append(one.picture())
            if terminated or truncated:
                break
        self.filmed[shot.slot] = shot.actions[: one.steps]
        return frames

    def _instance(self, slot: int) -> Running:
        if slot not in self.running:
            try:
                env = self.make()
            except UserError:
                raise
            except Exception as error:
                raise user_code_error(f"environment {self.whose}, while it was made,", error) from error
            one = Running(env, self.whose)
            size = sum(leaf.size for leaf in one.leaves)
            if self.size and size != self.size:
                raise UserError(
                    f"environment {self.whose} has observations of {size} entries, its task says {self.size}: name the "
                    "environment anew"
                )
            self.running[slot] = one
        return self.running[slot]

    def drop(self, slot: int) -> None:
        """Close an instance, if it exists."""
        one = self.running.pop(slot, None)
        if one is not None:
            with contextlib.suppress(Exception):  # the instance is dropped, whatever closing raises
                one.env.close()

    def close(self) -> None:
        """Close all instances."""
        for slot in list(self.running):
            self.drop(slot)
