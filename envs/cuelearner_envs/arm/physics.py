"""The gripper's physics in MJX: one control step, from a minimal state."""

# pyright: reportAttributeAccessIssue=false
# (MuJoCo's compiled module has no stubs)

from __future__ import annotations

import contextlib
import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Float

from cuelearner_envs.arm import model as arm

Scalar = float | Float[Array, ""]
REACH = 0.05  # of an action of 1: how far its target lies from where the gripper is [m]
WORKSPACE = ((1.05, 0.4, arm.LOWEST), (1.6, 1.1, 0.95))  # where targets may lie, lowest and highest x, y, z [m]
KEPT_OUT = 0.042  # from the post's axis: nearer no target lies that is lower than the post [m]
OVER = arm.TABLE + arm.POST_HEIGHT + arm.TIP + 0.005  # height from which on the gripper clears the post [m]
GRIPPER, FINGERS, CUBE = slice(0, 3), slice(3, 5), slice(5, 12)  # of qpos
CUBE_VELOCITY, CUBE_TURNING = slice(5, 8), slice(8, 11)  # of qvel


class ArmState(struct.PyTreeNode):
    """The state between control steps; `mjx.Data` (kilobytes) is rebuilt from it each step.

    Without an object there are no fingers and no cube: the gripper is three numbers.
    """

    qpos: Float[Array, " qpos"]  # gripper [m], fingers [m], place [m] and quaternion (w, x, y, z) of the cube
    qvel: Float[Array, " qvel"]  # of these [m/s], the cube's angular velocity in its own frame [rad/s]
    warmstart: Float[Array, " qvel"]  # the solver's first guess: the last accelerations [m/s^2, rad/s^2]


class ArmGround(struct.PyTreeNode):
    """Conditions that may differ between worlds."""

    friction: Scalar = arm.FRICTION  # of the cube on table, fingers and post
    post: Scalar = 1.0  # 1: there is a post; 0: there is none


class Command(NamedTuple):
    """Targets of the drives during a step of control."""

    gripper: Float[Array, "3"]  # [m]
    fingers: Float[Array, "2"]  # [m]

    def all(self, has_object: bool) -> Float[Array, " drives"]:
        """Return the targets in the model's order."""
        return jnp.concatenate(self) if has_object else self.gripper


def _mjx() -> Any:
    """Import MJX, which takes seconds and which not every command needs."""
    with contextlib.redirect_stdout(None):  # it tells of an optional engine that is not installed
        from mujoco import mjx
    return mjx


@functools.cache
def compiled(has_object: bool) -> tuple[Any, Any, int]:
    """Return MJX's model, an empty `mjx.Data`, and the post's number, even if called while tracing."""
    mjx, model = _mjx(), arm.load(has_object)
    post = model.geom("post").id if has_object else 0
    with jax.ensure_compile_time_eval():
        return mjx.put_model(model, impl="jax"), mjx.make_data(model, impl="jax"), post


def standing(gripper: Float[Array, "3"], cube: Float[Array, "2"] | None) -> ArmState:
    """Return the gripper at rest at a place [m], fingers closed, and the cube on the table [m] (None: no object)."""
    if cube is None:
        return ArmState(gripper, jnp.zeros(3), jnp.zeros(3))
    lying = jnp.array([arm.RESTING, 1.0, 0.0, 0.0, 0.0])
    return ArmState(jnp.concatenate([gripper, jnp.zeros(2), cube, lying]), jnp.zeros(11), jnp.zeros(11))


def command(
    gripper: Float[Array, "3"], fingers: Float[Array, "2"], action: Float[Array, "4"], post: Scalar, grasps: Scalar
) -> Command:
    """Return the targets that an action means.

    As Fetch has it: an action (dx, dy, dz, opening) of 1 names a place 5 cm from where the gripper is, and opens the
    fingers. Targets keep within the workspace and out of the post. `post`: 1 where there is one. `grasps`: 1 where
    fingers move, 0 where they stay closed.
    """
    low, high = jnp.asarray(WORKSPACE)
    target = jnp.clip(gripper + REACH * action[:3], low, high)
    middle = jnp.asarray(arm.POST_PLACE)
    off = target[:2] - middle
    away = jnp.linalg.norm(off)
    meets = (away < KEPT_OUT) & (target[2] < OVER) & (post > 0)
    around = middle + off * (KEPT_OUT / jnp.maximum(away, 1e-3))
    beside = jnp.concatenate([around, target[2:]])
    target = jnp.where(meets, jnp.where(gripper[2] < OVER - 0.002, beside, target.at[2].set(OVER)), target)
    return Command(target, grasps * jnp.clip(fingers + action[3], 0.0, arm.OPEN))


def control(body: ArmState, targets: Command, ground: ArmGround) -> ArmState:
    """Return the body after a step of control (0.04 s)."""
    has_object = body.qpos.shape[-1] > 3
    model, data, post = compiled(has_object)
    if has_object:
        model = model.replace(
            pair_friction=model.pair_friction.at[:, :2].set(ground.friction),
            geom_pos=model.geom_pos.at[post, 2].add(jnp.where(ground.post > 0, 0.0, -1.0)),
        )
    mjx, ctrl = _mjx(), targets.all(has_object)

    def one(carry: ArmState, _: None) -> tuple[ArmState, None]:
        begun = data.replace(qpos=carry.qpos, qvel=carry.qvel, qacc_warmstart=carry.warmstart, ctrl=ctrl)
        # An accelerator would round the factors of products to three digits. MJX promotes ranks.
        with jax.default_matmul_precision("highest"), jax.numpy_rank_promotion("allow"):
            after = mjx.step(model, begun)
        return ArmState(after.qpos, after.qvel, after.qacc_warmstart), None

    return jax.lax.scan(one, body, length=arm.SUBSTEPS)[0]


def euler(matrix: Float[Array, "3 3"]) -> Float[Array, "3"]:
    """Return the angles about x, y and z of a rotation, as Fetch's observations have them [rad]."""
    flat = jnp.hypot(matrix[2, 2], matrix[1, 2])
    x, y = -jnp.arctan2(matrix[1, 2], matrix[2, 2]), jnp.arctan2(matrix[0, 2], flat)
    return jnp.stack([x, y, -jnp.arctan2(matrix[0, 1], matrix[0, 0])])
