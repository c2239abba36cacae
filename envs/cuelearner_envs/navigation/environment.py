"""Navigation as a task: what the robot perceives, when an episode ends, what it pays (CueLearner paper, section V-B).

One step is one control step of walking in a chosen direction. Reward: +10 at the goal, -10 for touching anything.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, ArrayLike, Bool, Float, Int, PRNGKeyArray

from cuelearner_envs.navigation.aims import UNSEEN, aims_of
from cuelearner_envs.navigation.lidar import BEAMS, Lidar
from cuelearner_envs.navigation.robot import Robot, collides, walk
from cuelearner_envs.navigation.world import NavigationWorld, count_passed, heading
from cuelearner_envs.navigation.worlds import FARTHEST
from cuelearner_jax.environment import Aims, Described, Features, Quantity
from cuelearner_jax.spaces.directions import inward, retract, rotate, to_angle
from cuelearner_jax.types import Step

REMEMBERED = 3  # actions in the observation
RING = 360  # directions all round in which `features` gives how near things are: as far apart as beams are
Scalar = float | Float[Array, ""]


class Walker(struct.PyTreeNode):
    """State between steps."""

    pose: Float[Array, "3"]  # x, y, yaw [m, rad]
    velocity: Float[Array, "2"]  # in the world's frame [m/s]
    goal: Float[Array, "2"]  # [m]
    previous: Float[Array, "3 2"]  # actions, the latest first, as they were given; zeros before the first
    world: Int[Array, ""]
    route: Int[Array, ""]  # of that world
    steps: Int[Array, ""]  # taken in this episode
    passed: Float[Array, "2"] | None = None  # obstacles on the left and on the right in this episode, where they count


AnyWalker = Any  # a `Walker`, or what another body has in its place: pose, goal, previous, world, route and steps


class Navigation(Described, struct.PyTreeNode):
    """The environment (`cuelearner_jax.environment.Environment`). Everything but the last four fields is traced."""

    worlds: NavigationWorld  # leading axis: worlds
    robot: Robot = Robot()
    lidar: Lidar = Lidar()
    max_steps: Int[Array, ""] | int = 200  # an episode is truncated after this many
    period: Scalar = 0.2  # duration of a step [s]
    goal_radius: Scalar = 0.5  # nearer than this, the goal is reached [m]
    goal_rotation: Scalar = 0.0  # the goal's direction is measured turned by this [rad]
    mirrors: bool = struct.field(pytree_node=False, default=False)  # offer the mirror image as data?
    sides: bool = struct.field(pytree_node=False, default=False)  # say on which side obstacles were passed?
    look_ahead: bool = struct.field(pytree_node=False, default=False)  # do aims tell where a second leg leads?
    keep_scans: bool = struct.field(pytree_node=False, default=False)  # does replay store whole observations?

    observation = (
        Quantity(
            "lidar",
            BEAMS,
            "1",
            "exp(-distance / 1 m) of each beam, from -135 to +135 degrees, counterclockwise",
            "beams",
            step_deg=1.0,
        ),
        Quantity("goal: direction", 2, "1", "unit vector in the body's frame", "directions"),
        Quantity("goal: distance", 1, f"{FARTHEST:g} m"),
        Quantity("previous actions", 2 * REMEMBERED, "1", "unit vectors, the latest first; zeros before the first"),
    )
    action = Quantity("direction", 2, "1", "unit vector in the body's frame, x ahead, y to the left; walked for a step")

    @property
    def symmetries(self) -> int:
        """Identity, and left and right exchanged: body, lidar and motion are symmetric, worlds are as likely as not."""
        return 2 if self.mirrors else 1

    def view(self) -> Navigation:
        """The environment without its worlds, at which no policy looks."""
        return self.replace(worlds=None)

    def world(self, index: Int[ArrayLike, "*n"]) -> NavigationWorld:
        """Return one world, or one for each index."""
        return jax.tree.map(lambda leaf: leaf[index], self.worlds)

    def reset(self, key: PRNGKeyArray) -> tuple[AnyWalker, Float[Array, " obs"]]:
        """Stand still, turned at random, at the start of a random route of a random world."""
        state = self._start(key)
        return state, self.observe(state)

    def step(self, key: PRNGKeyArray, state: AnyWalker, action: Float[Array, "2"]) -> tuple[AnyWalker, Step]:
        """Walk for one period in the direction; a new episode follows an end."""
        after = self.counted(state, self.move(state, action))
        outcome, terminated, truncated = self.ends(after)
        following = jax.tree.map(lambda new, old: jnp.where(terminated | truncated, new, old), self._start(key), after)
        final_obs = self.observe(after)
        step = Step(
            obs=self.observe(following),
            final_obs=final_obs,
            aftermath=final_obs if self.keep_scans else self.place(after),
            reward=10.0 * outcome["success"] - 10.0 * (terminated - outcome["success"]),
            terminated=terminated,
            truncated=truncated,
            metrics={"speed": jnp.linalg.norm(after.pose[:2] - state.pose[:2]) / self.period},
            outcome=outcome,
        )
        return following, step

    def ends(self, after: AnyWalker) -> tuple[dict[str, Float[Array, ""]], Bool[Array, ""], Bool[Array, ""]]:
        """Return outcome (1 or 0 each, and the time since the start [s]), terminated and truncated of a step's end."""
        failures = self.failures(after)
        failed = jnp.stack(list(failures.values())).any()
        success = (jnp.linalg.norm(after.goal - after.pose[:2]) < self.goal_radius) & ~failed
        terminated = success | failed
        truncated = (after.steps >= self.max_steps) & ~terminated
        outcomes = {"success": success, **failures, "timeout": truncated, **self.sides_of(after)}
        outcome = {name: value.astype(jnp.float32) for name, value in outcomes.items()}
        return {**outcome, "duration": after.steps * jnp.asarray(self.period)}, terminated, truncated

    def counted(self, before: AnyWalker, after: AnyWalker) -> AnyWalker:
        """The state after a step with the obstacles that it passed, where these count."""
        if not self.sides:
            return after
        world, ahead = self.world(before.world), heading(self.worlds.starts[before.world, before.route], before.goal)
        return after.replace(passed=before.passed + count_passed(world, ahead, before.pose[:2], after.pose[:2]))

    def sides_of(self, state: AnyWalker) -> dict[str, Bool[Array, ""]]:
        """Whether all obstacles passed so far were passed on one side, or some on either; none holds before the first.

        Nothing where sides do not count.
        """
        if not self.sides:
            return {}
        left, right = state.passed > 0
        return {"passed_left": left & ~right, "passed_right": right & ~left, "passed_both": left & right}

    def move(self, state: AnyWalker, action: Float[Array, "2"]) -> AnyWalker:
        """The state after a step, without a reset."""
        pose, velocity = walk(self.robot, state.pose, state.velocity, action, self.period)
        previous = latest_first(action, state.previous)
        return state.replace(pose=pose, velocity=velocity, previous=previous, steps=state.steps + 1)

    def failures(self, state: AnyWalker) -> dict[str, Bool[Array, ""]]:
        """Return the failures that end an episode, by name; at most one holds."""
        return {"collision": self.collided(state)}

    def place(self, state: AnyWalker) -> Float[Array, " place"]:
        """Return the sensor's place on the body, which replay stores."""
        return state.pose

    def placed(
        self,
        place: Float[Array, " place"],
        goal: Float[Array, "2"],
        previous: Float[Array, "3 2"],
        world: Int[Array, ""],
        route: Int[Array, ""],
    ) -> AnyWalker:
        """A state at rest at a place."""
        return Walker(place, jnp.zeros(2), goal, previous, world, route, jnp.zeros((), jnp.int32))

    def collided(self, state: AnyWalker) -> Bool[Array, ""]:
        """Whether the body touches anything."""
        return collides(self.robot, self.world(state.world), state.pose)

    def ranges(self, state: AnyWalker) -> Float[Array, "271"]:
        """The lidar's distances as the robot perceives them [m]."""
        return self.lidar.read(self.world(state.world), state.pose)

    def observe(self, state: AnyWalker) -> Float[Array, " obs"]:
        """Return the robot's observation, see `observation`; every entry is of the order of 1."""
        offset = rotate(state.goal - state.pose[:2], self.goal_rotation - state.pose[2])
        distance = jnp.linalg.norm(offset)
        return jnp.concatenate(
            [jnp.exp(-self.ranges(state)), retract(offset), distance[None] / FARTHEST, state.previous.ravel()]
        )

    def heuristic(self, obs: Float[Array, " obs"]) -> Float[Array, "2"]:
        """Straight toward the goal."""
        return obs[BEAMS : BEAMS + 2]

    def features(self, obs: Float[Array, " obs"], actions: Float[Array, "*n 2"]) -> Features:
        """Return features of what lies ahead, to the left and to the right of a robot that walks in the direction.

        - own, 1: the distance to the goal
        - turned, 370: nearness all round in steps of one degree; goal and previous actions along and across the
          direction; the direction in the body's frame

        Nearness begins behind and goes by way of the right, so that the direction itself is in the middle. Between two
        beams it is interpolated, and where the lidar does not look it is `UNSEEN`.
        """
        count = actions.shape[:-1]
        ring = jnp.concatenate([obs[:BEAMS], jnp.full(RING - BEAMS, UNSEEN)])  # from -135 degrees on, counterclockwise
        behind = to_angle(actions) * (RING / (2 * jnp.pi)) - RING / 2 + (BEAMS - 1) / 2  # number of the first beam
        first = jnp.floor(behind)
        near = (behind - first)[..., None]
        numbers = jnp.mod(first.astype(jnp.int32), RING)
        twice = jnp.concatenate([ring, ring, ring[:1]])
        slices = jax.vmap(lambda number: jax.lax.dynamic_slice(twice, (number,), (RING + 1,)))(numbers.ravel())
        slices = slices.reshape(*count, RING + 1)
        around = slices[..., :-1] + near * (slices[..., 1:] - slices[..., :-1])
        vectors = jnp.concatenate([obs[BEAMS : BEAMS + 2], obs[BEAMS + 3 :]]).reshape(-1, 2)
        shape = (*count, *vectors.shape)
        ahead = inward(jnp.broadcast_to(vectors, shape), jnp.broadcast_to(actions[..., None, :], shape))
        turned = jnp.concatenate([around, ahead.reshape(*count, -1), actions], axis=-1)
        return Features(obs[BEAMS + 2 : BEAMS + 3], turned)

    def aims(self, obs: Float[Array, " obs"]) -> Aims:
        """Directions every 5 degrees, the goal's first: how far the body could walk there, and what a detour it is.

        Any may be meant; open are those where the lidar looks and the body would not soon touch what it sees. One
        network weighs each from its own side: ways of three widths there and beside it, detours, goal and previous
        actions. With `look_ahead` also what is left to the goal after two legs of which the first goes there, what a
        detour they are, and the first leg's length (`aims.look_ahead`).
        """
        return aims_of(obs, self.look_ahead, self.lidar.max_range)

    def mirror(
        self, which: Int[Array, ""] | int, obs: Float[Array, " obs"], vector: Float[Array, "2"]
    ) -> tuple[Float[Array, " obs"], Float[Array, "2"]]:
        """0: as it is; 1: left and right exchanged. Exact unless the sensor is turned."""
        sign = jnp.array([1.0, -1.0])
        goal, distance, previous = obs[BEAMS : BEAMS + 2], obs[BEAMS + 2], obs[BEAMS + 3 :].reshape(REMEMBERED, 2)
        parts = [obs[:BEAMS][::-1], goal * sign, distance[None], (previous * sign[None]).ravel()]
        image = jnp.concatenate(parts)
        return jnp.where(which == 1, image, obs), jnp.where(which == 1, vector * sign, vector)

    def remember(self, state: AnyWalker, obs: Float[Array, " obs"]) -> Float[Array, " memory"]:
        """Place, goal, previous actions and number of the world: what `observe` looks at, 9 entries and the place's.

        With `keep_scans` the observation itself.
        """
        if self.keep_scans:
            return obs
        world = state.world[None].astype(jnp.float32)
        return jnp.concatenate([self.place(state), state.goal, state.previous.ravel(), world])

    def recall(self, memory: Float[Array, " memory"]) -> Float[Array, " obs"]:
        """The observation, its lidar scanned anew unless it is stored."""
        return memory if self.keep_scans else self.observe(self.placed(*_remembered(memory)))

    def recall_next(
        self, memory: Float[Array, " memory"], action: Float[Array, "2"], aftermath: Float[Array, " place"]
    ) -> Float[Array, " obs"]:
        """The observation after the action, at the place `aftermath`; with `keep_scans` that is the observation."""
        if self.keep_scans:
            return aftermath
        _, goal, previous, world, route = _remembered(memory)
        return self.observe(self.placed(aftermath, goal, latest_first(action, previous), world, route))

    def _start(self, key: PRNGKeyArray) -> AnyWalker:
        """At rest at the start of a random route, turned at random."""
        k_world, k_route, k_yaw = jax.random.split(key, 3)
        worlds, routes = self.worlds.starts.shape[:2]
        world, route = jax.random.randint(k_world, (), 0, worlds), jax.random.randint(k_route, (), 0, routes)
        yaw = jax.random.uniform(k_yaw, (), minval=-jnp.pi, maxval=jnp.pi)
        pose, goal = jnp.append(self.worlds.starts[world, route], yaw), self.worlds.goals[world, route]
        state = self.placed(self.at_rest(pose), goal, jnp.zeros((REMEMBERED, 2)), world, route)
        return state.replace(passed=jnp.zeros(2)) if self.sides else state

    def at_rest(self, pose: Float[Array, "3"]) -> Float[Array, " place"]:
        """The place of a body that stands still at a pose."""
        return pose


def _remembered(memory: Float[Array, " memory"]) -> tuple[jax.Array, ...]:
    """Place, goal, previous actions, number of the world and of a route, which `observe` does not ask for."""
    previous = memory[-7:-1].reshape(REMEMBERED, 2)
    return memory[:-9], memory[-9:-7], previous, memory[-1].astype(jnp.int32), jnp.zeros((), jnp.int32)


def latest_first(action: Float[Array, "2"], previous: Float[Array, "3 2"]) -> Float[Array, "3 2"]:
    """The remembered actions after another one."""
    return jnp.concatenate([action[None], previous[:-1]])
