"""Drawing billiards with matplotlib: a shot with its paths, a question, an animation. Needs no display.

Lengths are metres; the axes of every drawing are the table's own coordinates. Files end in .png, .svg or .pdf, and
pictures are 8 inches wide.
"""

from __future__ import annotations

import math
import os
from collections.abc import Iterator, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import ArrayLike, Bool, Float, UInt8
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.patches import Circle, FancyBboxPatch

from cuelearner_envs import canvas
from cuelearner_envs.billiards.physics import Trajectory, positions_at
from cuelearner_envs.billiards.sketch import ball_colour, rail_width, solids
from cuelearner_envs.billiards.table import Table
from cuelearner_jax import pictures

ARROW = "#ffd84d"
WORDS: dict[str, Any] = {"va": "center", "fontsize": 9, "color": "#6f675c"}
WIDTH_INCHES = 8.0
HOLD_BEFORE, HOLD_AFTER = 0.8, 0.5  # of an animated shot, at rest [s]

_positions_at = jax.jit(positions_at)


def still(table: Table, path: Trajectory, file: str | os.PathLike[str]) -> None:
    """Write a picture of one shot: pale balls where it began, the way of each, solid balls where they came to rest."""
    figure, axes = _figure(table)
    _draw_tracks(axes, table, path)
    _balls(axes, table, path.positions[-1], path.pocketed[-1])
    _balls(axes, table, path.positions[0], path.pocketed[0], ghosts=True)
    _arrow(axes, table, path.positions[0], path.velocities[0, 0])
    canvas.save(figure, file)


def question(
    table: Table,
    positions: Float[ArrayLike, "balls 2"],
    pocketed: Bool[ArrayLike, "balls"],
    action: Float[ArrayLike, "2"],
    file: str | os.PathLike[str],
) -> None:
    """Write a picture of balls at rest and of the shot in question as an arrow, for somebody to judge it."""
    figure, axes = _figure(table)
    _balls(axes, table, positions, pocketed)
    _arrow(axes, table, positions, action)
    canvas.save(figure, file)


def animate(table: Table, shots: Sequence[Trajectory], file: str | os.PathLike[str], fps: float = 30.0) -> None:
    """Write an animation (.gif or .mp4) of shots; before each, an arrow shows its direction."""
    # The first picture shows every ball and the arrow.
    palette = pictures.palette_of(next(_frames(table, shots, fps)), 255)
    pictures.write_film(file, fps, lambda rate: _frames(table, shots, rate), palette)


def limits(table: Table) -> tuple[float, float, float, float]:
    """left, right, bottom, top of a drawing [m]; the tray for pocketed balls is at the bottom."""
    margin = rail_width(table) + 0.008
    x, y = float(table.width) / 2 + margin, float(table.height) / 2 + margin
    return -x, x, -y - 3.4 * float(table.ball_radius), y


def _figure(table: Table, dpi: float = 160) -> tuple[Figure, Axes]:
    """A figure that is all axes, its sides even numbers of dots, with everything that does not move."""
    left, right, bottom, top = limits(table)
    dots = 2 * round(WIDTH_INCHES * dpi / 2)
    figure = Figure(figsize=(dots / dpi, 2 * round(dots * (top - bottom) / (right - left) / 2) / dpi), dpi=dpi)
    FigureCanvasAgg(figure)
    axes = figure.add_axes((0, 0, 1, 1))
    axes.set(xlim=(left, right), ylim=(bottom, top), aspect="equal")
    axes.axis("off")
    places, r = _tray(table), float(table.ball_radius)
    corner, length = places.min(axis=0) - 1.3 * r, np.ptp(places[:, 0]) + 2.6 * r
    for low, size, rounding, colour in [*solids(table), (corner, (length, 2.6 * r), 1.3 * r, "#e7e2da")]:
        style = f"round,pad=0,rounding_size={rounding}"
        axes.add_patch(FancyBboxPatch(tuple(low), *size, boxstyle=style, facecolor=colour, edgecolor="none"))
    axes.text(corner[0] + length + r, places[0, 1], "pocketed", **WORDS)
    return figure, axes


def _tray(table: Table) -> Float[np.ndarray, "balls 2"]:
    """Return the drawn positions of pocketed balls, below the table, the cue ball last [m]."""
    left, _, bottom, _ = limits(table)
    r = float(table.ball_radius)
    x = left + 0.008 + 1.3 * r + 2.4 * r * ((np.arange(table.balls) - 1) % table.balls)
    return np.stack([x, np.full(table.balls, bottom + 1.7 * r)], axis=-1)


def _balls(axes: Axes, table: Table, positions: Any, pocketed: Any, *, ghosts: bool = False) -> list[Artist]:
    """Add balls with their numbers, pocketed ones in the tray; as pale ghosts of a start without these."""
    left, right, _, _ = limits(table)
    size = 1.05 * float(table.ball_radius) / (right - left) * WIDTH_INCHES * 72
    style = {"ha": "center", "va": "center_baseline", "color": "white", "fontweight": "bold", "zorder": 6}
    artists: list[Artist] = []
    for ball, tray in enumerate(_tray(table)):
        x, y = tray if pocketed[ball] else positions[ball]
        disc = Circle((x, y), float(table.ball_radius), facecolor=ball_colour(ball), edgecolor="#1a1a1a", linewidth=0.6)
        disc.set(zorder=3 if ghosts else 5, alpha=0.35 if ghosts else None, visible=not (ghosts and pocketed[ball]))
        artists.append(axes.add_patch(disc))
        if ball and not ghosts:
            artists.append(axes.text(x, y, str(ball), fontsize=size, **style))
    return artists


def _arrow(axes: Axes, table: Table, positions: Any, way: Any) -> Artist:
    """Add an arrow that begins at the cue ball's rim and points along a way."""
    direction = np.asarray(way, float) / np.linalg.norm(way)
    reach = 1.25 * float(table.ball_radius) + np.array([[0.0], [0.09 * float(table.width)]])
    ends = np.asarray(positions, float)[0] + reach * direction
    return canvas.arrow(axes, ends, ARROW, 14, canvas.edged(4, "#00000066"))


def _draw_tracks(axes: Axes, table: Table, path: Trajectory) -> None:
    """Draw one line for each ball that moves, from its start to where it rests or falls."""
    times, positions, pocketed = np.asarray(path.times), np.asarray(path.positions), np.asarray(path.pocketed)
    for ball in range(table.balls):
        alive = int((~pocketed[:, ball]).sum())
        points = positions[:alive, ball]
        if 0 < alive < len(times):
            # A pocketed ball stands beside the table from that knot on; the way ends where it is just before.
            before, _ = _positions_at(table, path, jnp.asarray([times[alive] - 1e-4]))
            points = np.concatenate([points, np.asarray(before)[:, ball]])
        if alive and np.abs(np.diff(points, axis=0)).sum() > 1e-3:
            edge = canvas.edged(2.6, "#00000055")
            axes.plot(*points.T, color=ball_colour(ball), linewidth=1.4, zorder=4, path_effects=edge)


def _frames(table: Table, shots: Sequence[Trajectory], fps: float) -> Iterator[UInt8[np.ndarray, "height width 3"]]:
    """Pictures of the shots at a fixed rate. The table is drawn once; each frame draws only what moves over it."""
    figure, axes = _figure(table, dpi=100)
    corner = limits(table)[1] - 0.012, _tray(table)[0, 1]
    over = canvas.Backdrop(figure)
    held, after = round(HOLD_BEFORE * fps), round(HOLD_AFTER * fps)
    for number, path in enumerate(shots, start=1):
        frames = held + math.ceil(float(path.times[-1]) * fps) + 1 + after
        padded = np.arange(128 * math.ceil(frames / 128))  # few different lengths: few compilations
        times = jnp.asarray(np.maximum(padded - held, 0) / fps, path.times.dtype)
        positions, pocketed = map(np.asarray, _positions_at(table, path, times))
        for frame in range(frames):
            artists = _balls(axes, table, positions[frame], pocketed[frame])
            if frame < held:
                artists.append(_arrow(axes, table, path.positions[0], path.velocities[0, 0]))
            caption = axes.text(*corner, f"shot {number} of {len(shots)}", ha="right", **WORDS)
            yield over.picture(*artists, caption)
