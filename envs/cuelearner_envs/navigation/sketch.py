"""A robot among obstacles as lines for a browser, and where a direction leads: quick, and without matplotlib.

The robot faces up, in the middle of the sketch's lower part; what its lidar perceives lies over what is there.
"""

from __future__ import annotations

import math
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from cuelearner_envs import svg
from cuelearner_envs.navigation.environment import Navigation
from cuelearner_envs.navigation.lidar import BEAM_ANGLES
from cuelearner_envs.navigation.robot import hull
from cuelearner_envs.navigation.world import corners, solids_of
from cuelearner_jax.spaces.directions import rotate
from cuelearner_jax.types import Reel, Sketch

AHEAD, BEHIND, ASIDE = 9.0, 4.0, 6.5  # extent that is shown at least [m]
AROUND = 2 * (AHEAD + BEHIND)  # extent that is drawn; a page of another shape than the sketch shows more of it [m]
INSET = 0.5  # distance of a far goal's mark from the edge [m]
STEPS = 15  # of a film
DOT = 0.05  # radius of a beam's end [m]
WORDS = {"success": "the goal is reached", "collision": "collision", "fall": "it falls", "timeout": "out of time"}


def sketch(env: Navigation, state: Any) -> Sketch:
    """Return the robot's surroundings as a sketch, from above."""
    world, goal, pose, ranges = jax.device_get(_view(env, state))
    parts = [svg.rectangle(-AROUND, -AROUND, 2 * AROUND, 2 * AROUND, "fill:var(--floor)")]
    shapes = []
    for row, height in solids_of(world):
        fill, is_box = "fill:var(--solid)" if height > 1.0 else "fill:var(--low)", len(row) == 5
        at = _placed(corners(row) if is_box else row[None, :2], pose)
        shapes.append((height, svg.polygon(at, fill) if is_box else svg.circle(at[0], float(row[2]), fill)))
    parts += [shape for _, shape in sorted(shapes)]  # seen from above, the tall cover the low
    ends = _up(ranges[:, None] * np.stack([np.cos(BEAM_ANGLES), np.sin(BEAM_ANGLES)], axis=-1))
    parts.append(svg.polygon([(0.0, 0.0), *ends], "fill:var(--free);fill-opacity:0.25"))
    hits = ends[ranges < 0.999 * float(env.lidar.max_range)]
    dots = "".join(f"M{svg.number(x)} {svg.number(y)}h0" for x, y in hits)
    line = f"fill:none;stroke:var(--hit);stroke-width:{2 * DOT};stroke-linecap:round"
    parts.append(svg.element("path", d=dots, style=line))
    at, away = _placed(goal[None], pose)[0], float(np.linalg.norm(goal - pose[:2]))
    parts.append(_goal(at, float(env.goal_radius), away))
    body, chevron = hull(env.robot)
    look = "fill:var(--body);stroke:#222222;stroke-width:0.04"
    return Sketch(
        box=(-ASIDE, -AHEAD, 2 * ASIDE, AHEAD + BEHIND),
        still="".join(parts),
        movers={"robot": svg.polygon(body, look) + svg.polygon(chevron, "fill:#222222")},
        places={"robot": (0.0, 0.0, -90.0)},
        foot=(0.0, 0.0),
        reach=(0.55, 2.2),
        turn=90.0,
        aim=2.5,
        words=f"{away:.1f} m from the goal",
    )


@jax.jit
def _view(env: Navigation, state: Any) -> Any:
    return env.world(state.world), state.goal, state.pose, env.ranges(state)


@jax.jit
def _walked(env: Navigation, state: Any, action: jax.Array) -> tuple[Array, dict[str, Array]]:
    heading = rotate(action, state.pose[2])

    def one(state: Any, _: None) -> tuple[Any, tuple[Array, dict[str, Array]]]:
        after = env.move(state, rotate(heading, -state.pose[2]))
        return after, (after.pose, env.ends(after)[0])

    return jax.lax.scan(one, state, None, length=STEPS)[1]


def reel(env: Navigation, state: Any, action: Float[Array, "2"]) -> Reel:
    """The robot holds the direction, as seen on the map, for `STEPS` steps or until the episode ends."""
    poses, outcomes = jax.device_get(_walked(env, state, jnp.asarray(action)))
    start = np.asarray(state.pose, float)
    ended = {name: np.flatnonzero(outcomes[name] > 0) for name in WORDS if name in outcomes}
    ended = {name: int(steps[0]) for name, steps in ended.items() if len(steps)}
    last = min(ended.values(), default=STEPS - 1)
    period = float(env.period)
    how = next((WORDS[name] for name, step in ended.items() if step == last), "the way is free")
    frames: list[dict[str, tuple[float, float, float] | None]] = [{"robot": (0.0, 0.0, -90.0)}]
    for pose in poses[: last + 1]:
        x, y = _placed(pose[None, :2], start)[0]
        frames.append({"robot": (float(x), float(y), -90.0 - math.degrees(float(pose[2]) - start[2]))})
    return Reel(period / 2, frames, f"held for {(last + 1) * period:.1f} s: {how}")


def _up(points: np.ndarray) -> np.ndarray:
    """Points in the body's frame, ahead and to the left, as they are on the screen."""
    return np.stack([-points[:, 1], -points[:, 0]], axis=-1)


def _placed(points: np.ndarray, pose: np.ndarray) -> np.ndarray:
    """Points of the world as they are on the screen."""
    cos, sin = math.cos(float(pose[2])), math.sin(float(pose[2]))
    return _up((np.asarray(points, float) - pose[:2]) @ np.array([[cos, -sin], [sin, cos]]))


def _goal(at: np.ndarray, radius: float, away: float) -> str:
    low, high = np.array([-ASIDE, -AHEAD]) + INSET, np.array([ASIDE, BEHIND]) - INSET
    ring = svg.circle(tuple(at), radius, "fill:var(--goal);fill-opacity:0.25;stroke:var(--goal);stroke-width:0.06")
    mark = ring + svg.circle(tuple(at), 0.16, "fill:var(--goal)")
    if (at >= low).all() and (at <= high).all():
        return mark
    # Farther away: where the way there leaves the sketch, as an arrow's head.
    bounds = np.where(at > 0, high, -low) / np.maximum(np.abs(at), 1e-9)
    edge = at * bounds.min()
    turn = math.degrees(math.atan2(edge[1], edge[0]))
    place = f"translate({svg.number(edge[0])} {svg.number(edge[1])}) rotate({svg.number(turn)})"
    head = svg.polygon([(0.4, 0.0), (-0.3, -0.35), (-0.3, 0.35)], "fill:var(--goal)")
    inside = edge * (1 - 1.6 / max(float(np.linalg.norm(edge)), 1.6))
    words = svg.text(tuple(inside), 0.4, f"goal {away:.0f} m", "fill:var(--goal);font-weight:bold")
    return mark + svg.element("g", head, transform=place) + words
