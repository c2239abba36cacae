"""Correct any function of observations by a teacher's "more to the left", "more to the right", "already right".

    python examples/correct_a_policy.py

The policy walks to the goal with a compass that is 40 degrees off. Prints its success rate and that of the refined one
over validation episodes. A few minutes on 2 cores.
"""

import numpy as np

import cuelearner_jax as cl
from cuelearner_jax.evaluate import episodes, rollout_with_progress
from cuelearner_jax.policies import policy_of

ANGLE = np.radians(40.0)
TURN = np.array([[np.cos(ANGLE), -np.sin(ANGLE)], [np.sin(ANGLE), np.cos(ANGLE)]])


def compass(obs):
    """Directions (n, 2) for observations (n, 280): entries 271 and 272 point to the goal."""
    return obs[:, 271:273] @ TURN.T


def main(worlds=64, labels=200, episodes_judged=100, episodes_measured=100):
    """Return the success rates before and after so many answers."""
    world = cl.make("navigation", style="clutter", worlds=worlds)
    teacher = cl.teacher_of(world)
    better = cl.adapt(
        compass,
        world,
        teacher,
        labels=labels,
        eps_deg=20.0,
        bound_deg=90.0,
        judge_by="success",
        judge_episodes=episodes_judged,
    )
    env, key = world.environment("validation"), episodes()
    rates = []
    for name, policy in (("compass", policy_of(compass)), ("refined", better.policy)):
        found = rollout_with_progress(env, policy, key, episodes_measured, 200 * episodes_measured).means
        rates.append(float(found["success"]))
        print(f"{name}: success {rates[-1]:.2f}, collision {float(found['collision']):.2f}")
    return rates


if __name__ == "__main__":
    main()
