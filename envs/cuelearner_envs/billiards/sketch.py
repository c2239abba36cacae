"""A table as lines for a browser, and what becomes of a shot: quick, and without matplotlib."""

from __future__ import annotations

import math

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from cuelearner_envs import svg
from cuelearner_envs.billiards import drawing
from cuelearner_envs.billiards.environment import Balls, Billiards
from cuelearner_envs.billiards.physics import positions_at, trace
from cuelearner_envs.billiards.table import Table, corner_gap, cushions, parking, pockets
from cuelearner_jax.actions import to_angle
from cuelearner_jax.types import Reel, Sketch

FRAMES = 90  # of a film
LONGEST = 3.0  # a film [s]: longer shots are shown faster


def sketch(env: Billiards, state: Balls) -> Sketch:
    """The table from above, the cue ball's arrow beginning at its rim."""
    table: Table = jax.device_get(env.table)
    radius, width, height = float(table.ball_radius), float(table.width), float(table.height)
    rail = drawing.rail_width(table)
    positions, pocketed = np.asarray(state.positions), np.asarray(state.pocketed)
    movers = {f"ball-{number}": _ball(number, radius) for number in range(table.balls)}
    left, top = -width / 2 - rail, -height / 2 - rail
    tray = np.asarray(parking(table))
    spots = np.where(pocketed[:, None], tray, positions)
    places = {f"ball-{number}": (float(x), -float(y), 0.0) for number, (x, y) in enumerate(spots)}
    x, y = positions[0]
    above = max(4.3 * radius - rail, 0.0)  # room for pocketed balls, which stand above the table
    return Sketch(
        box=(left, top - above, width + 2 * rail, height + 2 * rail + above),
        still=_table(table),
        movers=movers,
        places=places,
        foot=(float(x), -float(y)),
        reach=(1.25 * radius, 1.25 * radius + 0.11 * width),
        turn=0.0,
        aim=width,
        words=f"{int((~pocketed[1:]).sum())} of {table.balls - 1} on the table",
    )


@jax.jit
def _played(env: Billiards, state: Balls, action: jax.Array) -> tuple[Array, Array, Array, Array]:
    path = trace(env.table, state.positions, state.pocketed, to_angle(action) + env.action_turn)
    seconds = path.times[-1]
    times = jnp.linspace(0.0, 1.0, FRAMES) * seconds
    positions, pocketed = positions_at(env.table, path, times)
    return positions, pocketed, seconds, path.pocketed[-1]


def reel(env: Billiards, state: Balls, action: Float[Array, "2"]) -> Reel:
    """The shot, in `FRAMES` pictures; a ball that falls is not seen from then on."""
    positions, pocketed, seconds, end = jax.device_get(_played(env, state, jnp.asarray(action)))
    frames = [
        {
            f"ball-{number}": None if gone else (float(x), -float(y), 0.0)
            for number, ((x, y), gone) in enumerate(zip(at, fallen, strict=True))
        }
        for at, fallen in zip(positions, pocketed, strict=True)
    ]
    scored = int((end & ~np.asarray(state.pocketed))[1:].sum())
    words = "foul: the cue ball is pocketed" if end[0] else f"{scored} pocketed" if scored else "nothing pocketed"
    return Reel(min(float(seconds), LONGEST) / FRAMES, frames, words)


def _ball(number: int, radius: float) -> str:
    disc = svg.circle((0, 0), radius, f"fill:{drawing.ball_colour(number)};stroke:#1a1a1a;stroke-width:{radius * 0.06}")
    return disc + (svg.text((0, 0), 1.1 * radius, str(number), "fill:white;font-weight:bold") if number else "")


def _table(table: Table) -> str:
    """Everything that does not move."""
    w, h, rail = float(table.width), float(table.height), drawing.rail_width(table)
    parts = [
        svg.rectangle(-w / 2 - rail, -h / 2 - rail, w + 2 * rail, h + 2 * rail, f"fill:{drawing.RAIL}", 0.6 * rail)
    ]
    gap = float(corner_gap(table))
    for x, y in np.asarray(pockets(table)):
        inwards = 0.25 * gap if abs(x) > w / 4 else 0.0  # as `drawing` has it
        radius = math.hypot(gap - inwards, inwards) if inwards else float(table.hole_width)
        centre = (x - math.copysign(inwards, x), -(y - math.copysign(inwards, y)))
        parts.append(svg.circle(centre, radius, f"fill:{drawing.HOLE}"))
    parts.append(svg.rectangle(-w / 2, -h / 2, w, h, f"fill:{drawing.CLOTH}"))
    pad = float(table.cushion_radius)
    for start, end in np.asarray(cushions(table)) * [1.0, -1.0]:
        low, size = np.minimum(start, end) - pad, np.abs(end - start) + 2 * pad
        parts.append(svg.rectangle(low[0], low[1], size[0], size[1], f"fill:{drawing.CUSHION}", pad))
    return "".join(parts)
