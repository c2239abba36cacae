"""The arm as a task: observation, episodes and rewards, laid out as Fetch's tasks.

One step is one step of control, 0.04 s. An episode is 50 steps long and never ends before. Success: at the end the
gripper, or the cube, is within 5 cm of the goal.
"""

from __future__ import annotations

from typing import Literal

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Float, Int, PRNGKeyArray

from cuelearner_envs.anymal.model import rotation
from cuelearner_envs.arm import model as arm
from cuelearner_envs.arm import physics
from cuelearner_envs.arm.physics import ArmGround, ArmState
from cuelearner_envs.arm.scripts import act
from cuelearner_envs.fetch.cues import CUE_NAMES, CUES
from cuelearner_jax.environment import Quantity, WholeObservations
from cuelearner_jax.spaces import Box, cues_from
from cuelearner_jax.types import EnvState, Step

Scalar = float | Float[Array, ""]
Skill = Literal["reach", "push", "pick"]
Reward = Literal["shaped", "dense", "sparse"]
PLACEMENTS = 16  # draws of a cube position that must not lie near the gripper
SPREAD = 0.15  # of cubes and goals round where the gripper begins, along each axis [m]
APART = 0.1  # of the cube from there, at least [m]
HIGHEST = 0.45  # of a goal in the air over the table, `pick` alone [m]
HOME = (1.3419, 0.7491, 0.5347)  # where the gripper begins [m]
LOW_HOME = (1.3627, 0.7491, 0.4169)  # where the gripper begins to push, if no post stands [m]
LANE = ((0.09, 0.15), 0.06)  # of cube and goal before and behind the post along x, and across at most [m]
BASE = (0.6918, 0.7441)  # the robot's base, about which its camera turns: x, y [m]
WAY = 0.5  # weight of the distance gripper to cube in a shaped reward, relative to cube to goal
ACTIONS = Box((-1.0,) * 4, (1.0,) * 4, cues_from(CUES, CUE_NAMES))


class Situation(struct.PyTreeNode):
    """State between steps."""

    body: ArmState
    goal: Float[Array, "3"]  # of the gripper, or of the cube's middle [m]
    steps: Int[Array, ""]  # taken in this episode
    passed: Float[Array, ""]  # on which side of the post the cube went by: +1 left, -1 right, 0 not yet


class Camera(struct.PyTreeNode):
    """Displacement of the positions that a camera measures: goal, cube and all that derives from them."""

    turn: Scalar = 0.0  # about the vertical through the robot's base, counterclockwise [rad]
    offset: Float[Array, "3"] | tuple[float, ...] = (0.0, 0.0, 0.0)  # added afterwards [m]

    def view_of(self, place: Float[Array, "3"]) -> Float[Array, "3"]:
        """Return the observed position of a point [m]."""
        cos, sin, base = jnp.cos(self.turn), jnp.sin(self.turn), jnp.asarray(BASE)
        x, y = place[:2] - base
        turned = [cos * x - sin * y + base[0], sin * x + cos * y + base[1], place[2]]
        return jnp.stack(turned) + jnp.asarray(self.offset)


class Arm(WholeObservations, struct.PyTreeNode):
    """The environment (`cuelearner_jax.environment.Environment`). Everything but the last three fields is traced."""

    camera: Camera = Camera()
    ground: ArmGround = ArmGround()
    grasps: Scalar = 1.0  # 1: fingers move, goals may lie in the air (`pick`); 0: fingers stay closed
    within: Scalar = 0.05  # of the goal: as near, the episode is a success [m]
    max_steps: Int[Array, ""] | int = 50  # an episode is truncated after this many
    skill: Skill = struct.field(pytree_node=False, default="reach")
    reward: Reward = struct.field(pytree_node=False, default="shaped")
    observation: tuple[Quantity, ...] = struct.field(pytree_node=False, default=())

    # States are `EnvState` where another body's may stand in the place of a `Situation`.
    actions = ACTIONS
    action = Quantity("step", 4, "5 cm", "x forward, y to the left, z up, and how far the fingers are to open")

    @property
    def has_object(self) -> bool:
        """Whether there is a cube."""
        return self.skill != "reach"

    def reset(self, key: PRNGKeyArray) -> tuple[EnvState, Float[Array, " obs"]]:
        """Begin an episode: the gripper at home, cube and goal drawn as Fetch draws them.

        Where a post stands, the cube lies before it and the goal behind it, as the robot sees them.
        """
        state = self._start(key)
        return state, self.observe(state)

    def step(self, key: PRNGKeyArray, state: EnvState, action: Float[Array, "4"]) -> tuple[EnvState, Step]:
        """Execute an action; a new episode follows the end of one."""
        after = self.after(state, physics.control(state.body, self.command(state, action), self.ground))
        outcome, truncated = self.ends(after)
        metrics = {"within": (self.distance(after) < self.within).astype(jnp.float32)}
        return self.step_to(key, after, self._earned(after), jnp.array(False), truncated, metrics, outcome)

    def command(self, state: Situation, action: Float[Array, "4"]) -> physics.Command:
        """Return the targets of the drives that an action means."""
        fingers = state.body.qpos[physics.FINGERS] if self.has_object else jnp.zeros(2)
        post = self.ground.post if self.has_object else 0.0
        return physics.command(self.gripper(state), fingers, action, post, self.grasps)

    def after(self, state: Situation, body: ArmState) -> Situation:
        """Return the state that physics has led to; what blew up stays where it was."""
        sound = jnp.isfinite(body.qpos).all() & jnp.isfinite(body.qvel).all()
        body = jax.tree.map(lambda new, old: jnp.where(sound, new, old), body, state.body)
        after = state.replace(body=body, steps=state.steps + 1)
        return after.replace(passed=self._passed(state, after)) if self.has_object else after

    def ends(self, after: Situation) -> tuple[dict[str, Float[Array, ""]], Array]:
        """Return what an episode that ended in a state came to, and whether time is up.

        "passed_left", "passed_right": success, and the cube went by the post on that side, as the robot sees it.
        """
        distance = self.distance(after)
        success = (distance < self.within).astype(jnp.float32)
        outcome = {"success": success, "distance": distance}
        if self.skill == "push":
            outcome["passed_left"] = success * (after.passed > 0)
            outcome["passed_right"] = success * (after.passed < 0)
        return outcome, after.steps >= self.max_steps

    def gripper(self, state: EnvState) -> Float[Array, "3"]:
        """Return the gripper's place [m]."""
        return state.body.qpos[physics.GRIPPER]

    def cube(self, state: EnvState) -> Float[Array, "3"]:
        """Return the place of the cube's middle [m]."""
        return state.body.qpos[physics.CUBE][:3]

    def distance(self, state: EnvState) -> Float[Array, ""]:
        """Return how far it is from the goal to what is to be there [m]."""
        place = self.cube(state) if self.has_object else self.gripper(state)
        return jnp.linalg.norm(place - state.goal)

    def observe(self, state: EnvState, camera: Camera | None = None) -> Float[Array, " obs"]:
        """Return what is seen, in the order of Fetch's flattened observations; `camera`: in place of the own one."""
        camera = self.camera if camera is None else camera
        place, velocity = self.gripper(state), state.body.qvel[physics.GRIPPER] * arm.CONTROL_PERIOD
        goal = camera.view_of(state.goal)
        if not self.has_object:
            return jnp.concatenate([place, goal, place, jnp.zeros(2), velocity, jnp.zeros(2)])
        body = state.body
        cube = camera.view_of(self.cube(state))
        turn = rotation(body.qpos[physics.CUBE][3:])
        moving = body.qvel[physics.CUBE_VELOCITY] * arm.CONTROL_PERIOD - velocity
        turning = jnp.sum(turn * body.qvel[physics.CUBE_TURNING][None], -1) * arm.CONTROL_PERIOD
        fingers = body.qpos[physics.FINGERS], body.qvel[physics.FINGERS] * arm.CONTROL_PERIOD
        parts = [cube, goal, place, cube, cube - place, fingers[0], physics.euler(turn), moving, turning, velocity]
        return jnp.concatenate([*parts, fingers[1]])

    def heuristic(self, obs: Float[Array, " obs"]) -> Float[Array, "4"]:
        """Return the script's action: the teacher's of what is seen, on a table that nobody has changed."""
        return act(self.skill, obs[None], post=self.ground.post)[0]

    def _earned(self, after: EnvState) -> Float[Array, ""]:
        distance = self.distance(after)
        if self.reward == "sparse":
            return -(distance >= self.within).astype(jnp.float32)
        if self.reward == "dense" or not self.has_object:
            return -distance
        return -distance - WAY * jnp.linalg.norm(self.cube(after) - self.gripper(after))

    def _passed(self, before: Situation, after: Situation) -> Float[Array, ""]:
        """The side on which the cube has passed the post: that of its last crossing of the line through it, away."""
        (x, y), was, now = arm.POST_PLACE, self.cube(before), self.cube(after)
        crosses = (was[0] < x) & (now[0] >= x)
        return jnp.where(crosses, jnp.where(now[1] > y, 1.0, -1.0), jnp.where(now[0] < x, 0.0, before.passed))

    def _start(self, key: PRNGKeyArray) -> Situation:
        k_cube, k_goal, k_air, k_lane = jax.random.split(key, 4)
        high = jnp.asarray(HOME)
        zero = {"steps": jnp.zeros((), jnp.int32), "passed": jnp.zeros(())}
        if not self.has_object:
            goal = high + jax.random.uniform(k_goal, (3,), minval=-SPREAD, maxval=SPREAD)
            return Situation(physics.standing(high, None), goal, **zero)
        home = jnp.where((self.grasps > 0) | (self.ground.post > 0), high, jnp.asarray(LOW_HOME))
        cube, goal = _placed(k_cube, home[:2]), _spread(k_goal, home[:2])
        before, behind = _in_lane(k_lane)
        cube, goal = (jnp.where(self.ground.post > 0, *both) for both in ((before, cube), (behind, goal)))
        up, share = jax.random.uniform(k_air, (2,))
        height = arm.RESTING + jnp.where((up < 0.5) & (self.grasps > 0), HIGHEST * share, 0.0)
        return Situation(physics.standing(home, cube), jnp.append(goal, height), **zero)


def _spread(key: PRNGKeyArray, middle: Float[Array, "2"]) -> Float[Array, "2"]:
    return middle + jax.random.uniform(key, (2,), minval=-SPREAD, maxval=SPREAD)


def _placed(key: PRNGKeyArray, middle: Float[Array, "2"]) -> Float[Array, "2"]:
    """A place for the cube, not near the gripper: of several draws the first that will do."""
    draws = jax.vmap(lambda one: _spread(one, middle))(jax.random.split(key, PLACEMENTS))
    away = jnp.linalg.norm(draws - middle[None], axis=-1)
    return draws[jnp.argmax(jnp.where(away >= APART, 1.0, away))]


def _in_lane(key: PRNGKeyArray) -> tuple[Float[Array, "2"], Float[Array, "2"]]:
    """Places for the cube before the post and for the goal behind it."""
    (near, far), wide = LANE
    along, across = jax.random.uniform(key, (2, 2))
    along, across = near + (far - near) * along, wide * (2.0 * across - 1.0)
    places = jnp.asarray(arm.POST_PLACE)[None] + jnp.stack([jnp.array([-1.0, 1.0]) * along, across], -1)
    return places[0], places[1]


class ScriptTeacher(struct.PyTreeNode):
    """Teacher that runs the skill's script on true places, knows the friction, and prefers a side of the post."""

    env: Arm
    side: Float[Array, ""] | float = 0.0  # +1 left, -1 right, 0 the shorter way

    def best_action(self, state: EnvState, obs: Float[Array, " obs"]) -> Float[Array, "4"]:
        """Return the script's action, of what an unchanged camera would show."""
        true = self.env.observe(state, Camera())[None]
        ground = self.env.ground
        friction, post = jnp.asarray(ground.friction), jnp.asarray(ground.post)
        return act(self.env.skill, true, self.side, friction, post)[0]
