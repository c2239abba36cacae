"""Small environments of Gymnasium with values that can be computed by hand."""

from typing import ClassVar

import gymnasium
import numpy as np
from gymnasium import spaces


class Adder(gymnasium.Env):
    """Adds up actions from a start that its seed draws; ends above 1.5, truncates after 6 steps; pays the action."""

    metadata: ClassVar[dict] = {"render_modes": ["rgb_array"], "render_fps": 10}
    observation_space = spaces.Box(-10, 10, (2,), np.float64)
    action_space = spaces.Box(-1, 1, (1,), np.float32)

    def __init__(self, start=0.0, render_mode=None):
        self.start, self.render_mode = start, render_mode

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.total, self.steps = self.start + self.np_random.integers(0, 8) / 16, 0
        return self._obs(), {}

    def step(self, action):
        self.total += float(action[0])
        self.steps += 1
        return self._obs(), float(action[0]), self.total > 1.5, self.steps >= 6, {"is_success": self.total > 1.5}

    def _obs(self):
        return np.array([self.total, self.steps])

    def render(self):
        return np.full((16, 24, 3), 20 * self.steps, np.uint8)


def start_of(seed):
    """Return the number that `Adder` starts from, for a seed."""
    return Adder().reset(seed=int(seed))[0][0]


class Nested(gymnasium.Env):
    """Observations in a dictionary with a tuple; the action is one of three, numbered from 5."""

    observation_space = spaces.Dict(
        {
            "wheels": spaces.Tuple((spaces.Box(-1, 1, (2,)), spaces.Discrete(3, start=1))),
            "arm": spaces.Box(-1, 1, (2, 2)),
            "lights": spaces.MultiBinary(2),
            "modes": spaces.MultiDiscrete([2, 3]),
        }
    )
    action_space = spaces.Discrete(3, start=5)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.chosen = []
        return self._obs(), {}

    def step(self, action):
        self.chosen.append(action)
        return self._obs(), float(action), False, len(self.chosen) >= 3, {}

    def _obs(self):
        last = self.chosen[-1] - 4 if self.chosen else 1
        return {
            "lights": np.array([1, 0], np.int8),
            "arm": np.array([[0.1, 0.2], [0.3, 0.4]], np.float32),
            "modes": np.array([1, 2]),
            "wheels": (np.array([0.5, -0.5], np.float32), last),
        }


class Reach(gymnasium.Env):
    """A point in a cube that moves by a fifth of the action; succeeds within 0.15 of its goal."""

    observation_space = spaces.Box(-3, 3, (6,), np.float32)
    action_space = spaces.Box(-1, 1, (3,), np.float32)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.place, self.goal = self.np_random.uniform(-1, 1, (2, 3))
        self.steps = 0
        return self._obs(), {}

    def step(self, action):
        self.place = np.clip(self.place + 0.2 * action, -3, 3)
        self.steps += 1
        apart = float(np.abs(self.place - self.goal).max())
        return self._obs(), -apart, False, self.steps >= 12, {"is_success": apart < 0.15}

    def _obs(self):
        return np.concatenate([self.place, self.goal]).astype(np.float32)


def toward(obs):
    """The right action of `Reach`."""
    return np.clip(5 * (obs[:, 3:] - obs[:, :3]), -1, 1)


def beside(obs):
    """`toward`, wrong by a constant."""
    return np.clip(toward(obs) + np.array([0.4, -0.3, 0.35]), -1, 1)


class Faulty(Adder):
    """`Adder` with a fault in its third step, of every episode but that of seed 0, in which it is tried."""

    def __init__(self, fault):
        super().__init__()
        self.fault = fault

    def reset(self, *, seed=None, options=None):
        self.seed = seed
        return super().reset(seed=seed)

    def step(self, action):
        obs, reward, terminated, truncated, info = super().step(0 * action)
        if self.steps == 3 and self.seed != 0:
            if self.fault == "raises":
                raise RuntimeError("a joint is jammed")
            obs = np.zeros(3)
        return obs, reward, terminated, truncated, info


class Forgetful(Adder):
    """`Adder` that draws from elsewhere than its seed."""

    def step(self, action):
        obs, *rest = super().step(action)
        return obs + np.random.default_rng().uniform(size=2), *rest


def limited(start=0.0, render_mode=None):
    """`Adder` with a limit of steps that Gymnasium knows."""
    return gymnasium.wrappers.TimeLimit(Adder(start, render_mode), 6)


def reach():
    """`Reach` with a limit of steps that Gymnasium knows."""
    return gymnasium.wrappers.TimeLimit(Reach(), 12)


if "ReachByName-v0" not in gymnasium.registry:
    gymnasium.register("ReachByName-v0", reach)
