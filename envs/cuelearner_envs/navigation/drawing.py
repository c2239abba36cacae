"""Drawing navigation from above with matplotlib: worlds, an episode, an animation. Needs no display.

Lengths are metres; the axes of every drawing are the world's own coordinates.
"""

from __future__ import annotations

import itertools
import math
import os
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
from jaxtyping import Float, UInt8
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import to_hex, to_rgb
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Circle, FancyArrowPatch, Polygon, Rectangle

from cuelearner_envs import canvas
from cuelearner_envs.navigation.lidar import BEAM_ANGLES
from cuelearner_envs.navigation.recording import Frame
from cuelearner_envs.navigation.robot import Robot, hull
from cuelearner_envs.navigation.world import World, tallness, used
from cuelearner_jax import pictures

# Okabe and Ito's palette, as in the figures of results: told apart with any colour vision.
BODY, GOAL, CRASH, ARROW, BEAMS, HITS = "#0072B2", "#009E73", "#D55E00", "#E69F00", "#56B4E9", "#CC79A7"
START, INK = "#000000", "#333333"
OUTCOMES = {"success": GOAL, "collision": CRASH, "fall": CRASH, "timeout": INK}
WORDS = {
    "success": "reached the goal after",
    "collision": "collision after",
    "fall": "fell after",
    "timeout": "out of time after",
}
CHOSEN, ASKED = "direction chosen", "direction in question"  # what an arrow means
FLOOR, LOW, TALL = "#fbfaf7", "#c9ccd1", "#5d636b"
WIDTH_INCHES, STRIP_INCHES, MARGIN = 7.0, 0.4, 0.35  # the strip below the floor is for words; margin in [m]
ARROW_REACH = (0.55, 1.6)  # beginning and end of an arrow, from the middle of the body [m]
GHOSTS_APART = 1.4  # between the bodies of a still [m]
HOLD_AFTER = 1.2  # at the end of an animated episode [s]


def draw_world(axes: Axes, world: World) -> None:
    """Draw the floor and the solids of a world from above, the taller the darker, filling the axes."""
    half = np.asarray(world.extent, float) / 2
    axes.set(xlim=(-half[0] - MARGIN, half[0] + MARGIN), ylim=(-half[1] - MARGIN, half[1] + MARGIN), aspect="equal")
    axes.axis("off")
    axes.add_patch(Rectangle((-half[0], -half[1]), *(2 * half), facecolor=FLOOR, edgecolor="none", zorder=0))
    solids = [(height, _box(row)) for row, height in used(world.boxes, world.box_heights)]
    solids += [(height, Circle((row[0], row[1]), row[2])) for row, height in used(world.circles, world.circle_heights)]
    for height, patch in sorted(solids, key=lambda solid: solid[0]):  # from above, the tall covers the low
        patch.set(facecolor=shade(height), edgecolor="none", zorder=1)
        axes.add_patch(patch)


def still(robot: Robot, frames: Sequence[Frame], file: str | os.PathLike[str], dpi: int = 160) -> None:
    """Write a picture of the first episode: its way, and halfway what the lidar saw and what was chosen.

    The file's name ends in .png, .svg or .pdf; the picture is 7 inches wide.
    """
    episode = [frame for frame in frames if frame.episode == frames[0].episode]
    first, middle, last = episode[0], episode[len(episode) // 2], episode[-1]
    figure, axes, strip = _figure(np.asarray(first.world.extent), dpi)
    _draw_course(axes, first)
    _draw_strip(strip, first.world)
    _Lidar(axes).place(middle)
    way = _way(episode)
    axes.plot(*way[:, :2].T, color=BODY, linewidth=1.8, zorder=4)
    for pose in _spread(way, middle.pose):
        _Body(axes, robot, alpha=0.35).place(pose)
    _Body(axes, robot).place(middle.pose)
    _Body(axes, robot, colour=CRASH if last.outcome in ("collision", "fall") else BODY).place(last.next_pose)
    _arrow(axes).set_positions(*_arrow_ends(middle))
    words = WORDS.get(last.outcome, "still walking after")
    length = np.linalg.norm(np.diff(way[:, :2], axis=0), axis=-1).sum()
    _caption(strip).set(text=f"{words} {last.seconds:.1f} s, {length:.1f} m", color=OUTCOMES.get(last.outcome, INK))
    canvas.save(figure, file, dpi)


def question(robot: Robot, frame: Frame, file: str | os.PathLike[str], dpi: int = 160) -> None:
    """Write a picture of one situation and of the direction in question as an arrow, for somebody to judge it."""
    figure, axes, strip = _figure(np.asarray(frame.world.extent), dpi)
    draw_world(axes, frame.world)
    _draw_goal(axes, frame)
    _draw_strip(strip, frame.world, ("goal", "lidar", ASKED))
    _Lidar(axes).place(frame)
    _Body(axes, robot).place(frame.pose)
    _arrow(axes).set_positions(*_arrow_ends(frame))
    away = float(np.linalg.norm(np.asarray(frame.goal) - frame.pose[:2]))
    _caption(strip).set(text=f"{away:.1f} m from the goal", color=INK)
    canvas.save(figure, file, dpi)


def animate(robot: Robot, frames: Sequence[Frame], file: str | os.PathLike[str], fps: float = 10.0) -> None:
    """Write an animation (.gif or .mp4) of all episodes, one picture a step; the end of an episode stands for a moment.

    With steps of 0.2 s, 10 pictures a second show twice the speed of life.
    """
    pictures.check_film(file, fps)
    exactly = (BODY, GOAL, CRASH, ARROW, HITS, FLOOR, "#ffffff")
    palette = pictures.palette_of(_specimen(robot, frames), 88, exactly)
    pictures.write_film(file, fps, lambda rate: _pictures(robot, frames, round(HOLD_AFTER * rate)), palette)


def shade(height: float) -> str:
    """Colour of a solid of some height [m], a hexadecimal code."""
    share = tallness(height)
    return to_hex((1 - share) * np.array(to_rgb(LOW)) + share * np.array(to_rgb(TALL)))  # pyright: ignore[reportArgumentType]


def outline(robot: Robot, pose: Float[np.ndarray, "3"]) -> Float[np.ndarray, "points 2"]:
    """Return the outline of the body at a pose [m]."""
    return _to_world(pose, hull(robot)[0])


def hits(frame: Frame) -> Float[np.ndarray, "271 2"]:
    """Return the lidar's beam ends as the robot takes them [m], wrong for a sensor that is mounted rotated."""
    angles = np.asarray(BEAM_ANGLES, float)
    beams = np.stack([np.cos(angles), np.sin(angles)], axis=-1)
    return _to_world(frame.pose, np.asarray(frame.ranges)[:, None] * beams)


def _to_world(pose: np.ndarray, points: Float[np.ndarray, "points 2"]) -> Float[np.ndarray, "points 2"]:
    """Points in the frame of the body as points of the world [m]."""
    x, y, yaw = np.asarray(pose, float)
    cos, sin = math.cos(yaw), math.sin(yaw)
    return points @ np.array([[cos, sin], [-sin, cos]]) + [x, y]


def _box(row: Float[np.ndarray, "5"]) -> Polygon:
    corners = np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]]) * row[3:]
    return Polygon(_to_world(row[:3], corners), closed=True)


def _figure(extent: Float[np.ndarray, "2"], dpi: float) -> tuple[Figure, Axes, Axes]:
    """A figure of axes for a floor and of a strip for words below, as many metres long; its sides are even dots."""
    length, width = np.asarray(extent, float) + 2 * MARGIN
    across = 2 * round(WIDTH_INCHES * dpi / 2)
    floor = across * width / length
    down = 2 * math.ceil((floor + STRIP_INCHES * dpi) / 2)
    figure = Figure(figsize=(across / dpi, down / dpi), dpi=dpi)
    FigureCanvasAgg(figure)
    axes = figure.add_axes((0, 1 - floor / down, 1, floor / down))
    strip = figure.add_axes((0, 0, 1, 1 - floor / down))
    strip.set(xlim=(-length / 2, length / 2), ylim=(0, 1))
    strip.axis("off")
    return figure, axes, strip


def _draw_goal(axes: Axes, frame: Frame) -> None:
    x, y = np.asarray(frame.goal, float)
    axes.add_patch(Circle((x, y), frame.goal_radius, facecolor=GOAL + "33", edgecolor=GOAL, linewidth=1.2, zorder=2))
    axes.plot(x, y, marker="*", markersize=11, color=GOAL, markeredgewidth=0, zorder=3)


def _draw_course(axes: Axes, frame: Frame) -> None:
    """Draw what stays constant in an episode: the world, the goal, and the start, which is the frame's pose."""
    draw_world(axes, frame.world)
    _draw_goal(axes, frame)
    axes.plot(*frame.pose[:2], marker="o", markersize=6, color="white", markeredgecolor=START, zorder=3)


def _draw_strip(strip: Axes, world: World, shown: Sequence[str] = ("start", "goal", "lidar", CHOSEN)) -> None:
    """The key to the signs that are shown, and a scale."""
    length = 2.0 if float(world.extent[0]) > 12.0 else 1.0
    right = float(world.extent[0]) / 2
    strip.plot([right - length, right], [0.3, 0.3], color=INK, linewidth=2, solid_capstyle="butt")
    strip.text(right - length / 2, 0.42, f"{length:g} m", ha="center", va="bottom", fontsize=8, color=INK)
    arrow = {"marker": r"$\rightarrow$", "color": ARROW, "markersize": 13, "markeredgewidth": 0}
    signs = {
        "start": {"marker": "o", "color": "white", "markeredgecolor": START, "markersize": 6},
        "goal": {"marker": "*", "color": GOAL, "markeredgewidth": 0, "markersize": 11},
        "lidar": {"marker": "o", "color": HITS, "markersize": 3},
        CHOSEN: arrow,
        ASKED: arrow,
    }
    handles = [Line2D([], [], linestyle="none", label=name, **signs[name]) for name in shown]
    place = 0.98 - (length + MARGIN) / (float(world.extent[0]) + 2 * MARGIN)
    look: dict[str, Any] = {"frameon": False, "borderpad": 0, "handletextpad": 0.1, "columnspacing": 0.9}
    strip.legend(
        handles=handles, loc="center right", bbox_to_anchor=(place, 0.5), ncols=len(handles), fontsize=7.5, **look
    )


def _caption(strip: Axes, animated: bool = False) -> Any:
    left = strip.get_xlim()[0] + MARGIN
    return strip.text(left, 0.5, "", va="center_baseline", fontsize=9, animated=animated)


class _Body:
    """The artists of the robot, which can be moved: its outline, and a chevron that points ahead."""

    def __init__(
        self, axes: Axes, robot: Robot, *, colour: str = BODY, alpha: float = 1.0, animated: bool = False
    ) -> None:
        self.robot = robot
        look: dict[str, Any] = {"animated": animated, "alpha": alpha, "closed": True, "zorder": 6 if alpha == 1 else 5}
        body = Polygon(np.zeros((3, 2)), facecolor=colour, edgecolor="white", linewidth=0.8, **look)
        self.artists = (body, Polygon(np.zeros((3, 2)), facecolor="white", edgecolor="none", **look))
        for artist in self.artists:
            axes.add_patch(artist)

    def place(self, pose: Float[np.ndarray, "3"]) -> None:
        """Move it to a pose [m, rad]."""
        for artist, points in zip(self.artists, hull(self.robot), strict=True):
            artist.set_xy(_to_world(pose, points))


class _Lidar:
    """The artists of one scan, which can be moved: the space that it found free, and dots where beams met something."""

    def __init__(self, axes: Axes, *, animated: bool = False) -> None:
        self.free = Polygon(np.zeros((3, 2)), facecolor=BEAMS, alpha=0.22, edgecolor="none", zorder=2)
        axes.add_patch(self.free)
        (self.dots,) = axes.plot([], [], linestyle="none", marker="o", markersize=1.8, color=HITS, zorder=4)
        self.artists = (self.free, self.dots)
        for artist in self.artists:
            artist.set_animated(animated)

    def place(self, frame: Frame) -> None:
        """Move it to what a frame saw."""
        ends = hits(frame)
        met = np.asarray(frame.ranges) < 0.999 * frame.max_range
        self.free.set_xy(np.concatenate([[frame.pose[:2]], ends]))
        self.dots.set_data(*ends[met].T)


def _arrow(axes: Axes, animated: bool = False) -> FancyArrowPatch:
    return canvas.arrow(axes, ARROW, 13, canvas.edged(3.6, "#000000aa"), animated)


def _arrow_ends(frame: Frame) -> tuple[tuple[float, float], tuple[float, float]]:
    """Beside the body, along the direction that was chosen [m]."""
    (x0, y0), (x1, y1) = _to_world(frame.pose, np.outer(ARROW_REACH, frame.action))
    return (x0, y0), (x1, y1)


def _way(episode: Sequence[Frame]) -> Float[np.ndarray, "poses 3"]:
    """The poses of an episode, those before its steps and the last one's end [m, rad]."""
    return np.stack([frame.pose for frame in episode] + [episode[-1].next_pose])


def _spread(way: Float[np.ndarray, "poses 3"], middle: Float[np.ndarray, "3"]) -> list[np.ndarray]:
    """Poses to show as ghosts: apart from each other, from the one in the middle and from the last."""
    chosen: list[np.ndarray] = []
    for pose in way:
        others = np.stack([*chosen, middle, way[-1]])
        if np.linalg.norm(others[:, :2] - pose[:2], axis=-1).min() >= GHOSTS_APART:
            chosen.append(pose)
    return chosen


class _Stage:
    """One episode's figure. Constant parts are drawn once; each picture draws only what moves."""

    def __init__(self, robot: Robot, first: Frame, extent: Float[np.ndarray, "2"]) -> None:
        self.figure, axes, strip = _figure(extent, dpi=100)
        _draw_course(axes, first)
        _draw_strip(strip, first.world)
        self.lidar, self.arrow = _Lidar(axes, animated=True), _arrow(axes, animated=True)
        self.body, self.crashed = (_Body(axes, robot, colour=colour, animated=True) for colour in (BODY, CRASH))
        (self.trail,) = axes.plot([], [], color=BODY, linewidth=1.6, zorder=4, animated=True)
        self.caption = _caption(strip, animated=True)
        self.over = canvas.Backdrop(self.figure)

    def step(self, frame: Frame, way: Float[np.ndarray, "poses 3"], words: str) -> UInt8[np.ndarray, "height width 3"]:
        """Draw what the robot sees and chooses before a step, and the path so far."""
        self.lidar.place(frame)
        self.body.place(frame.pose)
        self.arrow.set_positions(*_arrow_ends(frame))
        return self._picture(way, words, INK, *self.lidar.artists, self.trail, *self.body.artists, self.arrow)

    def end(self, last: Frame, way: Float[np.ndarray, "poses 3"]) -> UInt8[np.ndarray, "height width 3"]:
        """Draw where an episode ended, and how."""
        body = self.crashed if last.outcome in ("collision", "fall") else self.body
        body.place(last.next_pose)
        words = f"{WORDS[last.outcome]} {last.seconds:.1f} s"
        return self._picture(way, words, OUTCOMES.get(last.outcome, INK), self.trail, *body.artists)

    def _picture(self, way: np.ndarray, words: str, colour: str, *artists: Any) -> UInt8[np.ndarray, "height width 3"]:
        self.trail.set_data(*way[:, :2].T)
        self.caption.set(text=words, color=colour)
        return self.over.picture(*artists, self.caption)


def _extent(frames: Sequence[Frame]) -> Float[np.ndarray, "2"]:
    """Return the extent of the largest world [m]."""
    return np.max([np.asarray(frame.world.extent) for frame in frames], axis=0)


def _pictures(robot: Robot, frames: Sequence[Frame], hold: int) -> Iterator[UInt8[np.ndarray, "height width 3"]]:
    """Yield one picture per step, and the end of each finished episode for `hold`."""
    extent = _extent(frames)
    for number, group in itertools.groupby(frames, key=lambda frame: frame.episode):
        episode = list(group)
        stage, way = _Stage(robot, episode[0], extent), _way(episode)
        seconds = 0.0
        for taken, frame in enumerate(episode):
            yield stage.step(frame, way[: taken + 1], f"episode {number + 1}: {seconds:.1f} s")
            seconds = frame.seconds
        if episode[-1].outcome:
            yield from itertools.repeat(stage.end(episode[-1], way), hold)


def _specimen(robot: Robot, frames: Sequence[Frame]) -> UInt8[np.ndarray, "height width 3"]:
    """A picture that has every colour of a film: a step, and each end, one below the other."""
    first = frames[0]
    stage, way = _Stage(robot, first, _extent(frames)), _way(frames[:1])
    ends = [stage.end(first._replace(outcome=outcome), way) for outcome in OUTCOMES]
    return np.concatenate([stage.step(first, way, ""), *ends])
