"""Navigation by the quadruped: the simple robot's task with legs, physics and a tilting sensor.

The chosen direction becomes a velocity command, as the simple robot takes it: walk there at up to 1 m/s, held in the
world's frame for the step, while the body turns toward it. The walking policy acts on the command at 50 Hz, MJX
simulates. Solids are no contacts of the physics: the body's three discs touching one ends the episode, as does a fall.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Bool, Float, Int

from cuelearner_envs.anymal import model as robot
from cuelearner_envs.anymal.physics import AnymalGround, AnymalState, control, standing
from cuelearner_envs.anymal.policy import WalkingPolicy, load, observe
from cuelearner_envs.navigation.config import NavigationConfig
from cuelearner_envs.navigation.config import make_environment as make_navigation
from cuelearner_envs.navigation.environment import Navigation, latest_first
from cuelearner_envs.navigation.lidar import scan_tilted
from cuelearner_jax.spaces.directions import difference, from_angle, rotate

Scalar = float | Float[Array, ""]
SENSOR_NOISE = 0.02  # standard deviation of a scanner's range error [m]
CONTROL_STEPS = 10  # in a step of navigation, whose `period` is that many times 0.02 s
TURNING_TIME = 0.3  # time constant of the commanded turn toward the heading; the turn rate stays bounded [s]
# The command changes by no more than this [m/s^2, rad/s^2]: of robots turned other ways at once 11% fell within 10 s
# (docs/data/anymal_fit.json), with these bounds none.
ACCELERATION, TURN_ACCELERATION = 8.0, 20.0


class LeggedWalker(struct.PyTreeNode):
    """State between steps: what the physics and the walking policy carry, and the episode's."""

    body: AnymalState
    last_action: Float[Array, "12"]  # of the walking policy
    # the walking policy's command: velocity forward and to the left [m/s], turning rate [rad/s]
    command: Float[Array, "3"]
    goal: Float[Array, "2"]  # [m]
    previous: Float[Array, "3 2"]  # actions, the latest first, as they were given; zeros before the first
    world: Int[Array, ""]
    route: Int[Array, ""]  # of that world
    steps: Int[Array, ""]  # taken in this episode
    fallen: Bool[Array, ""]
    passed: Float[Array, "2"] | None = None  # as of `navigation.environment.Walker`

    @property
    def pose(self) -> Float[Array, "3"]:
        """x, y, yaw [m, rad]."""
        return robot.planar_pose(self.body.qpos)


class LeggedNavigation(Navigation, kw_only=True):
    """The environment (`cuelearner_jax.environment.Environment`), with the interface of `Navigation`."""

    walking: WalkingPolicy
    ground: AnymalGround = AnymalGround()

    def move(self, state: LeggedWalker, action: Float[Array, "2"]) -> LeggedWalker:
        """Return the state after a step, without a reset."""
        heading = rotate(action, state.pose[2])

        def one(carry: tuple, _: None) -> tuple[tuple, None]:
            body, last_action, command, fallen = carry
            last_action, command = self.act(body, last_action, command, heading)
            after, felt = control(body, last_action, self.ground)
            # a robot whose numbers diverged counts as fallen and stays where it was
            sound = jnp.isfinite(after.qvel).all()
            body = jax.tree.map(lambda new, old: jnp.where(sound, new, old), after, body)
            return (body, last_action, command, fallen | felt.fallen), None

        start = (state.body, state.last_action, state.command, state.fallen)
        (body, last_action, command, fallen), _ = jax.lax.scan(one, start, length=CONTROL_STEPS)
        state = state.replace(body=body, last_action=last_action, command=command, fallen=fallen)
        return state.replace(previous=latest_first(action, state.previous), steps=state.steps + 1)

    def act(
        self, body: AnymalState, last_action: Float[Array, "12"], before: Float[Array, "3"], heading: Float[Array, "2"]
    ) -> tuple[Float[Array, "12"], Float[Array, "3"]]:
        """Return the walking policy's action and its command, on the way from `before` to walking toward `heading`."""
        command = self.command(body, before, heading)
        return self.walking(observe(body.qpos, body.qvel, last_action, command)), command

    def command(self, body: AnymalState, before: Float[Array, "3"], heading: Float[Array, "2"]) -> Float[Array, "3"]:
        """Return the command that follows `before` on the way toward a heading, a unit vector in the world's frame."""
        yaw = robot.planar_pose(body.qpos)[2]
        off = difference(from_angle(yaw), heading)
        turning = jnp.clip(off / TURNING_TIME, -self.robot.turn_rate, self.robot.turn_rate)
        change = self.robot.speed * rotate(heading, -yaw) - before[:2]
        most = ACCELERATION * robot.CONTROL_PERIOD
        change = change * (most / jnp.maximum(jnp.linalg.norm(change), most))
        most = TURN_ACCELERATION * robot.CONTROL_PERIOD
        return before + jnp.append(change, jnp.clip(turning - before[2], -most, most))

    def failures(self, state: LeggedWalker) -> dict[str, Bool[Array, ""]]:
        """Return the failures that end an episode, by name; at most one holds."""
        return {"collision": self.collided(state) & ~state.fallen, "fall": state.fallen}

    def ranges(self, state: LeggedWalker) -> Float[Array, "271"]:
        """Return the lidar's distances as the robot perceives them [m], from the middle of the tilted trunk."""
        place = state.body.qpos[:7]
        turn = robot.rotation(place[3:])
        cos, sin = jnp.cos(self.lidar.rotation), jnp.sin(self.lidar.rotation)
        ahead, left = cos * turn[:, 0] + sin * turn[:, 1], cos * turn[:, 1] - sin * turn[:, 0]
        turn = jnp.stack([ahead, left, turn[:, 2]], axis=1)
        true = scan_tilted(self.world(state.world), place[:3], turn, self.lidar.max_range)
        return self.lidar.faulty(true, place)

    def place(self, state: LeggedWalker) -> Float[Array, "7"]:
        """Return position and quaternion of the trunk."""
        return state.body.qpos[:7]

    def at_rest(self, pose: Float[Array, "3"]) -> Float[Array, "7"]:
        """Return the trunk's position and quaternion for a robot standing at a pose."""
        return standing(pose[:2], pose[2]).qpos[:7]

    def placed(
        self,
        place: Float[Array, "7"],
        goal: Float[Array, "2"],
        previous: Float[Array, "3 2"],
        world: Int[Array, ""],
        route: Int[Array, ""],
    ) -> LeggedWalker:
        """Return a state at rest with the trunk at a position."""
        body = standing(place[:2], 0.0)
        body = body.replace(qpos=body.qpos.at[:7].set(place))
        last_action, command = jnp.zeros(robot.JOINTS), jnp.zeros(3)
        steps, fallen = jnp.zeros((), jnp.int32), jnp.array(False)
        return LeggedWalker(body, last_action, command, goal, previous, world, route, steps, fallen)


def make_environment(
    config: NavigationConfig, split: str = "training", walking: WalkingPolicy | None = None
) -> LeggedNavigation:
    """Return the environment of a configuration with the quadruped, walking by a policy (default: the shipped one)."""
    plain = make_navigation(config, split)
    noise = jnp.hypot(plain.lidar.noise, SENSOR_NOISE)
    return LeggedNavigation(**{**vars(plain), "lidar": plain.lidar.replace(noise=noise)}, walking=walking or load())
