"""Length of the road map's ways and success of its policy, in validation worlds of each style.

    python benchmarks/roadmap_paths.py --write

Ways: length of the way from each route's start over the shortest path of a disc with the body's reach (0.465 m: clear
of it, the body may turn as it likes). The shortest path comes from a visibility graph of its own (NumPy, float64, and
SciPy's Dijkstra): each solid grown by the reach, its arcs as chords of 11.25 degrees with their ends on the arc, joined
along common tangents. The grown solids contain these polygons, so the reference is never longer than the true shortest
path; it is at most 0.2% shorter where it hugs solids. The map keeps more room: 0.08 m for lines and 0.13 m for nodes.
The ratio includes that; beside it stands the ratio over the shortest path that keeps a line's margin too, which leaves
what the map's random nodes cost. Where the goal is in view from the start both ways are the straight line, therefore
the routes where it is not ("round a solid") have figures of their own.

Episodes: outcomes of the road-map policy, the heuristic (straight at the goal) and uniform directions in the same
episodes, each environment's first.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import jax
import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import dijkstra

from cuelearner_envs.navigation.config import NavigationConfig, Style, make_environment
from cuelearner_envs.navigation.environment import Navigation
from cuelearner_envs.navigation.roadmap import BLOCKED, LINE_MARGIN, RoadMapTeacher, make_teacher, way
from cuelearner_envs.navigation.world import FAR_AWAY, World
from cuelearner_jax import evaluate
from cuelearner_jax.policies import Heuristic, Policy, Taught, Uniform
from cuelearner_jax.storage.provenance import provenance

RESULTS = Path(__file__).parent / "results" / "roadmap_paths.json"
STYLES: tuple[Style, ...] = ("clutter", "rooms", "corridor")
CHORDS = 8  # of a quarter circle
HALF = np.pi / (4 * CHORDS)  # half of a chord's angle [rad]
SLACK = 1e-9  # a line may be this much nearer than allowed, for rounding [m]

POLICIES: dict[str, Callable[[Navigation, RoadMapTeacher], Policy]] = {
    "road map": lambda env, teacher: Taught(teacher),
    "heuristic": lambda env, teacher: Heuristic(env),
    "uniform": lambda env, teacher: Uniform(),
}


def turned(points: np.ndarray, angle: np.ndarray) -> np.ndarray:
    """Points (..., 2), each turned counterclockwise by its angle (...)."""
    cos, sin = np.cos(angle), np.sin(angle)
    return np.stack([cos * points[..., 0] - sin * points[..., 1], sin * points[..., 0] + cos * points[..., 1]], -1)


def rings(boxes: np.ndarray, circles: np.ndarray, radius: float) -> list[np.ndarray]:
    """The corners of the polygon in each solid grown by `radius`, counterclockwise."""
    signs = np.array([[1.0, 1.0], [-1.0, 1.0], [-1.0, -1.0], [1.0, -1.0]])
    arcs = np.arange(4)[:, None] * np.pi / 2 + np.arange(CHORDS + 1) * 2 * HALF
    round_corner = radius * np.stack([np.cos(arcs), np.sin(arcs)], -1)
    of_boxes = [
        box[:2] + turned((signs[:, None] * box[3:] + round_corner).reshape(-1, 2), np.full(4 * (CHORDS + 1), box[2]))
        for box in boxes
    ]
    angles = np.arange(4 * CHORDS) * 2 * HALF
    circle = np.stack([np.cos(angles), np.sin(angles)], -1)
    return of_boxes + [row[:2] + (row[2] + radius) * circle for row in circles]


def to_points(points: np.ndarray, starts: np.ndarray, ends: np.ndarray) -> np.ndarray:
    """Distance from points to the lines between `starts` and `ends` (..., 2)."""
    along = ends - starts
    share = np.sum((points - starts) * along, -1) / np.maximum(np.sum(along * along, -1), 1e-30)
    return np.linalg.norm(points - starts - np.clip(share, 0.0, 1.0)[..., None] * along, axis=-1)


def free_lines(boxes: np.ndarray, circles: np.ndarray, radius: float, a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return which lines from a to b (lines, 2) stay out of the polygons' innermost circles and flanks."""
    to_circles = to_points(circles[:, :2], a[:, None], b[:, None])
    free = (to_circles >= (circles[:, 2] + radius) * np.cos(HALF) - SLACK).all(-1)
    p, q = (turned(ends[:, None] - boxes[:, :2], -boxes[:, 2]) for ends in (a, b))  # in the boxes' frames
    half = boxes[:, 3:]
    # A line enters a box where it has entered both of its slabs, and leaves it where it leaves either.
    with np.errstate(divide="ignore", invalid="ignore"):
        bounds = np.stack([(-half - p) / (q - p), (half - p) / (q - p)])
    still = (q == p) & (np.abs(p) <= half)
    never = (q == p) & (np.abs(p) > half)
    enter = np.where(still, 0.0, np.where(never, 2.0, bounds.min(0))).max(-1)
    leave = np.where(still, 1.0, np.where(never, -1.0, bounds.max(0))).min(-1)
    meets = np.maximum(enter, 0.0) <= np.minimum(leave, 1.0)
    ends = [np.linalg.norm(np.maximum(np.abs(x) - half, 0.0), axis=-1) for x in (p, q)]
    signs = np.array([[1.0, 1.0], [-1.0, 1.0], [-1.0, -1.0], [1.0, -1.0]])
    corners = [to_points(half * sign, p, q) for sign in signs]
    apart = np.where(meets, 0.0, np.minimum.reduce([*ends, *corners]))
    return free & (apart >= radius * np.cos(HALF) - SLACK).all(-1)


def shortest(world: World, radius: float, starts: np.ndarray, goals: np.ndarray) -> np.ndarray:
    """Length of the shortest path of a disc from each start to its goal [m]; infinite where there is none.

    A tangent visibility graph: a shortest path bends only at corners, and only along lines that touch the corner's own
    polygon without entering it. A line that enters no polygon keeps their inscribed distance from every solid, so that
    testing for the latter loses none.
    """
    boxes, circles = (np.asarray(rows, float) for rows in (world.boxes, world.circles))
    boxes, circles = (rows[np.abs(rows[:, 0]) < FAR_AWAY / 2] for rows in (boxes, circles))
    polygons = rings(boxes, circles, radius)
    points = np.concatenate([*polygons, starts, goals])
    following, preceding = (
        np.concatenate([*(np.roll(ring, by, axis=0) for ring in polygons), starts, goals]) for by in (-1, 1)
    )
    usable = (np.abs(points) < np.asarray(world.extent) / 2).all(-1)
    usable &= free_lines(boxes, circles, radius, points, points)
    usable[-2 * len(starts) :] = True
    points, following, preceding = points[usable], following[usable], preceding[usable]

    line = points[None] - points[:, None]  # [i, j]: from i to j
    sides = [
        line[..., 0] * (n - points)[:, None, 1] - line[..., 1] * (n - points)[:, None, 0]
        for n in (following, preceding)
    ]
    touches = sides[0] * sides[1] >= -(SLACK**2)
    i, j = np.nonzero(np.triu(touches & touches.T, 1))
    free = free_lines(boxes, circles, radius, points[i], points[j])
    i, j = i[free], j[free]
    graph = coo_array((np.linalg.norm(points[i] - points[j], axis=-1), (i, j)), shape=(len(points), len(points)))
    numbers = np.arange(len(points) - 2 * len(starts), len(points))
    lengths = dijkstra(graph.tocsr(), directed=False, indices=numbers[len(starts) :])
    return lengths[np.arange(len(starts)), numbers[: len(starts)]]


@jax.jit
def way_lengths(teacher: RoadMapTeacher) -> jax.Array:
    """Length of the road map's way from each start [m]: (worlds, routes)."""

    def of_world(pair: tuple[Any, World, jax.Array]) -> jax.Array:
        roadmap, world, to_goals = pair
        one = partial(way, roadmap, world, teacher.env.robot)
        return jax.vmap(lambda to_goal, start, goal: one(to_goal, start, goal)[1])(to_goals, world.starts, world.goals)

    return jax.lax.map(of_world, (teacher.maps, teacher.env.worlds, teacher.to_goals))


def ways(env: Navigation, teacher: RoadMapTeacher, worlds: int) -> dict[str, float]:
    """Ratios of lengths over all routes of the first worlds."""
    many = jax.tree.map(np.asarray, env.worlds)
    ours = np.asarray(way_lengths(teacher), float)[:worlds]
    reach = float(env.robot.reach)
    straight = np.linalg.norm(many.goals - many.starts, axis=-1)[:worlds]
    bounds = []
    for number in range(worlds):
        world = jax.tree.map(lambda leaf, number=number: leaf[number], many)
        bounds.append([shortest(world, reach + more, world.starts, world.goals) for more in (0.0, LINE_MARGIN)])
    exact, roomy = np.moveaxis(np.array(bounds), 1, 0)
    found = ours < BLOCKED
    ratio, over_roomy = ours[found] / exact[found], (ours / roomy)[found & np.isfinite(roomy)]
    bent = exact[found] > straight[found] + 1e-6
    return {
        "worlds": worlds,
        "routes": int(ours.size),
        "without_a_way": int((~found).sum()),
        "median": float(np.median(ratio)),
        "p90": float(np.quantile(ratio, 0.9)),
        "largest": float(ratio.max()),
        "smallest": float(ratio.min()),
        "bent": float(bent.mean()),
        "median_bent": float(np.median(ratio[bent])),
        "p90_bent": float(np.quantile(ratio[bent], 0.9)),
        "median_over_roomy": float(np.median(over_roomy)),
        "p90_over_roomy": float(np.quantile(over_roomy, 0.9)),
        "detour": float(np.median(exact[found] / straight[found])),
    }


@partial(jax.jit, static_argnames=("policy", "episodes", "steps"))
def outcomes(
    env: Navigation, teacher: RoadMapTeacher, *, policy: str, episodes: int, steps: int
) -> dict[str, jax.Array]:
    """Means over the first episodes."""
    key = evaluate.episodes("validation")
    return evaluate.rollout(POLICIES[policy](env, teacher), env, key, episodes, episodes * steps)


def main() -> None:
    """Measure everything and print the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--styles", nargs="+", default=list(STYLES), choices=STYLES)
    parser.add_argument("--worlds", type=int, default=200, help="whose ways are compared, all 16 routes of each")
    parser.add_argument("--episodes", type=int, default=2000, help="of each policy, in 256 worlds")
    parser.add_argument(
        "--write", type=Path, nargs="?", const=RESULTS, help="write the figures to a JSON file (default: %(const)s)"
    )
    arguments = parser.parse_args()

    paths, fares = [], []
    for style in arguments.styles:
        config = NavigationConfig(style=style, worlds=max(256, arguments.worlds))
        env = make_environment(config, "validation")
        teacher = make_teacher(env)
        began = time.perf_counter()
        paths.append({"style": style, **ways(env, teacher, arguments.worlds)})
        print(f"{style}, ways: {time.perf_counter() - began:.0f} s", flush=True)
        for policy in POLICIES:
            began = time.perf_counter()
            measured = outcomes(env, teacher, policy=policy, episodes=arguments.episodes, steps=config.max_steps)
            rates = {name: float(value) for name, value in measured.items()}
            fares.append({"style": style, "policy": policy, "episodes": arguments.episodes, **rates})
            print(f"{style}, {policy}: {time.perf_counter() - began:.0f} s", flush=True)

    print("\nway over shortest path    all routes               round a solid            over a path with 0.08 m more")
    print("style     routes  no way  median    90%  largest   share  median    90%     median    90%")
    for row in paths:
        print(
            f"{row['style']:<9} {row['routes']:6d}  {row['without_a_way']:6d}  {row['median']:6.4f} {row['p90']:6.4f}  "
            f"{row['largest']:7.4f}  {row['bent']:6.1%}  {row['median_bent']:6.4f} {row['p90_bent']:6.4f}     "
            f"{row['median_over_roomy']:6.4f} {row['p90_over_roomy']:6.4f}"
        )
    print("\nstyle     policy     success  collision  timeout  finished  duration [s]")
    for row in fares:
        print(
            f"{row['style']:<9} {row['policy']:<9} {row['success']:8.2%}  {row['collision']:9.2%}  "
            f"{row['timeout']:7.2%}  {row['finished']:8.2%}  {row['duration']:12.2f}"
        )
    if arguments.write:
        arguments.write.write_text(json.dumps({**provenance(), "ways": paths, "episodes": fares}, indent=1) + "\n")


if __name__ == "__main__":
    main()
