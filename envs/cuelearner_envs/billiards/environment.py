"""Billiards as a task: observation, rules and reward of the CueLearner paper (section V-A) round the exact physics.

One step is one shot in a chosen direction. Reward: target balls pocketed by the shot. A foul (the cue ball pocketed)
gives nothing and puts every ball back, the cue ball at a free place in the left quarter.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from cuelearner_envs.billiards.aims import aims_of
from cuelearner_envs.billiards.physics import Trajectory, simulate, trace
from cuelearner_envs.billiards.table import Table, parking, rack
from cuelearner_jax.environment import Aims, Features, Quantity, WholeObservations
from cuelearner_jax.spaces.directions import retract, rotate, to_angle
from cuelearner_jax.types import Step

PLACEMENTS = 16  # places tried for a ball that must not touch another
FLAG = 0.5  # third entry of a ball's observation: +0.5 once pocketed, -0.5 before


class Balls(struct.PyTreeNode):
    """State between shots."""

    positions: Float[Array, "balls 2"]  # [m]; ball 0 is the cue ball
    pocketed: Bool[Array, " balls"]
    shots: Int[Array, ""]  # taken in this episode


class Billiards(WholeObservations, struct.PyTreeNode):
    """The environment (`cuelearner_jax.environment.Environment`). Everything but the last two fields is traced."""

    table: Table
    action_turn: Float[Array, ""] | float = 0.0  # embodiment shift: every strike is turned by this [rad]
    observation_bias: Float[Array, "2"] | tuple[float, float] = (0.0, 0.0)  # sensor shift of balls on the table [m]
    max_shots: int = struct.field(pytree_node=False, default=10)  # an episode is truncated after this many
    mirrors: bool = struct.field(pytree_node=False, default=False)  # offer the table's symmetries as data?

    action = Quantity("direction", 2, "1", "unit vector in the table's frame; the cue ball is struck that way")

    @property
    def observation(self) -> tuple[Quantity, ...]:
        """Three entries a ball, the cue ball first; see `observe`."""
        targets = [f"target {number}" for number in range(1, self.table.balls)]
        return tuple(
            quantity
            for name in ["cue ball", *targets]
            for quantity in (
                Quantity(f"{name}: place", 2, "m", "x, y from the table's centre"),
                Quantity(f"{name}: pocketed", 1, "1", f"+{FLAG} once pocketed, -{FLAG} before"),
            )
        )

    @property
    def symmetries(self) -> int:
        """Identity, mirrored in x, in y, in both: the result of a shot is mirrored with the table, exactly."""
        return 4 if self.mirrors else 1

    def reset(self, key: PRNGKeyArray) -> tuple[Balls, Float[Array, " obs"]]:
        """Rack the balls: targets in a triangle, each displaced by a Gaussian of scale `table.rack_jitter`."""
        balls = Balls(
            positions=_jittered_rack(key, self.table),
            pocketed=jnp.zeros(self.table.balls, bool),
            shots=jnp.zeros((), jnp.int32),
        )
        return balls, self.observe(balls)

    def step(self, key: PRNGKeyArray, state: Balls, action: Float[Array, "2"]) -> tuple[Balls, Step]:
        """Play one shot; a new rack follows the last one of an episode."""
        k_place, k_reset = jax.random.split(key)
        shot = simulate(self.table, state.positions, state.pocketed, to_angle(action) + self.action_turn)
        foul = shot.pocketed[0]
        reward = jnp.where(foul, 0, (shot.pocketed & ~state.pocketed)[1:].sum()).astype(jnp.float32)
        replaced = state.positions.at[0].set(_free_place(k_place, self.table, state))
        after = Balls(
            positions=jnp.where(foul, replaced, shot.positions),
            pocketed=jnp.where(foul, state.pocketed, shot.pocketed),
            shots=state.shots + 1,
        )
        cleared = after.pocketed[1:].all()
        metrics = {"scored": reward > 0, "foul": foul, "exhausted": shot.exhausted}
        metrics = {name: value.astype(jnp.float32) for name, value in metrics.items()}
        return self.step_to(k_reset, after, reward, cleared, (after.shots >= self.max_shots) & ~cleared, metrics, {})

    def path(self, balls: Balls, action: Float[Array, "2"]) -> Trajectory:
        """Simulate the shot of an action event by event, for drawing."""
        return trace(self.table, balls.positions, balls.pocketed, to_angle(action) + self.action_turn)

    def observe(self, balls: Balls) -> Float[Array, " obs"]:
        """x [m], y [m] and a flag for the cue ball, then for the targets from the highest y down, then by x.

        Pocketed targets come first: they stand beside the table, in the order of their row and not of their number, so
        that equal positions look equal. No sensor looks there: their places have no bias.
        """
        places = balls.positions + jnp.asarray(self.observation_bias)[None]
        entries = jnp.concatenate([places, jnp.where(balls.pocketed, FLAG, -FLAG)[:, None]], axis=-1)
        return jnp.concatenate([entries[0], self._sorted(entries[1:]).ravel()])

    def _sorted(self, targets: Float[Array, "targets 3"]) -> Float[Array, "targets 3"]:
        """Targets in the order of an observation, the pocketed ones in their row beside the table."""
        pocketed = targets[:, 2] > 0
        order = jnp.lexsort((targets[:, 0], -targets[:, 1], ~pocketed))
        placed = jnp.where(pocketed[order, None], jnp.asarray(parking(self.table))[1:], targets[order, :2])
        return jnp.concatenate([placed, targets[order, 2:]], axis=-1)

    def heuristic(self, obs: Float[Array, " obs"]) -> Float[Array, "2"]:
        """Straight at the closest target on the table."""
        balls = obs.reshape(-1, 3)
        offsets = balls[1:, :2] - balls[:1, :2]
        distance = jnp.where(balls[1:, 2] > 0, jnp.inf, jnp.linalg.norm(offsets, axis=-1))
        return retract(offsets[jnp.argmin(distance)])

    def mirror(
        self, which: Int[Array, ""] | int, obs: Float[Array, " obs"], vector: Float[Array, "2"]
    ) -> tuple[Float[Array, " obs"], Float[Array, "2"]]:
        """0: as it is; 1: x reversed; 2: y reversed; 3: both. Exact for the shot's result in the unchanged world.

        A turned strike, a sensor's bias and a tilt are not mirrored with the table. What follows an episode's end or a
        foul (rack, left quarter) is not symmetric in x: use it at discount 0.
        """
        signs = jnp.stack([1.0 - 2.0 * (which % 2), 1.0 - 2.0 * (which // 2)])
        balls = obs.reshape(-1, 3)
        image = balls.at[:, :2].multiply(jnp.where(balls[:, 2:] > 0, 1.0, signs))
        return jnp.concatenate([image[0], self._sorted(image[1:]).ravel()]), vector * signs

    def aims(self, obs: Float[Array, " obs"]) -> Aims:
        """Each target straight into each pocket: where to strike, and what makes the shot hard (`aims_of`).

        As the player sees the table: of a sensor's bias, a turned strike or a tilt they know nothing.
        """
        return aims_of(self.table, obs)

    def features(self, obs: Float[Array, " obs"], actions: Float[Array, "*n 2"]) -> Features:
        """A shot as the player sees it: balls relative to the cue ball, along and across the direction of the strike.

        Scaled to the order of one; the offset across is also given in ball diameters, squashed, for it decides the cut.

        - own, 2 + 3 * targets: the cue ball's place; of each target its place and whether it is on the table
        - turned, 6 + 3 * targets: the direction, alone and times the cue ball's place; of each target its offset along
          and across, and the latter in diameters through the arc tangent
        """
        balls = obs.reshape(-1, 3)
        scale = jnp.asarray(self.table.height)
        cue, places, on_table = balls[0, :2] / scale, balls[1:, :2] / scale, (balls[1:, 2:] < 0).astype(jnp.float32)
        own = jnp.concatenate([cue, jnp.concatenate([places * on_table, on_table], axis=-1).ravel()])
        frame = jnp.stack([actions, rotate(actions, jnp.asarray(jnp.pi / 2))], axis=-2)  # (*n, 2, 2): along, across
        # Precise on accelerators too: they round the factors of a matrix product.
        apart = balls[1:, :2] - balls[:1, :2]
        offsets = jnp.einsum("...ij,tj->...ti", frame, apart, precision=jax.lax.Precision.HIGHEST)
        cut = jnp.arctan(offsets[..., 1:] / (2.0 * self.table.ball_radius))
        each = jnp.concatenate([offsets / scale, cut], axis=-1)
        each = jnp.where(jnp.broadcast_to(on_table, each.shape) > 0, each, 0.0).reshape(*actions.shape[:-1], -1)
        cue = jnp.broadcast_to(cue, actions.shape)
        turned = [actions, cue * actions, cue[..., ::-1] * actions, each]
        return Features(own, jnp.concatenate(turned, axis=-1))


def _jittered_rack(key: PRNGKeyArray, table: Table) -> Float[Array, "balls 2"]:
    """The rack, its targets displaced; of several draws the first in which no two balls overlap (else the loosest)."""
    standing = rack(table)
    noise = table.rack_jitter * jax.random.normal(key, (PLACEMENTS, table.balls - 1, 2))
    draws = jnp.concatenate([jnp.broadcast_to(standing[:1], (PLACEMENTS, 1, 2)), standing[None, 1:] + noise], axis=1)
    offsets = draws[:, :, None] - draws[:, None]
    squared = jnp.sum(offsets**2, -1) + jnp.where(jnp.eye(table.balls, dtype=bool), jnp.inf, 0.0)[None]
    clearance = jnp.sqrt(squared.min((1, 2))) - 2 * table.ball_radius  # of the two closest balls [m]
    return draws[jnp.argmax(jnp.where(clearance > 0, 1.0, clearance))]


def _free_place(key: PRNGKeyArray, table: Table, state: Balls) -> Float[Array, "2"]:
    """A uniform place in the left quarter of the table that touches no ball (of several draws the first free one)."""
    reach = table.ball_radius + table.cushion_radius
    low = jnp.stack([-table.width / 2 + reach, -table.height / 2 + reach])
    high = jnp.stack([jnp.asarray(-table.width / 4), jnp.asarray(table.height / 2 - reach)])
    places = jax.random.uniform(key, (PLACEMENTS, 2), minval=low, maxval=high)
    distance = jnp.linalg.norm(places[:, None] - state.positions[None, 1:], axis=-1)
    clearance = jnp.where(state.pocketed[1:], jnp.inf, distance).min(-1) - 2 * table.ball_radius
    return places[jnp.argmax(jnp.where(clearance > 0, 1.0, clearance))]
