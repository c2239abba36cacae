"""The navigation teacher: a probabilistic road map of each world, and the direction of the shortest way over it.

Source: Kavraki, Svestka, Latombe, Overmars, "Probabilistic roadmaps for path planning in high-dimensional configuration
spaces" (1996). Nodes are drawn at random, most of them close round the solids, where shortest paths bend (Amato et al.,
"OBPRM", 1998). Every two nodes are joined that the body can walk between in a straight line however it is turned.
"""

from __future__ import annotations

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Float, Key, PRNGKeyArray

from cuelearner_envs.navigation.environment import AnyWalker, Navigation
from cuelearner_envs.navigation.geometry import clearance, fixed_point, line_clearance
from cuelearner_envs.navigation.robot import Robot
from cuelearner_envs.navigation.world import NavigationWorld, closed, heading
from cuelearner_jax.spaces.directions import from_angle, retract, rotate

NODES = 160
UNIFORM = 64  # candidates drawn uniformly
ROUND = 6  # candidates around a circle
NODE_MARGIN = 0.13  # a node keeps this much more than the body's reach from every solid [m]
LINE_MARGIN = 0.08  # and a line this much
YIELD = 0.001  # a line may come this much closer to a solid than its own start [m]
BLOCKED = 1e4  # added to the length of a way whose first line is blocked [m]


class RoadMap(struct.PyTreeNode):
    """The road map of one world, as a graph."""

    nodes: Float[Array, "nodes 2"]  # [m]
    lengths: Float[Array, "nodes nodes"]  # of the line between two nodes [m]; infinite where it is blocked


def build(key: PRNGKeyArray, world: NavigationWorld, robot: Robot) -> RoadMap:
    """The road map of a world for a robot's footprint."""
    k_place, k_order = jax.random.split(key)
    candidates, rank = _candidates(k_place, world, robot.reach + NODE_MARGIN)
    free = jax.vmap(partial(clearance, world))(candidates) >= robot.reach + NODE_MARGIN - 1e-4
    inside = (jnp.abs(candidates) < world.extent[None] / 2).all(-1)
    order = jnp.argsort(jnp.where(free & inside, rank + jax.random.uniform(k_order, rank.shape), jnp.inf))[:NODES]
    nodes, useful = candidates[order], (free & inside)[order]
    clear = jax.vmap(lambda a: jax.vmap(lambda b: line_clearance(world, a, b))(nodes))(nodes)
    joined = (clear >= robot.reach + LINE_MARGIN) & useful[:, None] & useful[None]
    return RoadMap(nodes, jnp.where(joined, jnp.linalg.norm(nodes[:, None] - nodes[None], axis=-1), jnp.inf))


def distances(
    roadmap: RoadMap, world: NavigationWorld, robot: Robot, goal: Float[Array, "2"]
) -> Float[Array, " nodes"]:
    """Length of the shortest way from each node to a goal [m]; infinite where there is none (Bellman and Ford)."""
    direct = jnp.linalg.norm(roadmap.nodes - goal[None], axis=-1)
    useful = jnp.isfinite(roadmap.lengths).any(-1)
    start = jnp.where(useful & (_view(roadmap, world, robot, goal) >= 0), direct, jnp.inf)

    return fixed_point(lambda length: jnp.minimum(length, (roadmap.lengths + length[None]).min(-1)), start)


def way(
    roadmap: RoadMap,
    world: NavigationWorld,
    robot: Robot,
    to_goal: Float[Array, " nodes"],
    position: Float[Array, "2"],
    goal: Float[Array, "2"],
) -> tuple[Float[Array, "2"], Float[Array, ""]]:
    """Return the next place to walk to in a straight line (the goal, if in view), and the whole way's length [m].

    `to_goal` are the goal's `distances`. From a position too close to a solid for the map, a line may be as close. If
    no line is clear, the length is more than `BLOCKED` and the place is at the end of the clearest line.
    """
    places = jnp.concatenate([roadmap.nodes, goal[None]])
    rest = jnp.append(to_goal, 0.0)
    room = jnp.append(_view(roadmap, world, robot, position), _room(world, robot, position, goal))
    penalty = jnp.where(room >= 0, 0.0, BLOCKED * (1.0 - room))
    lengths = jnp.linalg.norm(places - position[None], axis=-1) + rest + penalty
    best = jnp.argmin(lengths)
    return places[best], lengths[best]


def _view(
    roadmap: RoadMap, world: NavigationWorld, robot: Robot, position: Float[Array, "2"]
) -> Float[Array, " nodes"]:
    return jax.vmap(partial(_room, world, robot, position))(roadmap.nodes)


def _room(
    world: NavigationWorld, robot: Robot, position: Float[Array, "2"], place: Float[Array, "2"]
) -> Float[Array, ""]:
    """Clearance of a line beyond what it must have [m]: the map's, or that of its worse end."""
    ends = jnp.minimum(clearance(world, position), clearance(world, place))
    return line_clearance(world, position, place) - jnp.minimum(robot.reach + LINE_MARGIN, ends - YIELD)


def _candidates(
    key: PRNGKeyArray, world: NavigationWorld, away: Float[Array, ""] | float
) -> tuple[Float[Array, "many 2"], Float[Array, " many"]]:
    """Places for nodes, and their ranks: corners of boxes first, then round circles, beside boxes, anywhere."""
    signs = jnp.array([[1.0, 1.0], [1.0, -1.0], [-1.0, 1.0], [-1.0, -1.0]])
    sides = jnp.array([[1.0, 0.0], [-1.0, 0.0], [0.0, 1.0], [0.0, -1.0]])

    def of_box(box: Float[Array, "5"]) -> tuple[jax.Array, jax.Array]:
        corners = signs * (box[None, 3:] + away / 2**0.5)
        beside = sides * (box[None, 3:] + away)
        return tuple(box[None, :2] + rotate(points, box[2]) for points in (corners, beside))  # pyright: ignore

    def of_circle(circle: Float[Array, "3"], turn: Float[Array, ""]) -> jax.Array:
        # A polygon round the circle whose sides keep the distance, not only its corners.
        radius = (circle[2] + away) / jnp.cos(jnp.pi / ROUND)
        return circle[None, :2] + radius * from_angle(turn + jnp.arange(ROUND) * (2 * jnp.pi / ROUND))

    k_turn, k_anywhere = jax.random.split(key)
    corners, beside = jax.vmap(of_box)(world.boxes)
    turns = jax.random.uniform(k_turn, (world.circles.shape[0],), maxval=2 * jnp.pi)
    rounds = jax.vmap(of_circle)(world.circles, turns)
    anywhere = jax.random.uniform(k_anywhere, (UNIFORM, 2), minval=-0.5, maxval=0.5) * world.extent[None]
    kinds = [corners.reshape(-1, 2), rounds.reshape(-1, 2), beside.reshape(-1, 2), anywhere]
    ranks = [jnp.full(len(kind), rank) for kind, rank in zip(kinds, (0.0, 0.4, 0.8, 1.0), strict=True)]
    return jnp.concatenate(kinds), jnp.concatenate(ranks)


def _toward_goal(
    roadmap: RoadMap, world: NavigationWorld, robot: Robot, to_goal: Float[Array, " nodes"], state: AnyWalker
) -> Float[Array, "2"]:
    place, _ = way(roadmap, world, robot, to_goal, state.pose[:2], state.goal)
    return rotate(retract(place - state.pose[:2]), -state.pose[2])


class RoadMapTeacher(struct.PyTreeNode):
    """Knows every world of an environment (`cuelearner_jax.types.Teacher`).

    With a side, it passes every obstacle there: its maps are of worlds with the other side closed.
    """

    env: Navigation
    maps: RoadMap  # leading axes: worlds; with a side, also which side of them is closed, above and below
    to_goals: Float[Array, "*maps routes nodes"]  # `distances` of each route's goal
    side: Float[Array, ""] | None = None  # +1: on the left, -1: on the right

    def best_action(self, state: AnyWalker, obs: Float[Array, " obs"]) -> Float[Array, "2"]:
        """The direction of the shortest way to the goal, in the body's frame. Looks at the true state."""
        world, which = self.env.world(state.world), (state.world,)
        if self.side is not None:
            # Who goes along x and passes on the left passes above; below is then closed.
            above = -self.side * heading(self.env.worlds.starts[state.world, state.route], state.goal)
            world, which = closed(world, above), (state.world, jnp.where(above > 0, 0, 1))
        roadmap = jax.tree.map(lambda leaf: leaf[which], self.maps)
        return _toward_goal(roadmap, world, self.env.robot, self.to_goals[(*which, state.route)], state)


class BriefTeacher(struct.PyTreeNode):
    """A `RoadMapTeacher` that maps a world when it is asked in it: nothing to make, and each answer takes longer."""

    env: Navigation
    keys: Key[Array, " worlds"]  # of the maps

    def best_action(self, state: AnyWalker, obs: Float[Array, " obs"]) -> Float[Array, "2"]:
        """The direction of the shortest way to the goal, in the body's frame. Looks at the true state."""
        world, robot = self.env.world(state.world), self.env.robot
        roadmap = build(self.keys[state.world], world, robot)
        return _toward_goal(roadmap, world, robot, distances(roadmap, world, robot, state.goal), state)


@jax.jit
def make_teacher(env: Navigation, side: Float[Array, ""] | None = None) -> RoadMapTeacher:
    """Road maps of all worlds of an environment; `side`: +1 to pass every obstacle on the left, -1 on the right."""

    def mapped(key: PRNGKeyArray, world: NavigationWorld) -> tuple[RoadMap, Float[Array, "routes nodes"]]:
        roadmap = build(key, world, env.robot)
        return roadmap, jax.vmap(partial(distances, roadmap, world, env.robot))(world.goals)

    def each(pair: tuple[PRNGKeyArray, NavigationWorld]) -> Any:
        key, world = pair
        if side is None:
            return mapped(key, world)
        return jax.tree.map(lambda *two: jnp.stack(two), *(mapped(key, closed(world, above)) for above in (1.0, -1.0)))

    keys = _keys(env)
    maps, to_goals = jax.lax.map(each, (keys, env.worlds), batch_size=min(len(keys), 16))
    return RoadMapTeacher(env, maps, to_goals, side)


def make_brief_teacher(env: Navigation) -> BriefTeacher:
    """Who answers as `make_teacher`'s does, at once, and more slowly."""
    return BriefTeacher(env, _keys(env))


def _keys(env: Navigation) -> Key[Array, " worlds"]:
    return jax.random.split(jax.random.key(0), env.worlds.starts.shape[0])
