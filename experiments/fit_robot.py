"""Fits the simple robot of the navigation task (speed, lag, turn rate) to the quadruped's recorded responses.

    python experiments/fit_robot.py --write

Quadrupeds in C MuJoCo are told a direction every 0.2 s, each a random turn away from the last, as agents tell them.
From where and how fast each of them was at the beginning of a step, the simple robot's closed form (`robot.walk`) says
where it is at the end. Its three parameters are chosen to come nearest to where the quadruped was (least squares over
places, and headings weighted with the body's reach of 0.465 m), on half of the robots; errors are those of the others.
Writes docs/data/anymal_fit.json with --write.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from scipy.optimize import least_squares

from cuelearner_envs.anymal import model
from cuelearner_envs.anymal.environment import make_environment
from cuelearner_envs.anymal.judged import Course
from cuelearner_envs.navigation.config import NavigationConfig
from cuelearner_envs.navigation.robot import Motion, Robot, walk
from cuelearner_jax.spaces.directions import difference, from_angle
from cuelearner_jax.storage.provenance import provenance

RESULTS = Path(__file__).parents[1] / "docs" / "data" / "anymal_fit.json"
FITTED = ("speed", "lag", "turn_rate")


class Responses(NamedTuple):
    """Steps of navigation of many robots (steps, robots, ...), the robots that fell left out."""

    poses: np.ndarray  # (steps + 1, robots, 3): x, y, yaw [m, rad]
    velocities: np.ndarray  # (steps + 1, robots, 2): in the world's frame [m/s]
    actions: np.ndarray  # (steps, robots, 2)


def responses(robots: int, steps: int, turn_deg: float, seed: int) -> tuple[Responses, float]:
    """Return the quadruped's responses to commanded directions, and the share of robots that fell."""
    env = make_environment(NavigationConfig(worlds=1))
    course = Course(env, jax.random.split(jax.random.key(seed), robots))
    poses, velocities, actions = [course.poses], [np.zeros((robots, 2))], []
    rng = np.random.default_rng(seed)
    for _ in range(steps):
        # Mostly a little to a side, at times any way: new obstacles, and a start with the back to the goal.
        any_way = rng.uniform(size=robots) < 0.1
        turn = np.where(any_way, rng.uniform(-np.pi, np.pi, robots), np.deg2rad(turn_deg) * rng.normal(size=robots))
        actions.append(np.asarray(from_angle(jnp.asarray(turn, jnp.float32))))
        course.step(jnp.asarray(actions[-1]))
        poses.append(course.poses)
        velocities.append(course.judge.qvel[:, :2])
    stood = ~course.judge.fallen
    kept = (np.stack(leaf)[:, stood] for leaf in (poses, velocities, actions))
    return Responses(*kept), float(1.0 - stood.mean())


@jax.jit
def misses(parameters: jax.Array, seen: Any, period: float) -> tuple[jax.Array, jax.Array]:
    """Return the simple robot's errors of place (steps, robots, 2) [m] and heading [rad] against the quadruped."""
    robot = Robot(speed=parameters[0], lag=parameters[1], turn_rate=parameters[2])

    def one(pose: jax.Array, velocity: jax.Array, action: jax.Array, after: jax.Array) -> tuple[jax.Array, jax.Array]:
        told = walk(robot, Motion(pose, velocity), action, period).pose
        return told[:2] - after[:2], difference(from_angle(after[2]), from_angle(told[2]))

    return jax.vmap(jax.vmap(one))(seen.poses[:-1], seen.velocities[:-1], seen.actions, seen.poses[1:])


def errors(parameters: np.ndarray, seen: Responses, period: float) -> dict[str, float]:
    """Root mean squares over a step."""
    place, heading = (np.asarray(leaf) for leaf in misses(jnp.asarray(parameters), seen, period))
    return {
        "place_mm": 1e3 * float(np.sqrt(np.square(place).sum(-1).mean())),
        "heading_deg": float(np.rad2deg(np.sqrt(np.square(heading).mean()))),
    }


def fit(seen: Responses, period: float) -> np.ndarray:
    """The parameters that miss least."""
    reach = float(Robot().reach)

    def residuals(parameters: np.ndarray) -> np.ndarray:
        place, heading = misses(jnp.asarray(parameters, jnp.float32), seen, period)
        return np.concatenate([np.ravel(place), reach * np.ravel(heading)]).astype(float)

    start = np.array([float(getattr(Robot(), name)) for name in FITTED])
    # The closed forms are in single precision: steps of the difference quotient must not drown in its rounding.
    return least_squares(residuals, start, bounds=([0.1, 0.01, 0.1], [2.0, 1.0, 6.0]), diff_step=1e-2).x


def half(seen: Responses, which: int) -> Responses:
    """Every second robot."""
    return Responses(*(leaf[:, which::2] for leaf in seen))


def main() -> None:
    """Records, fits and tells."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--robots", type=int, default=64)
    parser.add_argument("--steps", type=int, default=50, help="of 0.2 s")
    parser.add_argument("--turn-deg", type=float, default=30.0, help="standard deviation of the directions told")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--write", type=Path, nargs="?", const=RESULTS, help="file (default: %(const)s)")
    asked = parser.parse_args()
    period = 10 * model.CONTROL_PERIOD
    seen, falls = responses(asked.robots, asked.steps, asked.turn_deg, asked.seed)
    found = fit(half(seen, 0), period)
    before = np.array([float(getattr(Robot(), name)) for name in FITTED])
    told = {
        "robots": asked.robots,
        "steps": asked.steps,
        "turn_deg": asked.turn_deg,
        "seed": asked.seed,
        "falls": falls,
        "before": {**dict(zip(FITTED, before.tolist(), strict=True)), **errors(before, half(seen, 1), period)},
        "fitted": {**dict(zip(FITTED, found.tolist(), strict=True)), **errors(found, half(seen, 1), period)},
    }
    for name in ("before", "fitted"):
        print(f"{name:7}", ", ".join(f"{key} {value:.3f}" for key, value in told[name].items()))
    if asked.write:
        asked.write.write_text(json.dumps({**provenance(), **told}, indent=1) + "\n")


if __name__ == "__main__":
    main()
