"""A table as lines for a browser, and what becomes of a shot: quick, and without matplotlib."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from cuelearner_envs import svg
from cuelearner_envs.billiards.environment import Balls, Billiards
from cuelearner_envs.billiards.physics import Trajectory, positions_at
from cuelearner_envs.billiards.table import Table, corner_gap, cushions, parking, pockets
from cuelearner_envs.playing import record_steps
from cuelearner_jax.types import Policy, Reel, Sketch

CLOTH, CUSHION, RAIL, HOLE, CUE = "#2f7f5f", "#1d5741", "#6d4a32", "#15110e", "#fdfbf5"
TARGETS = ("#f2b01e", "#2b62c4", "#d1382c", "#6b3fa0", "#ef7d22", "#0f9d8a", "#8c1d40", "#3a3a3a")
FRAMES = 90  # of a film
LONGEST = 3.0  # a film [s]: longer shots are shown faster
TRAIL = 91  # moments of a trail
TRAIL_SECONDS = 3.0  # so much of a shot a trail tells at most [s]
LEAST_MOVE = 1e-4  # by how much a hit bends a ball's way between two times on a level table, at least [m]


def rail_width(table: Table) -> float:
    """Width of the rail round the table [m]."""
    return max(0.62 * float(corner_gap(table)), 2.0 * float(table.ball_radius))


def ball_colour(ball: int) -> str:
    """Return a ball's colour as a hexadecimal code."""
    return CUE if ball == 0 else TARGETS[(ball - 1) % len(TARGETS)]


def solids(table: Table) -> Iterator[tuple[np.ndarray, np.ndarray, float, str]]:
    """Yield what does not move, from below to above: rounded rectangles.

    Each is its lower left corner, width and height, and the radius of its corners [m], and a colour.
    """
    half, gap, rail = np.array([table.width, table.height], float) / 2, float(corner_gap(table)), rail_width(table)
    yield -half - rail, 2 * (half + rail), 0.6 * rail, RAIL
    for place in np.asarray(pockets(table), float):
        # A disc through the jaws; at a corner drawn a little inwards, so that the rail round it may be narrow. The
        # cloth covers what lies on the table: a ball falls where the cloth ends.
        inwards = 0.25 * gap if abs(place[0]) > half[0] / 2 else 0.0
        radius = math.hypot(gap - inwards, inwards) if inwards else float(table.hole_width)
        yield place - np.sign(place) * inwards - radius, np.full(2, 2 * radius), radius, HOLE
    yield -half, 2 * half, 0.0, CLOTH
    pad = float(table.cushion_radius)
    for start, end in np.asarray(cushions(table), float):
        yield np.minimum(start, end) - pad, np.abs(end - start) + 2 * pad, pad, CUSHION


def record(env: Billiards, policy: Policy, key: PRNGKeyArray, shots: int) -> tuple[list[Trajectory], list[float]]:
    """Return paths and rewards of `shots` shots of a policy; a new rack follows the end of an episode."""
    see = lambda env, state, action, step: (env.path(state, action), step.reward)  # noqa: E731
    rows = record_steps(env, policy, key, shots, see)
    return [path for path, _ in rows], [float(reward) for _, reward in rows]


def sketch(env: Billiards, state: Balls) -> Sketch:
    """The table from above, the cue ball's arrow beginning at its rim."""
    table: Table = jax.device_get(env.table)
    radius, width, height = float(table.ball_radius), float(table.width), float(table.height)
    rail = rail_width(table)
    positions, pocketed = np.asarray(state.positions), np.asarray(state.pocketed)
    movers = {f"ball-{number}": _ball(number, radius) for number in range(table.balls)}
    left, top = -width / 2 - rail, -height / 2 - rail
    spots = np.where(pocketed[:, None], np.asarray(parking(table)), positions)
    x, y = positions[0]
    above = max(4.3 * radius - rail, 0.0)  # room for pocketed balls, which stand above the table
    edge = 0.01 * width  # a frame that ends where the picture does looks cut off
    return Sketch(
        box=(left - edge, top - above - edge, width + 2 * (rail + edge), height + 2 * (rail + edge) + above),
        still="".join(
            svg.rectangle(x, -y - height, width, height, f"fill:{colour}", rounding)
            for (x, y), (width, height), rounding, colour in solids(table)
        ),
        movers=movers,
        places=_places(spots, np.zeros(table.balls, bool)),
        foot=(float(x), -float(y)),
        reach=(1.25 * radius, 1.25 * radius + 0.11 * width),
        turn=0.0,
        aim=width,
        words=f"{int((~pocketed[1:]).sum())} of {table.balls - 1} on the table",
    )


def _places(positions: np.ndarray, gone: np.ndarray) -> dict[str, Any]:
    """Return where each ball is on the screen; None: nowhere."""
    return {
        f"ball-{number}": None if gone[number] else (float(x), -float(y), 0.0)
        for number, (x, y) in enumerate(positions)
    }


@jax.jit
def _play(env: Billiards, state: Balls, action: jax.Array) -> tuple[Array, Array, Array, Array]:
    path = env.path(state, action)
    times = jnp.linspace(0.0, 1.0, FRAMES) * path.times[-1]
    return *positions_at(env.table, path, times), path.times[-1], path.pocketed[-1]


def reel(env: Billiards, state: Balls, action: Float[Array, "2"]) -> Reel:
    """The shot, in `FRAMES` pictures; a ball that falls is not seen from then on."""
    positions, pocketed, seconds, end = jax.device_get(_play(env, state, jnp.asarray(action)))
    frames = [_places(positions[number], fallen) for number, fallen in enumerate(pocketed)]
    scored = int((end & ~np.asarray(state.pocketed))[1:].sum())
    words = "foul: the cue ball is pocketed" if end[0] else f"{scored} pocketed" if scored else "nothing pocketed"
    return Reel(min(float(seconds), LONGEST) / FRAMES, frames, words)


@jax.jit
def _rolled(env: Billiards, state: Balls, actions: jax.Array) -> tuple[Array, Array]:
    times = jnp.linspace(0.0, TRAIL_SECONDS, TRAIL)
    return jax.vmap(lambda action: positions_at(env.table, env.path(state, action), times))(actions)


def trails(env: Billiards, state: Balls, actions: Float[Array, "n 2"]) -> list[str]:
    """Return for each action the paths of the cue ball and of the first ball it hits, for `TRAIL_SECONDS` seconds.

    The cue ball's is a line, the other's is dashed; a ring is where a ball is then, a disc a target that fell, a cross
    the cue ball that did.
    """
    shots = zip(*jax.device_get(_rolled(env, state, jnp.asarray(actions))), strict=True)
    tilt = float(np.linalg.norm(np.asarray(env.table.acceleration)))
    least = LEAST_MOVE + 2 * tilt * (TRAIL_SECONDS / (TRAIL - 1)) ** 2
    return [_trail(float(env.table.ball_radius), least, positions, pocketed) for positions, pocketed in shots]


def _trail(radius: float, least: float, positions: np.ndarray, pocketed: np.ndarray) -> str:
    """Return the ways; `least`: by how much a hit bends one between two times [m], more than a tilted table does."""
    moves = np.linalg.norm(np.diff(positions, n=2, axis=0), axis=-1) > least
    moves[:, 0] = False
    hit = int(moves.any(axis=1).argmax())  # the first moment at which a target has moved
    numbers = [0, int(moves[hit].argmax())] if moves.any() else [0]
    return "".join(_way(radius, number, positions[:, number], pocketed[:, number]) for number in numbers)


def _way(radius: float, number: int, places: np.ndarray, gone: np.ndarray) -> str:
    """Return one ball's path, which ends where the ball falls."""
    places = places[: max(int(gone.argmax()), 1)] if gone.any() else places
    rows = np.asarray(places, float) * [1.0, -1.0]
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


def _ball(number: int, radius: float) -> str:
    disc = svg.circle((0, 0), radius, f"fill:{ball_colour(number)};stroke:#1a1a1a;stroke-width:{radius * 0.06}")
    return disc + (svg.text((0, 0), 1.1 * radius, str(number), "fill:white;font-weight:bold") if number else "")
