"""A table as lines for a browser, and what becomes of a shot: quick, and without matplotlib."""

from __future__ import annotations

import math
from itertools import pairwise

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from cuelearner_envs import svg
from cuelearner_envs.billiards import drawing
from cuelearner_envs.billiards.environment import Balls, Billiards
from cuelearner_envs.billiards.physics import positions_at, trace
from cuelearner_envs.billiards.table import Table, corner_gap, cushions, parking, pockets
from cuelearner_jax.spaces.directions import to_angle
from cuelearner_jax.types import Reel, Sketch

FRAMES = 90  # of a film
LONGEST = 3.0  # a film [s]: longer shots are shown faster
TRAIL = 181  # moments of a trail
BEND = 0.03  # sine of the least angle of a trail's bend
TOLD = 3.0  # so much of a shot a trail tells at most [s]
MOVED = 1e-4  # what a ball moves by that was hit, at least [m]


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
    edge = 0.01 * width  # a frame that ends where the picture does looks cut off
    return Sketch(
        box=(left - edge, top - above - edge, width + 2 * (rail + edge), height + 2 * (rail + edge) + above),
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


@jax.jit
def _rolled(env: Billiards, state: Balls, actions: jax.Array) -> tuple[Array, Array]:
    def one(action: jax.Array) -> tuple[Array, Array]:
        path = trace(env.table, state.positions, state.pocketed, to_angle(action) + env.action_turn)
        return positions_at(env.table, path, jnp.linspace(0.0, TOLD, TRAIL))

    return jax.vmap(one)(actions)


def trails(env: Billiards, state: Balls, actions: Float[Array, "n 2"]) -> list[str]:
    """Return for each action the paths of the cue ball and of the first ball it hits, for `TOLD` seconds.

    The cue ball's is a line, the other's is dashed; a ring is where a ball is then, a disc a target that fell, a cross
    the cue ball that did.
    """
    shots = zip(*jax.device_get(_rolled(env, state, jnp.asarray(actions))), strict=True)
    return [_trail(float(env.table.ball_radius), positions, pocketed) for positions, pocketed in shots]


def _trail(radius: float, positions: np.ndarray, pocketed: np.ndarray) -> str:
    moved = np.linalg.norm(positions - positions[:1], axis=-1) > MOVED
    moved[:, 0] = False
    hit = int(moved.any(axis=1).argmax())  # the first moment at which a target has moved
    shown = [0, int(moved[hit].argmax())] if moved.any() else [0]
    return "".join(_way(radius, number, positions[:, number], pocketed[:, number]) for number in shown)


def _way(radius: float, number: int, places: np.ndarray, gone: np.ndarray) -> str:
    """Return one ball's path, which ends where the ball falls."""
    places = places[: max(int(gone.argmax()), 1)] if gone.any() else places
    rows = _corners(np.asarray(places, float) * [1.0, -1.0])
    dashes = f";stroke-dasharray:{svg.number(0.7 * radius)} {svg.number(0.5 * radius)}" if number else ""
    line = svg.element("polyline", points=svg.points(rows), style=_stroke(0.2 * radius) + dashes)
    x, y = rows[-1]
    if not gone.any():
        return line + svg.circle((x, y), radius, _stroke(0.2 * radius))
    if number:
        return line + svg.circle((x, y), 0.7 * radius, "fill:currentColor;" + _stroke(0.1 * radius, ""))
    ends = [[(x - 0.8 * radius, y - way * 0.8 * radius), (x + 0.8 * radius, y + way * 0.8 * radius)] for way in (1, -1)]
    return line + "".join(svg.element("polyline", points=svg.points(one), style=_stroke(0.5 * radius)) for one in ends)


def _stroke(width: float, fill: str = "fill:none;") -> str:
    """Return the SVG stroke of a line [m]; a page may draw a wider one underneath to set it off."""
    return f"{fill}stroke-width:calc({width:.5f}px*var(--wider,1));stroke-linejoin:round"


def _corners(rows: np.ndarray) -> np.ndarray:
    """The places of a way (n, 2) at which it bends, its first and its last."""
    kept = [rows[0]]
    for place, following in pairwise(rows[1:]):
        way, onward = place - kept[-1], following - place
        bent = abs(way[0] * onward[1] - way[1] * onward[0]) > BEND * np.hypot(*way) * np.hypot(*onward)
        if np.hypot(*way) > MOVED and (bent or way @ onward < 0):
            kept.append(place)
    return np.array([*kept, rows[-1]])


def _ball(number: int, radius: float) -> str:
    disc = svg.circle((0, 0), radius, f"fill:{drawing.ball_colour(number)};stroke:#1a1a1a;stroke-width:{radius * 0.06}")
    return disc + (svg.text((0, 0), 1.1 * radius, str(number), "fill:white;font-weight:bold") if number else "")


def _table(table: Table) -> str:
    """Return the SVG of everything that does not move."""
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
