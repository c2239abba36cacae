"""Meta-World with pictures in changed worlds, in processes of its own.

Needs lerobot 0.6.1 and `pip install --no-deps metaworld`. A policy sees one picture of the camera `corner2`, and the
hand's place and opening. Its reset of the gripper's weld writes 11 numbers where MuJoCo 3.17 has 12 columns: the first
11 are filled.
"""

from __future__ import annotations

import multiprocessing
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, NamedTuple, Protocol

import metaworld
import mujoco
import numpy as np
from lerobot.envs import metaworld as of_lerobot
from metaworld.sawyer_xyz_env import SawyerMocapBase

TASKS = ("reach-v3", "button-press-v3", "drawer-open-v3", "door-open-v3")  # reported
# on which settings are chosen
TUNING = ("coffee-button-v3", "button-press-topdown-v3", "faucet-open-v3", "window-open-v3")
SIZE = 128  # of a picture [pixels]
STEPS = 200  # of an episode at most
CAMERA, PLACE = 2, (0.75, 0.075, 0.7)  # `corner2`, where LeRobot has it [m]
DISTURBED = 0.3  # spread of the disturbance of a demonstration's motion, so that recoveries are shown


class Change(NamedTuple):
    """The change of a world."""

    aside: float = 0.0  # of the camera, along the picture's horizontal [m]
    pan: float = 0.0  # of the camera, about the vertical [deg]
    gain: float = 1.0  # of the executed motion
    turn: float = 0.0  # of the executed motion, about the vertical [deg]


CHANGES = {
    "nothing": Change(),
    "camera 5 cm aside": Change(aside=0.05),
    "camera 10 cm aside": Change(aside=0.1),
    "camera turned by 5 degrees": Change(pan=5.0),
    "gain 0.8": Change(gain=0.8),
    "motion turned by 20 degrees": Change(turn=20.0),
}


def motion(change: Change, action: np.ndarray, back: bool = False) -> np.ndarray:
    """Return the action (4,) as it is executed; `back`: the one that is executed as the given one."""
    angle = np.deg2rad(-change.turn if back else change.turn)
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    moved = np.array(action, float)
    moved[:2] = turn @ moved[:2]
    moved[:3] *= 1 / change.gain if back else change.gain
    return np.clip(moved, -1, 1).astype(np.float32)


class ChangedMetaworld(of_lerobot.MetaworldEnv):
    """LeRobot's environment of a task, with smaller pictures and a change."""

    def __init__(self, task: str, size: int = SIZE) -> None:
        super().__init__(task, obs_type="pixels_agent_pos", observation_width=size, observation_height=size)
        self.change = CHANGES["nothing"]

    def _ensure_env(self) -> None:
        if self._env is not None:
            return
        SawyerMocapBase.reset_mocap_welds = _reset_welds
        one = metaworld.MT1(self._env_name, seed=42)
        size = {"width": self.observation_width, "height": self.observation_height}
        env: Any = one.train_classes[self._env_name](render_mode="rgb_array", camera_name=self.camera_name, **size)
        env.set_task(one.train_tasks[0])
        env.reset()
        env._freeze_rand_vec, env.seeded_rand_vec = False, True
        env.model.vis.quality.shadowsize = 0  # pictures without shadows, which take long without a GPU
        self._turned = env.model.cam_quat[CAMERA].copy()
        self._env = env
        self.move_camera()

    def move_camera(self) -> None:
        """Put the camera where the change has it."""
        self._ensure_env()
        model, axes, turned = self._env.model, np.zeros(9), np.zeros(4)
        mujoco.mju_quat2Mat(axes, self._turned)
        half = np.deg2rad(self.change.pan) / 2
        mujoco.mju_mulQuat(turned, np.array([np.cos(half), 0, 0, np.sin(half)]), self._turned)
        model.cam_pos[CAMERA] = PLACE + self.change.aside * axes.reshape(3, 3)[:, 0]
        model.cam_quat[CAMERA] = turned

    def start(self, change: str, seed: int) -> np.ndarray:
        """Begin an episode and return the whole observation (39,)."""
        self.change = CHANGES[change]
        self.move_camera()
        self._env.seed(seed)
        return self._env.reset(seed=seed)[0]

    def intended(self, obs: np.ndarray) -> np.ndarray:
        """Return the script's action, for the world as it is."""
        return motion(self.change, np.clip(self.expert_policy.get_action(obs), -1, 1), back=True)


def _reset_welds(env: Any) -> None:
    for number in np.flatnonzero(env.model.eq_type == mujoco.mjtEq.mjEQ_WELD):
        env.model.eq_data[number][:11] = [0, 0, 0, 0, 0, 0, -1, 0, 0, 0, 5]


Plan = Callable[[np.ndarray, np.ndarray], np.ndarray]  # pictures (n, h, w, 3), states (n, 4) -> chunks (n, T, 4)


class Correction(Protocol):
    """A correction beside a policy."""

    shift: np.ndarray  # (4,): added to the state that the policy sees

    def correct(self, inputs: np.ndarray) -> np.ndarray:
        """Return actions (n, 4) of inputs (n, 25), as in `Episode`."""
        ...


class Demonstration(NamedTuple):
    """An episode of the script until its first success."""

    pictures: np.ndarray  # (steps, height, width, 3)
    states: np.ndarray  # (steps, 4)
    actions: np.ndarray  # (steps, 4): the script's, without the disturbance of the motion


class Episode(NamedTuple):
    """An episode of a policy."""

    success: bool
    picture: np.ndarray  # (height, width, 3): the first
    inputs: np.ndarray  # (steps, 25): state, phase in the chunk, effects of the state, action proposed without a shift
    intended: np.ndarray  # (steps, 4): the script's actions in these situations


class Robots:
    """Worlds of one task in processes of their own."""

    def __init__(self, task: str, processes: int, size: int = SIZE) -> None:
        """Start before a GPU or JAX is in use: the processes are forks."""
        context = multiprocessing.get_context("fork")
        self.pipes = []
        for _ in range(processes):
            here, there = context.Pipe()
            context.Process(target=_serve, args=(task, size, there), daemon=True).start()
            self.pipes.append(here)

    def call(self, requests: dict[int, tuple[Any, ...]]) -> dict[int, Any]:
        """Send requests to processes by their number, and return the answers."""
        for number, request in requests.items():
            self.pipes[number].send(request)
        return {number: self.pipes[number].recv() for number in requests}

    def demonstrations(self, change: str, first_seed: int, count: int) -> list[Demonstration]:
        """Return episodes of the script that succeed."""
        episodes: list[Demonstration] = []
        while len(episodes) < count:
            seeds = range(first_seed, first_seed + len(self.pipes))
            made = self.call({number: ("record", change, seed) for number, seed in enumerate(seeds)})
            episodes += [one for one in made.values() if one is not None]
            first_seed += len(self.pipes)
        return episodes[:count]

    def play(
        self,
        change: str,
        seeds: Sequence[int],
        plan: Plan,
        correction: Correction | None,
        every: int,
        widths: Sequence[float] = (),
    ) -> list[Episode]:
        """Return an episode a seed; `plan` gives a chunk every `every` steps, `correction` corrects its actions.

        Where `widths` (4,) are given, the policy is asked as far to both sides of each entry of the state, and inputs
        hold how its action changes with the state; else zeros.
        """
        episodes: list[Episode] = []
        for start in range(0, len(seeds), len(self.pipes)):
            part = seeds[start : start + len(self.pipes)]
            episodes += self._wave(change, part, partial(_with_effects, plan, every, np.array(widths)), correction)
        return episodes

    def _wave(
        self, change: str, seeds: Sequence[int], plan: Callable[..., np.ndarray], correction: Correction | None
    ) -> list[Episode]:
        replies = first = self.call({number: ("start", change, seed) for number, seed in enumerate(seeds)})
        inputs: list[list[np.ndarray]] = [[] for _ in seeds]
        intended: list[list[np.ndarray]] = [[] for _ in seeds]
        success, chunks = np.zeros(len(seeds), bool), np.zeros((0, 0, 0))
        for step in range(STEPS):
            active = list(replies)
            phase = step % chunks.shape[1] if step else 0
            states = np.stack([replies[number]["state"] for number in active])
            if phase == 0:
                pictures = np.stack([replies[number]["picture"] for number in active])
                planned = plan(pictures, states, 0 if correction is None else correction.shift)
                chunks = np.zeros((len(seeds), *planned.shape[1:]), np.float32)
                chunks[active] = planned
            every, own = chunks.shape[1], chunks[active, phase]
            rows = np.concatenate([states, np.full((len(active), 1), phase / every), own], 1).astype(np.float32)
            actions = rows[:, -4:] if correction is None else correction.correct(rows)
            for number, row in zip(active, rows, strict=True):
                inputs[number].append(row)
                intended[number].append(replies[number]["intended"])
            looks = phase == every - 1
            replies = self.call({n: ("step", action, looks) for n, action in zip(active, actions, strict=True)})
            success[[number for number, one in replies.items() if one["success"]]] = True
            replies = {number: one for number, one in replies.items() if not one["success"]}
            if not replies:
                break
        return [
            Episode(bool(success[n]), first[n]["picture"], np.stack(inputs[n]), np.stack(intended[n]))
            for n in range(len(seeds))
        ]


def _with_effects(
    plan: Plan, every: int, widths: np.ndarray, pictures: np.ndarray, states: np.ndarray, shift: np.ndarray | int
) -> np.ndarray:
    """Return, for each step of a chunk, the effects of the state and the proposed action (n, every, 20).

    With effects the action is that without the shift, as far as they tell.
    """
    ways = np.concatenate([np.diag(widths), -np.diag(widths)]) if len(widths) else np.zeros((0, 4))
    probes = (np.concatenate([np.zeros((1, 4)), ways])[:, None] + states + shift).astype(np.float32)
    chunks = plan(np.tile(pictures, (len(probes), 1, 1, 1)), probes.reshape(-1, 4))[:, :every]
    chunks = np.clip(chunks, -1, 1).reshape(len(probes), len(states), every, 4)
    effects = np.zeros((len(states), every, 4, 4))
    for entry, width in enumerate(widths):
        effects[:, :, entry] = (chunks[1 + entry] - chunks[1 + len(widths) + entry]) / max(2 * width, 1e-6)
    own = chunks[0] - np.einsum("s,ntsa->nta", np.broadcast_to(shift, 4), effects)
    return np.concatenate([effects.reshape(len(states), every, 16), own], 2)


def _serve(task: str, size: int, pipe: Any) -> None:
    """Answer requests until the other end closes."""
    world = ChangedMetaworld(task, size)
    while True:
        try:
            what, *rest = pipe.recv()
        except EOFError:
            return
        pipe.send(_record(world, *rest) if what == "record" else _played(world, what, *rest))


def _played(world: ChangedMetaworld, what: str, first: Any, second: Any) -> dict[str, Any]:
    success = False
    if what == "start":
        obs, looks = world.start(first, second), True
    else:
        obs, _, _, _, info = world._env.step(motion(world.change, first))
        success, looks = bool(info["success"]), second
    picture = world.render() if looks and not success else None
    state = obs[:4].astype(np.float32)
    return {"state": state, "picture": picture, "intended": world.intended(obs), "success": success}


def _record(world: ChangedMetaworld, change: str, seed: int) -> Demonstration | None:
    """Return an episode of the script, or None if it fails."""
    obs, random, rows = world.start(change, seed), np.random.default_rng(seed), []
    for _ in range(STEPS):
        action = world.intended(obs)
        rows.append((np.ascontiguousarray(world.render()), obs[:4].astype(np.float32), action))
        disturbed = action + DISTURBED * random.normal(size=4) * (1, 1, 1, 0)
        obs, _, _, _, info = world._env.step(motion(world.change, np.clip(disturbed, -1, 1)))
        if info["success"]:
            return Demonstration(*(np.stack(column) for column in zip(*rows, strict=True)))
    return None
