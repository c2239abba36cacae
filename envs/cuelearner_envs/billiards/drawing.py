"""Drawing billiards with matplotlib: a table, a shot with its paths, an animation. Needs no display.

Lengths are metres; the axes of every drawing are the table's own coordinates.
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
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.patches import Circle, FancyArrowPatch, FancyBboxPatch, Rectangle

from cuelearner_envs import canvas
from cuelearner_envs.billiards.physics import Trajectory, positions_at
from cuelearner_envs.billiards.table import Table, corner_gap, cushions, pockets
from cuelearner_jax import pictures

CLOTH, CUSHION, RAIL, RAIL_EDGE, HOLE = "#2f7f5f", "#1d5741", "#6d4a32", "#4b3222", "#15110e"
ARROW = "#ffd84d"
CUE = "#fdfbf5"
TARGETS = ("#f2b01e", "#2b62c4", "#d1382c", "#6b3fa0", "#ef7d22", "#0f9d8a", "#8c1d40", "#3a3a3a")
WIDTH_INCHES = 8.0
HOLD_BEFORE, HOLD_AFTER = 0.8, 0.5  # of an animated shot, at rest [s]

_positions_at = jax.jit(positions_at)


def draw_table(
    axes: Axes,
    table: Table,
    positions: Float[ArrayLike, "balls 2"],
    pocketed: Bool[ArrayLike, "balls"],
    *,
    angle: float | None = None,
    path: Trajectory | None = None,
) -> None:
    """Draw a table and its balls, filling the axes; pocketed balls lie in the tray below the table.

    A proposed shot's `angle` is drawn as an arrow from the cue ball [rad]; of a `path` each ball's line.
    """
    _draw_room(axes, table)
    if path is not None:
        _draw_tracks(axes, table, path)
    _Balls(axes, table).place(np.asarray(positions), np.asarray(pocketed))
    if angle is not None:
        _arrow(axes).set_positions(*_arrow_ends(table, np.asarray(positions)[0], angle))


def still(table: Table, path: Trajectory, file: str | os.PathLike[str], dpi: int = 160) -> None:
    """Write a picture of one shot: pale balls where it began, the way of each, solid balls where they came to rest.

    The file's name ends in .png, .svg or .pdf; the picture is 8 inches wide.
    """
    figure, axes = _figure(table, dpi)
    draw_table(axes, table, path.positions[-1], path.pocketed[-1], path=path)
    start = np.asarray(path.positions[0])
    _Balls(axes, table, ghosts=True).place(start, np.asarray(path.pocketed[0]))
    _arrow(axes).set_positions(*_arrow_ends(table, start[0], _angle(path)))
    canvas.save(figure, file, dpi)


def question(
    table: Table,
    positions: Float[ArrayLike, "balls 2"],
    pocketed: Bool[ArrayLike, "balls"],
    action: Float[ArrayLike, "2"],
    file: str | os.PathLike[str],
    dpi: int = 160,
) -> None:
    """Write a picture of balls at rest and of the shot in question as an arrow, for somebody to judge it."""
    figure, axes = _figure(table, dpi)
    x, y = np.asarray(action, dtype=float)
    draw_table(axes, table, positions, pocketed, angle=math.atan2(y, x))
    canvas.save(figure, file, dpi)


def animate(
    table: Table, shots: Sequence[Trajectory], file: str | os.PathLike[str], fps: float = 30.0, speed: float = 1.0
) -> None:
    """Write an animation (.gif or .mp4) of shots; before each, an arrow shows its direction.

    `speed`: seconds of the game in a second of the film.
    """
    pictures.check_film(file, fps)
    # The first picture shows every ball and the arrow.
    palette = pictures.palette_of(next(_frames(table, shots, fps, speed)), 255)
    pictures.write_film(file, fps, lambda rate: _frames(table, shots, rate, speed), palette)


def rail_width(table: Table) -> float:
    """Width of the rail round the table [m]."""
    return max(0.62 * float(corner_gap(table)), 2.0 * float(table.ball_radius))


def _limits(table: Table) -> tuple[float, float, float, float]:
    """left, right, bottom, top of a drawing [m]; the tray for pocketed balls is at the bottom."""
    margin = rail_width(table) + 0.008
    x, y = float(table.width) / 2 + margin, float(table.height) / 2 + margin
    return -x, x, -y - 3.4 * float(table.ball_radius), y


def _figure(table: Table, dpi: float) -> tuple[Figure, Axes]:
    """A figure that is all axes, its sides even numbers of dots."""
    left, right, bottom, top = _limits(table)
    dots = 2 * round(WIDTH_INCHES * dpi / 2)
    figure = Figure(figsize=(dots / dpi, 2 * round(dots * (top - bottom) / (right - left) / 2) / dpi), dpi=dpi)
    FigureCanvasAgg(figure)
    return figure, figure.add_axes((0, 0, 1, 1))


def _draw_room(axes: Axes, table: Table) -> None:
    """Draw everything that does not move."""
    w, h, r, rail = float(table.width), float(table.height), float(table.ball_radius), rail_width(table)
    left, right, bottom, top = _limits(table)
    axes.set(xlim=(left, right), ylim=(bottom, top), aspect="equal")
    axes.axis("off")
    rounded = f"round,pad=0,rounding_size={0.6 * rail}"
    frame = FancyBboxPatch((-w / 2 - rail, -h / 2 - rail), w + 2 * rail, h + 2 * rail, boxstyle=rounded)
    frame.set(linewidth=2, facecolor=RAIL, edgecolor=RAIL_EDGE)
    axes.add_patch(frame)
    gap = float(corner_gap(table))
    for x, y in np.asarray(pockets(table)):
        corner = abs(x) > w / 4
        # Through the jaws; of a corner pocket, drawn a little inwards, so that the rail round it may be narrow. What
        # lies on the table is covered by the cloth: a ball falls where the cloth ends.
        inwards = 0.25 * gap if corner else 0.0
        radius = math.hypot(gap - inwards, inwards) if corner else float(table.hole_width)
        axes.add_patch(Circle((x - math.copysign(inwards, x), y - math.copysign(inwards, y)), radius, color=HOLE))
    axes.add_patch(Rectangle((-w / 2, -h / 2), w, h, facecolor=CLOTH, edgecolor="none"))
    pad = float(table.cushion_radius)
    for start, end in np.asarray(cushions(table)):
        low, size = np.minimum(start, end), np.abs(end - start)
        capsule = f"round,pad={pad},rounding_size={pad}"
        axes.add_patch(FancyBboxPatch(tuple(low), *size, boxstyle=capsule, facecolor=CUSHION, edgecolor="none"))
    places = _tray(table)
    corner, size = places.min(axis=0) - 1.3 * r, (np.ptp(places[:, 0]) + 2.6 * r, 2.6 * r)
    slot = FancyBboxPatch(tuple(corner), *size, boxstyle=f"round,pad=0,rounding_size={1.3 * r}")
    slot.set(linewidth=1, facecolor="#e7e2da", edgecolor="#c9c1b4")
    axes.add_patch(slot)
    axes.text(corner[0] + size[0] + r, places[0, 1], "pocketed", va="center", fontsize=9, color="#6f675c")


def _tray(table: Table) -> Float[np.ndarray, "balls 2"]:
    """Return the drawn positions of pocketed balls, below the table, the cue ball last [m]."""
    left, _, bottom, _ = _limits(table)
    r = float(table.ball_radius)
    x = left + 0.008 + 1.3 * r + 2.4 * r * ((np.arange(table.balls) - 1) % table.balls)
    return np.stack([x, np.full(table.balls, bottom + 1.7 * r)], axis=-1)


class _Balls:
    """The artists of all balls, which can be moved."""

    def __init__(self, axes: Axes, table: Table, *, ghosts: bool = False, animated: bool = False) -> None:
        self.tray, self.ghosts = _tray(table), ghosts
        left, right, _, _ = _limits(table)
        assert axes.figure is not None
        points = float(table.ball_radius) / (right - left) * axes.figure.get_figure(root=True).get_figwidth() * 72
        self.discs, self.numbers = [], []
        for ball in range(table.balls):
            colour = ball_colour(ball)
            look = {"facecolor": colour, "edgecolor": "#1a1a1a", "linewidth": 0.6, "zorder": 5}
            if ghosts:
                look |= {"alpha": 0.35, "zorder": 3}
            disc = Circle((0, 0), float(table.ball_radius), animated=animated, **look)
            self.discs.append(axes.add_patch(disc))
            style = {"ha": "center", "va": "center_baseline", "color": "white", "fontweight": "bold", "zorder": 6}
            number = "" if ball == 0 or ghosts else str(ball)
            self.numbers.append(axes.text(0, 0, number, fontsize=1.05 * points, animated=animated, **style))

    def place(self, positions: Float[np.ndarray, "balls 2"], pocketed: Bool[np.ndarray, "balls"]) -> None:
        """Move the balls; pocketed ones to the tray, or out of sight where they are the ghosts of a start."""
        for ball, (disc, number) in enumerate(zip(self.discs, self.numbers, strict=True)):
            centre = self.tray[ball] if pocketed[ball] else positions[ball]
            disc.set_center(tuple(centre))
            disc.set_visible(not (self.ghosts and pocketed[ball]))
            number.set_position(tuple(centre))

    @property
    def artists(self) -> list[Any]:
        """Each ball's disc and number."""
        return [one for pair in zip(self.discs, self.numbers, strict=True) for one in pair]


def ball_colour(ball: int) -> str:
    """Return a ball's colour as a hexadecimal code."""
    return CUE if ball == 0 else TARGETS[(ball - 1) % len(TARGETS)]


def _angle(path: Trajectory) -> float:
    x, y = np.asarray(path.velocities[0, 0], dtype=float)
    return math.atan2(y, x)


def _arrow(axes: Axes, animated: bool = False) -> FancyArrowPatch:
    return canvas.arrow(axes, ARROW, 14, canvas.edged(4, "#00000066"), animated)


def _arrow_ends(table: Table, cue: np.ndarray, angle: float) -> tuple[tuple[float, float], tuple[float, float]]:
    direction = np.array([math.cos(angle), math.sin(angle)])
    reach = (1.25 * float(table.ball_radius), 1.25 * float(table.ball_radius) + 0.09 * float(table.width))
    (x0, y0), (x1, y1) = (cue + length * direction for length in reach)
    return (x0, y0), (x1, y1)


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


def _frames(
    table: Table, shots: Sequence[Trajectory], fps: float, speed: float
) -> Iterator[UInt8[np.ndarray, "height width 3"]]:
    """Pictures of the shots at a fixed rate. The table is drawn once; each frame draws only what moves over it."""
    figure, axes = _figure(table, dpi=100)
    _draw_room(axes, table)
    balls, arrow = _Balls(axes, table, animated=True), _arrow(axes, animated=True)
    _, right, _, _ = _limits(table)
    style = {"ha": "right", "va": "center", "fontsize": 9, "color": "#6f675c"}
    caption = axes.text(right - 0.012, _tray(table)[0, 1], "", animated=True, **style)
    over = canvas.Backdrop(figure)
    for number, path in enumerate(shots, start=1):
        caption.set_text(f"shot {number} of {len(shots)}")
        arrow.set_positions(*_arrow_ends(table, np.asarray(path.positions[0, 0]), _angle(path)))
        positions, pocketed, held = _film(table, path, fps, speed)
        for frame in range(len(positions)):
            balls.place(positions[frame], pocketed[frame])
            yield over.picture(*balls.artists, *([arrow] if frame < held else []), caption)


def _film(
    table: Table, path: Trajectory, fps: float, speed: float
) -> tuple[Float[np.ndarray, "frames balls 2"], Bool[np.ndarray, "frames balls"], int]:
    """Positions [m] and pocketed balls of one shot's frames, at rest before and after it; the frames before it."""
    held, after = round(HOLD_BEFORE * fps), round(HOLD_AFTER * fps)
    moving = math.ceil(float(path.times[-1]) / speed * fps) + 1
    frames = held + moving + after
    padded = 128 * math.ceil(frames / 128)  # few different lengths: few compilations
    times = np.maximum(np.arange(padded) - held, 0) * speed / fps
    positions, pocketed = _positions_at(table, path, jnp.asarray(times, path.times.dtype))
    return np.asarray(positions)[:frames], np.asarray(pocketed)[:frames], held
