"""Navigation as a task: what the robot perceives, when an episode ends, what it pays (CueLearner paper, section V-B).

One step is one control step of walking in a chosen direction. Reward: +10 at the goal, -10 for touching anything.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from cuelearner_envs.navigation.lidar import BEAMS, Lidar
from cuelearner_envs.navigation.robot import Motion, Robot, collides, walk
from cuelearner_envs.navigation.world import World
from cuelearner_envs.navigation.worlds import FARTHEST
from cuelearner_jax.actions import retract, rotate
from cuelearner_jax.types import Step

REMEMBERED = 3  # actions in the observation
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


class Navigation(struct.PyTreeNode):
    """The environment (`cuelearner_jax.types.Environment`). Everything but the last field is traced."""

    worlds: World  # leading axis: worlds
    robot: Robot = Robot()
    lidar: Lidar = Lidar()
    max_steps: Int[Array, ""] | int = 200  # an episode is truncated after this many
    period: Scalar = 0.2  # duration of a step [s]
    goal_radius: Scalar = 0.5  # nearer than this, the goal is reached [m]
    mirrors: bool = struct.field(pytree_node=False, default=False)  # offer the mirror image as data?

    obs_size = BEAMS + 3 + 2 * REMEMBERED

    @property
    def symmetries(self) -> int:
        """Identity, and left and right exchanged: body, lidar and motion are symmetric, worlds are as likely as not."""
        return 2 if self.mirrors else 1

    def world(self, index: Int[Array, ""]) -> World:
        """One of the worlds."""
        return jax.tree.map(lambda leaf: leaf[index], self.worlds)

    def reset(self, key: PRNGKeyArray) -> tuple[Walker, Float[Array, " obs"]]:
        """Stands still, turned at random, at the start of a random route of a random world."""
        state = self._start(key)
        return state, self.observe(state)

    def step(self, key: PRNGKeyArray, state: Walker, action: Float[Array, "2"]) -> tuple[Walker, Step]:
        """Walks for one period in the direction; a new episode follows an end."""
        after = self.moved(state, action)
        success, collision = self.arrived(after), self.collided(after)
        success = success & ~collision
        terminated = success | collision
        truncated = (after.steps >= self.max_steps) & ~terminated
        ended = terminated | truncated
        following = jax.tree.map(lambda new, old: jnp.where(ended, new, old), self._start(key), after)
        step = Step(
            obs=self.observe(following),
            final_obs=self.observe(after),
            aftermath=after.pose,
            reward=10.0 * success - 10.0 * collision,
            terminated=terminated,
            truncated=truncated,
            metrics={"speed": jnp.linalg.norm(after.pose[:2] - state.pose[:2]) / self.period},
            outcome={
                "success": success.astype(jnp.float32),
                "collision": collision.astype(jnp.float32),
                "timeout": truncated.astype(jnp.float32),
                "duration": after.steps * jnp.asarray(self.period),
            },
        )
        return following, step

    def moved(self, state: Walker, action: Float[Array, "2"]) -> Walker:
        """The state after a step, without a reset."""
        motion = walk(self.robot, Motion(state.pose, state.velocity), action, self.period)
        return state.replace(
            pose=motion.pose,
            velocity=motion.velocity,
            previous=_latest_first(action, state.previous),
            steps=state.steps + 1,
        )

    def arrived(self, state: Walker) -> Bool[Array, ""]:
        """Is the goal reached?"""
        return jnp.linalg.norm(state.goal - state.pose[:2]) < self.goal_radius

    def collided(self, state: Walker) -> Bool[Array, ""]:
        """Does the body touch anything?"""
        return collides(self.robot, self.world(state.world), state.pose)

    def ranges(self, state: Walker) -> Float[Array, "271"]:
        """The lidar's distances as the robot perceives them [m]."""
        return self.lidar.read(self.world(state.world), state.pose)

    def observe(self, state: Walker) -> Float[Array, " obs"]:
        """What the robot perceives; everything is of the order of one.

        - 271 entries: how near the lidar's beams end, from right behind to left behind, exp(-distance / 1 m) of
        - 2: direction to the goal in the body's frame; 1: distance to the goal over 15 m
        - 6: the last three actions, the latest first
        """
        offset = rotate(state.goal - state.pose[:2], -state.pose[2])
        distance = jnp.linalg.norm(offset)
        return jnp.concatenate(
            [
                jnp.exp(-self.ranges(state)),
                retract(offset),
                distance[None] / FARTHEST,
                state.previous.ravel(),
            ]
        )

    def heuristic(self, obs: Float[Array, " obs"]) -> Float[Array, "2"]:
        """Straight toward the goal."""
        return obs[BEAMS : BEAMS + 2]

    def mirror(
        self, which: Int[Array, ""], obs: Float[Array, " obs"], vector: Float[Array, "2"]
    ) -> tuple[Float[Array, " obs"], Float[Array, "2"]]:
        """0: as it is; 1: left and right exchanged. Exact unless the sensor is turned."""
        sign = jnp.array([1.0, -1.0])
        goal, distance, previous = obs[BEAMS : BEAMS + 2], obs[BEAMS + 2], obs[BEAMS + 3 :].reshape(REMEMBERED, 2)
        image = jnp.concatenate([obs[:BEAMS][::-1], goal * sign, distance[None], (previous * sign).ravel()])
        return jnp.where(which == 1, image, obs), jnp.where(which == 1, vector * sign, vector)

    def remember(self, state: Walker, obs: Float[Array, " obs"]) -> Float[Array, "12"]:
        """Pose, goal, previous actions and number of the world: what `observe` looks at."""
        return jnp.concatenate([state.pose, state.goal, state.previous.ravel(), state.world[None].astype(jnp.float32)])

    def recall(self, memory: Float[Array, "12"]) -> Float[Array, " obs"]:
        """The observation, its lidar scanned anew."""
        return self.observe(self._recalled(memory))

    def recall_next(
        self, memory: Float[Array, "12"], action: Float[Array, "2"], aftermath: Float[Array, "3"]
    ) -> Float[Array, " obs"]:
        """The observation after the action, at the pose `aftermath`."""
        state = self._recalled(memory)
        return self.observe(state.replace(pose=aftermath, previous=_latest_first(action, state.previous)))

    def _recalled(self, memory: Float[Array, "12"]) -> Walker:
        """A state that looks as the remembered one did."""
        zero = jnp.zeros((), jnp.int32)
        return Walker(
            pose=memory[:3],
            velocity=jnp.zeros(2),
            goal=memory[3:5],
            previous=memory[5:11].reshape(REMEMBERED, 2),
            world=memory[11].astype(jnp.int32),
            route=zero,
            steps=zero,
        )

    def _start(self, key: PRNGKeyArray) -> Walker:
        k_world, k_route, k_yaw = jax.random.split(key, 3)
        worlds, routes = self.worlds.starts.shape[:2]
        world, route = jax.random.randint(k_world, (), 0, worlds), jax.random.randint(k_route, (), 0, routes)
        yaw = jax.random.uniform(k_yaw, (), minval=-jnp.pi, maxval=jnp.pi)
        return Walker(
            pose=jnp.append(self.worlds.starts[world, route], yaw),
            velocity=jnp.zeros(2),
            goal=self.worlds.goals[world, route],
            previous=jnp.zeros((REMEMBERED, 2)),
            world=world,
            route=route,
            steps=jnp.zeros((), jnp.int32),
        )


def _latest_first(action: Float[Array, "2"], previous: Float[Array, "3 2"]) -> Float[Array, "3 2"]:
    return jnp.concatenate([action[None], previous[:-1]])
