"""The billiards table: its parameters, its outline and where its balls stand.

Lengths are metres, the origin is the table's centre, x runs along the long side, ball 0 is the cue ball.
"""

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Float

Scalar = float | Float[Array, ""]
CORNER_GAP = 1.4142  # a cushion ends this many hole widths before a corner: the hole then measures two of them across


class Table(struct.PyTreeNode):
    """Parameters of one table. Every field but the last three is traced: a changed value needs no new compile.

    Sizes and constants are those of CueLearner's billiards (arXiv 2507.04730).
    """

    width: Scalar  # along x [m]
    height: Scalar  # along y [m]
    ball_radius: Scalar  # [m]
    hole_width: Scalar  # half the opening of a pocket [m]
    rack_jitter: Scalar  # scale of the racked balls' random displacement [m]
    friction: Scalar = 0.25  # Coulomb coefficient at a contact, with balls and cushions alike
    restitution: Scalar = 1.0  # of every contact
    speed_kept: Scalar = 0.7  # share of linear and angular velocity left after a second, in (0, 1]
    strike_speed: Scalar = 0.5  # of the cue ball [m/s]
    stop_speed: Scalar = 0.05  # a shot is over when every ball is slower [m/s]
    acceleration: tuple[float, float] | Float[Array, "2"] = (0.0, 0.0)  # of every ball, as on a tilted table [m/s^2]
    cushion_radius: Scalar = 0.004  # cushions are rounded this far round the table's edge [m]
    pocket_margin: Scalar = 0.001  # a ball whose centre is this far outside is pocketed [m]
    balls: int = struct.field(pytree_node=False, default=4)  # with the cue ball
    side_pockets: bool = struct.field(pytree_node=False, default=False)  # in the middle of both long sides
    max_events: int = struct.field(pytree_node=False, default=256)  # bound on a shot's impacts, pocketings and kicks

    @classmethod
    def regulation(cls) -> "Table":
        """The paper's table: three small target balls and six pockets."""
        return cls(width=0.88, height=0.44, ball_radius=0.01125, hole_width=0.025, rack_jitter=0.001, side_pockets=True)

    @classmethod
    def easy(cls) -> "Table":
        """Three large target balls and four wide pockets."""
        return cls(width=0.8, height=0.4, ball_radius=0.02, hole_width=0.05, rack_jitter=0.002)

    @classmethod
    def one_ball(cls) -> "Table":
        """The easy table with a single target ball."""
        return cls(width=0.8, height=0.4, ball_radius=0.02, hole_width=0.05, rack_jitter=0.002, balls=2)


def corner_gap(table: Table) -> Float[Array, ""]:
    """Distance between a corner and the cushions that end before it [m]."""
    return jnp.asarray(CORNER_GAP * table.hole_width)


def cushions(table: Table) -> Float[Array, "segments 2 2"]:
    """Centre lines of the cushions, from end to end [m]: four of them, six with side pockets.

    Their ends are the jaws of the pockets.
    """
    x, y, gap, hole = (jnp.asarray(v) for v in (table.width / 2, table.height / 2, corner_gap(table), table.hole_width))
    stretches = [(hole, x - gap), (-(x - gap), -hole)] if table.side_pockets else [(-(x - gap), x - gap)]
    long_sides = [[(start, sy * y), (end, sy * y)] for start, end in stretches for sy in (1, -1)]
    ends = [[(sx * x, -(y - gap)), (sx * x, y - gap)] for sx in (1, -1)]
    return jnp.asarray([[jnp.stack(end) for end in segment] for segment in long_sides + ends])


def pockets(table: Table) -> Float[Array, "pockets 2"]:
    """The places on the table's edge at the middle of each pocket [m]: four corners, then the side pockets."""
    x, y = table.width / 2, table.height / 2
    places = [(sx * x, sy * y) for sx in (1, -1) for sy in (1, -1)]
    if table.side_pockets:
        places += [(0.0 * x, sy * y) for sy in (1, -1)]
    return jnp.stack([jnp.stack([jnp.asarray(px), jnp.asarray(py)]) for px, py in places])


def parking(table: Table) -> Float[Array, "balls 2"]:
    """Return the positions of balls once pocketed [m]: in a row beside the table, by ball index."""
    ball = jnp.arange(table.balls)
    x = table.ball_radius * (1.0 + 3.0 * ball) - table.width / 2
    return jnp.stack([x, table.height / 2 + 3.0 * table.ball_radius + 0.0 * ball], axis=-1)


def rack(table: Table) -> Float[Array, "balls 2"]:
    """The start without jitter [m]: the cue ball and the head of the targets' triangle a quarter of the table in."""
    row = [r for r in range(table.balls) for _ in range(r + 1)][: table.balls - 1]
    place = [p - r / 2 for r in range(table.balls) for p in range(r + 1)][: table.balls - 1]
    spacing = 1.05 * 2.0 * table.ball_radius
    x = table.width / 4 + spacing * jnp.sqrt(0.75) * jnp.asarray(row)
    y = spacing * jnp.asarray(place)
    cue = jnp.stack([jnp.asarray(-table.width / 4), jnp.zeros_like(jnp.asarray(table.width))])
    return jnp.concatenate([cue[None], jnp.stack([x, y], axis=-1)])


def as_arrays(table: Table, dtype: jnp.dtype) -> Table:
    """Return the table with every traced field as an array of `dtype`."""
    return jax.tree.map(lambda leaf: jnp.asarray(leaf, dtype), table)
