"""Draw small robots by chance: their bounds, drives, observations and scripts.

Lengths are in units of the workspace (about 2 wide), times in steps. A robot with c cues has n coordinates: n = c with
actions of a box; n = 2 with directions in the plane (c = 1). Functions take one robot; `jax.vmap` serves many.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from cuelearner_jax.spaces import DIRECTIONS

TASKS = ("reach", "track", "avoid", "insert", "two_phase")
REACH, TRACK, AVOID, INSERT, TWO_PHASE = range(5)
FULL = 0.1  # speed of an entry at its half range [1 / step]
WALK = 0.035  # speed of a robot with directions [1 / step]
ABOVE, SURFACE = 0.3, 0.15  # insert: heights over the goal of the way point, and of the surface with the hole
RADIUS = 0.12  # of the obstacle, for n = 2; all lengths of a task grow with `spread_of(n)`
HIDDEN = 64  # units of each hidden layer of a neural policy


class Way(struct.PyTreeNode):
    """Parameters of a script: how a robot, or its teacher, does the task."""

    gain: Float[Array, ""]  # speed asked for a unit of distance [1 / step]
    cruise: Float[Array, ""]  # largest speed of an entry [1 / step]
    detour: Float[Array, ""]  # avoid: distance from which the obstacle is gone round [radii]
    side: Float[Array, " n"]  # avoid: side on which the obstacle is passed, a unit vector
    in_turn: Bool[Array, ""]  # the first axis is aligned before the others move


class ZooRobot(struct.PyTreeNode):
    """One robot with its task and policy."""

    task: Int[Array, ""]  # index in `TASKS`
    low: Float[Array, " n"]  # bounds of an action (directions: -1 and 1)
    high: Float[Array, " n"]
    drive: Float[Array, " n"]  # speed by a unit of an action [1 / step]; negative for some entries
    lag: Float[Array, ""]  # share of the velocity that is left after a step
    axis: Float[Array, " n"]  # insert: the direction from the goal out of the hole, a unit vector
    first: Float[Array, " n"]  # the axis that a teacher with `Way.in_turn` aligns first, a unit vector
    unit: Float[Array, " obs"]  # unit of an entry of the observation, before `order`
    offset: Float[Array, " obs"]
    order: Int[Array, " obs"]  # entry of the quantities that stands in each place of the observation
    relative: Bool[Array, ""]  # goal and object are observed as differences from the position
    straight: Bool[Array, ""]  # fast commands are shortened to the cruise speed; else their entries are clipped
    way: Way
    neural: Bool[Array, ""]  # the policy is `net`, distilled from the script
    net: dict[str, Any]  # parameters of the network
    cues: int = struct.field(pytree_node=False, default=2)

    @property
    def half(self) -> Float[Array, " n"]:
        """Half of the range of each entry of an action."""
        return (self.high - self.low) / 2

    def retract(self, vector: Float[Array, " n"]) -> Float[Array, " n"]:
        """Return the action nearest to a vector."""
        return DIRECTIONS.retract(vector) if self.cues == 1 else jnp.clip(vector, self.low, self.high)

    def log(self, action: Float[Array, " n"], other: Float[Array, " n"]) -> Float[Array, " cues"]:
        """Return the change from `action` to `other`, as `spaces.Space.log` does: shares of the range, or radians."""
        return DIRECTIONS.log(action, other) if self.cues == 1 else (other - action) / (self.high - self.low)


class Sight(struct.PyTreeNode):
    """The quantities of which an observation is made."""

    position: Float[Array, " n"]
    goal: Float[Array, " n"]
    thing: Float[Array, " n"]  # obstacle or object; unrelated to the other tasks
    velocity: Float[Array, " n"]  # [1 / step]
    carries: Float[Array, ""]  # two_phase: 1 once the object is carried, else 0
    clutter: Float[Array, "3"]  # unrelated entries: a constant, a slow wave, a ramp


def dimensions(cues: int) -> int:
    """Return the number of coordinates of a robot, which is the number of entries of its actions."""
    return 2 if cues == 1 else cues


def spread_of(n: int) -> float:
    """Return the factor by which lengths grow with the number of coordinates."""
    return (n / 2) ** 0.5


def draw(key: PRNGKeyArray, cues: int) -> ZooRobot:
    """Draw a robot with a scripted policy."""
    n, keys = dimensions(cues), jax.random.split(key, 16)
    uniform = jax.random.uniform
    coin = lambda key, share: uniform(key) < share  # noqa: E731
    half = jnp.exp(uniform(keys[0], (n,), minval=jnp.log(0.3), maxval=jnp.log(3.0)))
    skew = jnp.where(coin(keys[1], 0.3), uniform(keys[2], (n,), minval=-0.25, maxval=0.25), 0.0)
    drive = FULL / half * jnp.where(uniform(keys[3], (n,)) < 0.3, -1.0, 1.0)
    lag = jnp.where(coin(keys[4], 0.3), uniform(keys[5], minval=0.2, maxval=0.5), 0.0)
    if cues == 1:
        half, skew, drive, lag = jnp.ones(n), jnp.zeros(n), jnp.full(n, WALK), jnp.zeros(())
    size = 4 * n + 4
    quantity = jnp.asarray([0] * n + [1] * n + [2] * n + [3] * n + [4, 5, 6, 7])
    unit = 10 ** uniform(keys[6], (8,), minval=-2.0, maxval=2.0)
    offset = unit * uniform(keys[7], (8,), minval=-2.0, maxval=2.0)
    side = jax.random.normal(keys[8], (n,))
    k_axis, k_first, k_sign = jax.random.split(keys[9], 3)
    way = Way(
        gain=uniform(keys[10], minval=0.3, maxval=0.45),
        cruise=uniform(keys[11], minval=0.4, maxval=0.5) * FULL,
        detour=jnp.float32(2.0),
        side=side / jnp.linalg.norm(side),
        in_turn=jnp.array(False),
    )
    return ZooRobot(
        task=jax.random.randint(keys[12], (), 0, len(TASKS)),
        low=half * (skew - 1),
        high=half * (skew + 1),
        drive=drive,
        lag=lag,
        axis=jnp.eye(n)[jax.random.randint(k_axis, (), 0, n)] * jax.random.rademacher(k_sign, (), jnp.float32),
        first=jnp.eye(n)[jax.random.randint(k_first, (), 0, n)],
        unit=unit[quantity],
        offset=offset[quantity],
        order=jax.random.permutation(keys[13], size),
        relative=coin(keys[14], 0.4),
        straight=coin(keys[15], 0.5),
        way=way,
        neural=jnp.array(False),
        net=network(jax.random.key(0), size, n),
        cues=cues,
    )


def network(key: PRNGKeyArray, size: int, n: int) -> dict[str, Any]:
    """Draw the parameters of a network from observations (size,) to commands (n,) in half ranges."""
    sizes = (size, HIDDEN, HIDDEN, n)
    layers = [
        (jax.random.normal(k, (a, b)) / a**0.5, jnp.zeros(b))
        for k, a, b in zip(jax.random.split(key, 3), sizes[:-1], sizes[1:], strict=True)
    ]
    return {"layers": layers, "mean": jnp.zeros(size), "scale": jnp.ones(size)}


def run_network(net: dict[str, Any], obs: Float[Array, " obs"]) -> Float[Array, " n"]:
    """Return the network's command in half ranges."""
    x = (obs - net["mean"]) / net["scale"]
    *hidden, (weights, bias) = net["layers"]
    for w, b in hidden:
        x = jnp.tanh(x @ w + b)
    return x @ weights + bias


def encode(robot: ZooRobot, sight: Sight) -> Float[Array, " obs"]:
    """Return the observation that a robot makes of quantities: in its units and order."""
    origin = jnp.where(robot.relative, sight.position, 0.0)
    parts = [sight.position, sight.goal - origin, sight.thing - origin, sight.velocity, sight.carries[None]]
    return (robot.unit * jnp.concatenate([*parts, sight.clutter]) + robot.offset)[robot.order]


def decode(robot: ZooRobot, obs: Float[Array, " obs"]) -> Sight:
    """Return the quantities of an observation: the inverse of `encode`."""
    n = robot.low.shape[0]
    values = (jnp.zeros_like(obs).at[robot.order].set(obs) - robot.offset) / robot.unit
    position, goal, thing, velocity, rest = jnp.split(values, [n, 2 * n, 3 * n, 4 * n])
    origin = jnp.where(robot.relative, position, 0.0)
    return Sight(position, goal + origin, thing + origin, velocity, rest[0], rest[1:])


def policy(robot: ZooRobot, obs: Float[Array, " obs"]) -> Float[Array, " n"]:
    """Return the action of the robot's policy."""
    by_net = robot.retract(run_network(robot.net, obs) * robot.half)
    return jnp.where(robot.neural, by_net, script(robot, robot.way, decode(robot, obs)))


def script(robot: ZooRobot, way: Way, sight: Sight) -> Float[Array, " n"]:
    """Return a script's action: proportional to the way that is left, bounded by the cruise speed, in phases."""
    lateral, height = across(robot, sight.position - sight.goal)
    lifts = (height > SURFACE) & (jnp.linalg.norm(lateral) > 0.6 * narrow(robot))
    above = sight.goal + robot.axis * jnp.where(lifts, ABOVE, 0.0)
    before = jnp.where(sight.carries > 0.5, sight.goal + sight.position - sight.thing, sight.thing)
    rest = jnp.stack([sight.goal, sight.goal, sight.goal, above, before])[robot.task] - sight.position
    ahead = robot.first * jnp.dot(robot.first, rest)
    rest = jnp.where(way.in_turn & (jnp.abs(jnp.dot(robot.first, rest)) > 0.06), ahead, rest)
    speed = way.gain * rest
    shorter = speed * jnp.minimum(1.0, way.cruise / jnp.maximum(jnp.max(jnp.abs(speed)), 1e-6))
    speed = jnp.where(robot.straight, shorter, jnp.clip(speed, -way.cruise, way.cruise))
    speed = jnp.where(robot.task == AVOID, _go_round(way, sight, speed), speed)
    return robot.retract(speed / robot.drive)


def narrow(robot: ZooRobot) -> float:
    """Return the radius of the hole."""
    return 0.05 * spread_of(robot.low.shape[0])


def across(robot: ZooRobot, way: Float[Array, " n"]) -> tuple[Float[Array, " n"], Float[Array, ""]]:
    """Return the part of a difference across the robot's axis, and its length along the axis."""
    height = jnp.dot(way, robot.axis)
    return way - height * robot.axis, height


def _go_round(way: Way, sight: Sight, speed: Float[Array, " n"]) -> Float[Array, " n"]:
    """Return a velocity that, near the obstacle, goes round it instead of into it."""
    radius = RADIUS * spread_of(speed.shape[0])
    away, apart = _unit(sight.position - sight.thing)
    ahead, _ = _unit(sight.goal - sight.thing)
    side, _ = _unit(way.side - jnp.dot(way.side, ahead) * ahead)
    tangent, _ = _unit(side - jnp.dot(side, away) * away)
    near = jnp.clip((way.detour * radius - apart) / (0.6 * radius), 0.0, 1.0)
    return speed - near * jnp.minimum(jnp.dot(speed, away), 0.0) * (away + tangent)


def _unit(vector: Float[Array, " n"]) -> tuple[Float[Array, " n"], Float[Array, ""]]:
    length = jnp.sqrt(jnp.sum(vector**2) + 1e-12)
    return vector / length, length
