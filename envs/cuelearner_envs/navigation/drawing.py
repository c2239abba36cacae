"""Drawing navigation from above with matplotlib: an episode, a question, an animation. Needs no display.

Lengths are metres; the axes of every drawing are the world's own coordinates. Files end in .png, .svg or .pdf, and
pictures are 7 inches wide.
"""

from __future__ import annotations

import itertools
import math
import os
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
from jaxtyping import Float, UInt8
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import to_hex, to_rgb
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Circle, Polygon, Rectangle

from cuelearner_envs import canvas
from cuelearner_envs.navigation.lidar import BEAM_ANGLES
from cuelearner_envs.navigation.recording import RecordedStep
from cuelearner_envs.navigation.robot import Robot, hull
from cuelearner_envs.navigation.world import corners, from_frame, solids_of, tallness
from cuelearner_jax import pictures

# Okabe and Ito's palette, as in the figures of results: told apart with any colour vision.
BODY, GOAL, CRASH, ARROW, BEAMS, HITS = "#0072B2", "#009E73", "#D55E00", "#E69F00", "#56B4E9", "#CC79A7"
START, INK = "#000000", "#333333"
ENDINGS = {  # words and colours
    "success": ("reached the goal after", GOAL),
    "collision": ("collision after", CRASH),
    "fall": ("fell after", CRASH),
    "timeout": ("out of time after", INK),
}
CHOICE, QUESTION = "direction chosen", "direction in question"  # what an arrow means
COURSE = ("start", "goal", "lidar", CHOICE)
FLOOR, LOW, TALL = "#fbfaf7", "#c9ccd1", "#5d636b"
WIDTH_INCHES, STRIP_INCHES, MARGIN = 7.0, 0.4, 0.35  # the strip below the floor is for words; margin in [m]
ARROW_REACH = (0.55, 1.6)  # beginning and end of an arrow, from the middle of the body [m]
GHOSTS_APART = 1.4  # between the bodies of a still [m]
HOLD_AFTER = 1.2  # at the end of an animated episode [s]
Picture = UInt8[np.ndarray, "height width 3"]


def still(robot: Robot, frames: Sequence[RecordedStep], file: str | os.PathLike[str]) -> None:
    """Write a picture of the first episode: its way, and halfway what the lidar saw and what was chosen."""
    episode = [frame for frame in frames if frame.episode == frames[0].episode]
    middle, last, way = episode[len(episode) // 2], episode[-1], _way(episode)
    figure, axes, strip = _figure(episode[0], np.asarray(episode[0].world.extent), 160, COURSE)
    _lidar(axes, middle)
    axes.plot(*way[:, :2].T, color=BODY, linewidth=1.8, zorder=4)
    ghosts = [middle.pose, way[-1]]
    for pose in way:
        if np.linalg.norm(np.stack(ghosts)[:, :2] - pose[:2], axis=-1).min() >= GHOSTS_APART:
            ghosts.append(pose)
            _body(axes, robot, pose, alpha=0.35)
    _body(axes, robot, middle.pose)
    _body(axes, robot, last.next_pose, CRASH if last.outcome in ("collision", "fall") else BODY)
    _arrow(axes, middle)
    words, colour = ENDINGS.get(last.outcome, ("still walking after", INK))
    length = np.linalg.norm(np.diff(way[:, :2], axis=0), axis=-1).sum()
    _caption(strip, f"{words} {last.seconds:.1f} s, {length:.1f} m", colour)
    canvas.save(figure, file)


def question(robot: Robot, frame: RecordedStep, file: str | os.PathLike[str]) -> None:
    """Write a picture of one situation and of the direction in question as an arrow, for somebody to judge it."""
    figure, axes, strip = _figure(frame, np.asarray(frame.world.extent), 160, ("goal", "lidar", QUESTION))
    _lidar(axes, frame)
    _body(axes, robot, frame.pose)
    _arrow(axes, frame)
    _caption(strip, f"{np.linalg.norm(frame.goal - frame.pose[:2]):.1f} m from the goal")
    canvas.save(figure, file)


def animate(robot: Robot, frames: Sequence[RecordedStep], file: str | os.PathLike[str], fps: float = 10.0) -> None:
    """Write an animation (.gif or .mp4) of all episodes, one picture a step; the end of an episode stands for a moment.

    With steps of 0.2 s, 10 pictures a second show twice the speed of life.
    """
    # A picture that has every colour of the film: a step, and each end, one below the other.
    ends = [_film(robot, [frames[0]._replace(outcome=outcome)], frames, 1) for outcome in ENDINGS]
    specimen = np.concatenate([picture for film in ends for picture in film])
    palette = pictures.palette_of(specimen, 88, (BODY, GOAL, CRASH, ARROW, HITS, FLOOR, "#ffffff"))

    def film(rate: float) -> Iterator[Picture]:
        for _, episode in itertools.groupby(frames, key=lambda frame: frame.episode):
            yield from _film(robot, list(episode), frames, round(HOLD_AFTER * rate))

    pictures.write_film(file, fps, film, palette)


def shade(height: float) -> str:
    """Colour of a solid of some height [m], a hexadecimal code."""
    share = tallness(height)
    return to_hex((1 - share) * np.array(to_rgb(LOW)) + share * np.array(to_rgb(TALL)))  # pyright: ignore[reportArgumentType]


def _film(
    robot: Robot, episode: Sequence[RecordedStep], frames: Sequence[RecordedStep], hold: int
) -> Iterator[Picture]:
    """Yield one picture per step of an episode, and its end `hold` times; constant parts are drawn once."""
    extent = np.max([np.asarray(frame.world.extent) for frame in frames], axis=0)  # of the largest world
    figure, axes, strip = _figure(episode[0], extent, 100, COURSE)
    over, way, last, seconds = canvas.Backdrop(figure), _way(episode), episode[-1], 0.0

    def trail(steps: int) -> list[Line2D]:
        return axes.plot(*way[: steps + 1, :2].T, color=BODY, linewidth=1.6)

    for number, frame in enumerate(episode):
        moving = [*_lidar(axes, frame), *trail(number), *_body(axes, robot, frame.pose), _arrow(axes, frame)]
        yield over.picture(*moving, _caption(strip, f"episode {frame.episode + 1}: {seconds:.1f} s"))
        seconds = frame.seconds
    if last.outcome:
        body = _body(axes, robot, last.next_pose, CRASH if last.outcome in ("collision", "fall") else BODY)
        words, colour = ENDINGS[last.outcome]
        caption = _caption(strip, f"{words} {last.seconds:.1f} s", colour)
        yield from itertools.repeat(over.picture(*trail(len(episode)), *body, caption), hold)


def _way(episode: Sequence[RecordedStep]) -> Float[np.ndarray, "poses 3"]:
    """The poses of an episode, those before its steps and the last one's end [m, rad]."""
    return np.stack([frame.pose for frame in episode] + [episode[-1].next_pose])


def _figure(
    first: RecordedStep, extent: Float[np.ndarray, "2"], dpi: float, parts: Sequence[str]
) -> tuple[Figure, Axes, Axes]:
    """A figure of axes for a floor and of a strip for words below, as many metres long; its sides are even dots.

    Drawn is what stays constant in an episode: solids, the taller the darker, goal, start, and the key to signs.
    """
    length, width = np.asarray(extent, float) + 2 * MARGIN
    across = 2 * round(WIDTH_INCHES * dpi / 2)
    floor = across * width / length
    down = 2 * math.ceil((floor + STRIP_INCHES * dpi) / 2)
    figure = Figure(figsize=(across / dpi, down / dpi), dpi=dpi)
    FigureCanvasAgg(figure)
    axes = figure.add_axes((0, 1 - floor / down, 1, floor / down))
    strip = figure.add_axes((0, 0, 1, 1 - floor / down))
    world, half = first.world, np.asarray(first.world.extent, float) / 2
    axes.set(xlim=(-half[0] - MARGIN, half[0] + MARGIN), ylim=(-half[1] - MARGIN, half[1] + MARGIN), aspect="equal")
    axes.add_patch(Rectangle((-half[0], -half[1]), *(2 * half), facecolor=FLOOR, edgecolor="none", zorder=0))
    for row, height in solids_of(world):
        patch = Polygon(corners(row)) if len(row) == 5 else Circle((row[0], row[1]), row[2])
        patch.set(facecolor=shade(height), edgecolor="none", zorder=1)
        axes.add_patch(patch)
    x, y = np.asarray(first.goal, float)
    ring = {"facecolor": GOAL + "33", "edgecolor": GOAL, "linewidth": 1.2, "zorder": 2}
    axes.add_patch(Circle((x, y), float(first.goal_radius), **ring))
    axes.plot(x, y, marker="*", markersize=11, color=GOAL, markeredgewidth=0, zorder=3)
    if "start" in parts:
        axes.plot(*first.pose[:2], marker="o", markersize=6, color="white", markeredgecolor=START, zorder=3)
    strip.set(xlim=(-length / 2, length / 2), ylim=(0, 1))
    _draw_strip(strip, 2 * float(half[0]), parts)
    for one in (axes, strip):
        one.axis("off")
    return figure, axes, strip


def _draw_strip(strip: Axes, extent: float, parts: Sequence[str]) -> None:
    """The key to the signs that are shown, and a scale."""
    length, right = 2.0 if extent > 12.0 else 1.0, extent / 2
    strip.plot([right - length, right], [0.3, 0.3], color=INK, linewidth=2, solid_capstyle="butt")
    strip.text(right - length / 2, 0.42, f"{length:g} m", ha="center", va="bottom", fontsize=8, color=INK)
    arrow = {"marker": r"$\rightarrow$", "color": ARROW, "markersize": 13, "markeredgewidth": 0}
    signs = {
        "start": {"marker": "o", "color": "white", "markeredgecolor": START, "markersize": 6},
        "goal": {"marker": "*", "color": GOAL, "markeredgewidth": 0, "markersize": 11},
        "lidar": {"marker": "o", "color": HITS, "markersize": 3},
    }
    handles = [Line2D([], [], linestyle="none", label=name, **signs.get(name, arrow)) for name in parts]
    place = 0.98 - (length + MARGIN) / (extent + 2 * MARGIN), 0.5
    look: dict[str, Any] = {"frameon": False, "borderpad": 0, "handletextpad": 0.1, "columnspacing": 0.9}
    strip.legend(handles=handles, loc="center right", bbox_to_anchor=place, ncols=len(handles), fontsize=7.5, **look)


def _caption(strip: Axes, words: str, colour: str = INK) -> Artist:
    return strip.text(strip.get_xlim()[0] + MARGIN, 0.5, words, color=colour, va="center_baseline", fontsize=9)


def _body(axes: Axes, robot: Robot, pose: np.ndarray, colour: str = BODY, alpha: float = 1.0) -> list[Artist]:
    """Add the robot: its outline, and a chevron that points ahead."""
    looks = {"facecolor": colour, "edgecolor": "white", "linewidth": 0.8}, {"facecolor": "white", "edgecolor": "none"}
    rest: dict[str, Any] = {"alpha": alpha, "zorder": 6 if alpha == 1 else 5}
    shapes = zip(hull(robot), looks, strict=True)
    return [axes.add_patch(Polygon(from_frame(pose, points), **look, **rest)) for points, look in shapes]


def _lidar(axes: Axes, frame: RecordedStep) -> list[Artist]:
    """Add one scan, as the robot takes it: the space that it found free, and dots where beams met something."""
    angles = np.asarray(BEAM_ANGLES, float)
    beams = np.stack([np.cos(angles), np.sin(angles)], axis=-1)
    ends = from_frame(frame.pose, np.asarray(frame.ranges)[:, None] * beams)
    hits = np.asarray(frame.ranges) < 0.999 * frame.max_range
    free = Polygon(np.concatenate([[frame.pose[:2]], ends]), facecolor=BEAMS, alpha=0.22, edgecolor="none", zorder=2)
    dots = axes.plot(*ends[hits].T, linestyle="none", marker="o", markersize=1.8, color=HITS, zorder=4)
    return [axes.add_patch(free), *dots]


def _arrow(axes: Axes, frame: RecordedStep) -> Artist:
    """Add an arrow beside the body, along the direction that was chosen."""
    ends = from_frame(frame.pose, np.outer(ARROW_REACH, frame.action))
    return canvas.arrow(axes, ends, ARROW, 13, canvas.edged(3.6, "#000000aa"))
