"""A NumPy policy that is wrong by a constant, corrected in a Gymnasium environment of twenty lines.

    python examples/correct_in_gymnasium.py

A hand is to go where a thing lies; the policy's actions are off by the same three numbers everywhere. A teacher,
another NumPy function, says of 200 actions "left" or "right", "up" or "down", "ahead" or "back". Prints the mean error
of actions before and after, and after answers drawn by chance about the same actions. A minute on 2 cores; needs the
extra `gymnasium`.
"""

import gymnasium
import numpy as np

import cuelearner_jax as cl

WRONG = np.array([0.4, -0.3, 0.35])  # of actions between -1 and 1


class Table(gymnasium.Env):
    """A hand and a thing in a box of a metre; a step moves the hand by at most 10 cm along each axis."""

    observation_space = gymnasium.spaces.Box(-1.0, 1.0, (6,), np.float64)
    action_space = gymnasium.spaces.Box(-1.0, 1.0, (3,), np.float64)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.thing, self.hand = self.np_random.uniform(-0.5, 0.5, (2, 3))
        return self.seen(), {}

    def seen(self):
        return np.concatenate([self.thing, self.hand])

    def step(self, action):
        self.hand = np.clip(self.hand + 0.1 * action, -1.0, 1.0)
        away = np.linalg.norm(self.thing - self.hand)
        return self.seen(), -away, False, False, {"success": away < 0.02}


def right(obs):
    """Actions (n, 3) for observations (n, 6): half of the way to the thing that is left, but no more than 0.6."""
    return np.clip(5.0 * (obs[:, :3] - obs[:, 3:]), -0.6, 0.6)


def wrong(obs):
    """The policy: the right action and a constant."""
    return np.clip(right(obs) + WRONG, -1.0, 1.0)


def error(policy, count=500):
    """Mean distance of a policy's actions from the right ones, in situations of their own."""
    obs = np.random.default_rng(7).uniform(-0.5, 0.5, (count, 6)).astype(np.float32)
    return float(np.linalg.norm(policy(obs) - right(obs), axis=1).mean())


def main(labels=200, guidance="reading", seed=0):
    """Errors of the policy, of the corrected one, and of the control."""
    slices = [("thing", 3, "m"), ("hand", 3, "m")]
    world = cl.from_gymnasium(
        Table, max_steps=20, cues="right,left;up,down;ahead,back", observation=slices, processes=1
    )
    how = {"guidance": guidance, "eps_deg": 0.05, "judge_by": "labels", "seed": seed}  # 5% of a cue's range
    better = cl.adapt(wrong, world, right, labels=labels, **how)
    answer = np.random.default_rng(seed).integers(-1, 2, better.labels.answer.shape).astype(np.float32)
    control = cl.adapt(wrong, world, labels=better.labels._replace(answer=answer), **how)
    errors = {"as it was": error(wrong), "corrected": error(better), "answers by chance": error(control)}
    for name, value in errors.items():
        print(f"{name}: mean error {value:.3f}")
    return errors


if __name__ == "__main__":
    main()
