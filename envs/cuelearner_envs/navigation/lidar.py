"""The lidar: distances along beams to boxes and circles, in closed form.

Everything is computed in inverse distances. Seen from a point, "1 / distance to a line along a beam" is linear in the
beam's direction, so that a beam against a box is six products and a few comparisons: no division, no branch.
"""

from __future__ import annotations

import math

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, ArrayLike, Float

from cuelearner_envs.navigation.geometry import in_frame
from cuelearner_envs.navigation.world import NavigationWorld
from cuelearner_jax.spaces.directions import from_angle, rotate

BEAMS = 271
FIELD_OF_VIEW = math.radians(270.0)
MAX_RANGE = 10.0  # [m]
# From straight ahead [rad]; of NumPy, so that no device is taken for a command that needs none.
BEAM_ANGLES = (np.arange(BEAMS, dtype=np.float32) - (BEAMS - 1) / 2) * (FIELD_OF_VIEW / (BEAMS - 1))
NO_BOUND = 1e9  # an inverse distance that bounds nothing [1/m]

Scalar = float | Float[Array, ""]


class Lidar(struct.PyTreeNode):
    """The sensor and its faults, all of them traced."""

    max_range: Scalar = MAX_RANGE  # a beam that meets nothing reads this [m]
    rotation: Scalar = 0.0  # miscalibration: the sensor is mounted turned by this, counterclockwise [rad]
    noise: Scalar = 0.0  # standard deviation of a beam's error [m]
    dropout: Scalar = 0.0  # probability that a beam reads `max_range` whatever it meets

    def read(self, world: NavigationWorld, pose: Float[ArrayLike, "3"]) -> Float[Array, "271"]:
        """Distances that the robot perceives at a pose [m]; without faults they are `scan`'s.

        Noise and drop-outs are drawn from the pose's bits, so that the same reading can be made again.
        """
        pose = jnp.asarray(pose)
        return self.faulty(scan(world, pose.at[2].add(self.rotation), self.max_range), pose)

    def faulty(self, ranges: Float[Array, "271"], pose: Float[Array, " n"]) -> Float[Array, "271"]:
        """True distances with the sensor's noise and drop-outs, which the numbers of a pose decide [m]."""

        def with_faults() -> jax.Array:
            key = jax.random.key(0)
            for bits in jax.lax.bitcast_convert_type(pose, jnp.uint32):
                key = jax.random.fold_in(key, bits)
            k_noise, k_drop = jax.random.split(key)
            noisy = jnp.clip(ranges + self.noise * jax.random.normal(k_noise, ranges.shape), 0.0, self.max_range)
            return jnp.where(jax.random.bernoulli(k_drop, self.dropout, ranges.shape), self.max_range, noisy)

        has_faults = (jnp.asarray(self.noise) > 0) | (jnp.asarray(self.dropout) > 0)
        return jax.lax.cond(has_faults, with_faults, lambda: ranges)


def scan(world: NavigationWorld, pose: Float[ArrayLike, "3"], max_range: Scalar = MAX_RANGE) -> Float[Array, "271"]:
    """Distance along each beam to the first surface [m], from -135 deg to +135 deg, counterclockwise.

    The sensor sits at the robot's centre, below the top of every solid. From inside a solid a beam reads the way out,
    as MuJoCo's rays do. A beam that meets nothing nearer reads `max_range`.
    """
    world, pose = jax.tree.map(jnp.asarray, world), jnp.asarray(pose)
    beams = rotate(from_angle(jnp.asarray(BEAM_ANGLES)), pose[2])
    boxes, circles = _boxes(world.boxes, pose[:2], beams), _circles(world.circles, pose[:2], beams)
    return 1.0 / jnp.maximum(jnp.maximum(boxes.max(0), circles.max(0)), 1.0 / max_range)


def scan_tilted(
    world: NavigationWorld, origin: Float[Array, "3"], turn: Float[Array, "3 3"], max_range: Scalar = MAX_RANGE
) -> Float[Array, "271"]:
    """`scan` of a sensor that is tilted: beams meet the floor, and pass over solids that are too low.

    A beam that has entered a solid above its top is taken to pass over it, and one that begins above a solid's top or
    leaves it upward likewise: tilts of walking are small. `origin` is the sensor's place, with its height above the
    floor [m]; `turn` turns its frame into the world's.
    """
    ahead = from_angle(jnp.asarray(BEAM_ANGLES))
    # Sums, not a matrix product: an accelerator rounds the factors of those.
    beams = ahead[:, :1] * turn[None, :, 0] + ahead[:, 1:] * turn[None, :, 1]
    level = jnp.sqrt(jnp.sum(jnp.square(beams[:, :2]), -1))  # cosine of each beam's slope
    flat, rise = beams[:, :2] / level[:, None], beams[:, 2] / level

    def nearest_of(inverse: Float[Array, "solids beams"], heights: Float[Array, " solids"]) -> Float[Array, " beams"]:
        """The nearest solid's that is high enough where the beam is: height + rise / inverse <= top."""
        return jnp.where(rise[None] <= (heights[:, None] - origin[2]) * inverse, inverse, 0.0).max(0)

    boxes = nearest_of(_boxes(world.boxes, origin[:2], flat), world.box_heights)
    circles = nearest_of(_circles(world.circles, origin[:2], flat), world.circle_heights)
    floor = -rise / origin[2]
    nearest = jnp.maximum(jnp.maximum(boxes, circles), floor) * level
    return 1.0 / jnp.maximum(nearest, 1.0 / max_range)


def _boxes(
    boxes: Float[Array, "boxes 5"], origin: Float[Array, "2"], beams: Float[Array, "beams 2"]
) -> Float[Array, "boxes beams"]:
    """Inverse distance to each box along each beam; 0 or less where it is not met.

    The slab method: a beam is inside a box from where it has entered both of its slabs to where it leaves either.
    """
    place, half = in_frame(boxes, origin), boxes[:, 3:]  # (boxes, 2): along the box's two axes
    axes = jnp.stack([from_angle(boxes[:, 2]), rotate(from_angle(boxes[:, 2]), math.pi / 2)], axis=1)
    gap = jnp.abs(place) - half
    outside = gap > 0
    side = jnp.where(place < 0, -1.0, 1.0)
    enter = jnp.where(outside, -side / jnp.where(outside, gap, 1.0), 0.0)
    unbounded = jnp.where(outside, 0.0, NO_BOUND)
    leave_behind = -side / (jnp.abs(place) + half)  # through the far side
    leave_ahead = jnp.where(outside, leave_behind, side / jnp.where(outside, 1.0, jnp.maximum(-gap, 1e-9)))
    within = ~outside.any(-1)

    def products(factor: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Both axes' inverse distances along every beam: (boxes, beams) each."""
        normals = factor[..., None] * axes
        along = normals[:, :, :1] * beams[None, None, :, 0] + normals[:, :, 1:] * beams[None, None, :, 1]
        return along[:, 0], along[:, 1]

    in_x, in_y = products(enter)
    entered = jnp.minimum(in_x + unbounded[:, 0, None], in_y + unbounded[:, 1, None])
    leaving = jnp.maximum(jnp.maximum(*products(leave_behind)), jnp.maximum(*products(leave_ahead)))
    return jnp.where(entered >= leaving, jnp.where(within[:, None], leaving, entered), 0.0)


def _circles(
    circles: Float[Array, "circles 3"], origin: Float[Array, "2"], beams: Float[Array, "beams 2"]
) -> Float[Array, "circles beams"]:
    """Inverse distance to each circle along each beam; 0 or less where it is not met.

    The two crossings multiply to |centre|^2 - radius^2, which turns the division into one for each circle.
    """
    centre, radius = circles[:, :2] - origin[None], circles[:, 2]
    power = jnp.sum(jnp.square(centre), -1) - jnp.square(radius)
    power = jnp.where(jnp.abs(power) < 1e-9, 1e-9, power)
    other = jnp.where(power > 0, 1.0, -1.0)
    along = centre[:, :1] * beams[None, :, 0] + centre[:, 1:] * beams[None, :, 1]
    across = centre[:, :1] * beams[None, :, 1] - centre[:, 1:] * beams[None, :, 0]
    depth = jnp.square(radius)[:, None] - jnp.square(across)
    inverse = (along + other[:, None] * jnp.sqrt(jnp.maximum(depth, 0.0))) / power[:, None]
    return jnp.where(depth >= 0, inverse, 0.0)
