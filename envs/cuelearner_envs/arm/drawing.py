"""Drawing the arm: what a camera over the robot's shoulder sees, in perspective. Needs no OpenGL.

Solids are convex polygons, painted from the farthest to the nearest.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, UInt8
from PIL import Image, ImageDraw
from scipy.spatial.transform import Rotation

from cuelearner_envs.arm import model as arm

Picture = UInt8[np.ndarray, "height width 3"]
Face = Float[np.ndarray, "_ 3"]
Colour = Sequence[int]
SIZE = (480, 360)  # width and height [pixels]
FINER = 2  # the picture is drawn this many times larger and averaged down
AZIMUTH, ELEVATION, DISTANCE = math.radians(28.0), math.radians(-45.0), 0.98  # [rad, rad, m]
LOOK_AT = np.array([1.34, 0.75, 0.47])  # [m]
FOCAL = 1.6 * SIZE[1] * FINER  # [fine pixels]
BACKGROUND, TABLE, EDGE, SHADOW = (236, 240, 243), (214, 205, 190), (170, 160, 145), (178, 169, 154)
CUBE, POST, STEEL, PALM = (214, 96, 60), (70, 95, 150), (95, 100, 108), (60, 64, 72)
GOAL, ARROW = (0, 158, 115), (0, 114, 178)
LOWEST = 0.3  # of the table's sides that are drawn [m]
LEFT, RIGHT, NEAR, FAR = 1.1, 0.4, 1.05, 1.55  # the table's top: y, y, x, x [m]
GOAL_RADIUS = 0.018  # [m]
LIGHT = np.array([-0.35, 0.3, 0.88]) / np.linalg.norm([-0.35, 0.3, 0.88])

# The camera's axes: along its view, to the right, up; and where it stands [m].
_SIGHT = np.array(
    [math.cos(ELEVATION) * math.cos(AZIMUTH), math.cos(ELEVATION) * math.sin(AZIMUTH), math.sin(ELEVATION)]
)
_RIGHT = np.array([math.sin(AZIMUTH), -math.cos(AZIMUTH), 0.0])
_UP = np.cross(_RIGHT, _SIGHT)
_EYE = LOOK_AT - DISTANCE * _SIGHT


class Scene(NamedTuple):
    """The positions to draw [m]."""

    gripper: Float[np.ndarray, "3"]
    fingers: Float[np.ndarray, "2"]  # how far each is open
    goal: Float[np.ndarray, "3"]
    cube: Float[np.ndarray, "7"] | None  # place and quaternion (w, x, y, z); None: there is none
    has_post: bool
    action: Float[np.ndarray, "4"] | None = None  # in question; None: no arrow


def points() -> tuple[tuple[float, float] | None, ...]:
    """Return which way more of each cue points in these pictures (`Sketch.points`)."""
    sight, rise = (math.cos(AZIMUTH), math.sin(AZIMUTH)), math.sin(-ELEVATION)
    return (sight[1], -sight[0] * rise), (-sight[0], -sight[1] * rise), (0.0, -1.0), None


def draw(scene: Scene) -> Picture:
    """Return a picture of a scene."""
    image = Image.new("RGB", (SIZE[0] * FINER, SIZE[1] * FINER), BACKGROUND)
    brush = ImageDraw.Draw(image)
    for face, colour in _ground(scene):
        brush.polygon(_flat(face), fill=tuple(colour))
    faces = []
    for face, colour in _solids(scene):
        normal, off = np.cross(face[1] - face[0], face[2] - face[1]), face.mean(0) - _EYE
        normal /= max(float(np.linalg.norm(normal)), 1e-12)
        if normal @ off < 0:
            faces.append((float(off @ _SIGHT), face, _times(0.62 + 0.38 * max(float(normal @ LIGHT), 0.0), colour)))
    for _, face, colour in sorted(faces, key=lambda one: -one[0]):
        brush.polygon(_flat(face), fill=colour, outline=_times(0.75, colour))
    _draw_goal(brush, scene.goal)
    if scene.action is not None:
        _draw_action(brush, scene.gripper, np.asarray(scene.action, float))
    return np.asarray(image.resize(SIZE, Image.Resampling.LANCZOS))


def _flat(places: np.ndarray) -> list[tuple[float, float]]:
    """Return the picture positions of points (n, 3) [fine pixels]."""
    off = np.asarray(places, float) - _EYE
    scale = FOCAL / np.maximum(off @ _SIGHT, 0.05)
    x, y = SIZE[0] * FINER / 2 + scale * (off @ _RIGHT), SIZE[1] * FINER / 2 - scale * (off @ _UP)
    return list(zip(x.tolist(), y.tolist(), strict=True))


def _times(share: float, colour: Colour) -> tuple[int, ...]:
    return tuple(round(share * part) for part in colour)


def _ground(scene: Scene) -> Iterator[tuple[Face, Colour]]:
    """Yield the table, and the shadows of gripper, goal and cube on it."""
    corners = np.array(
        [(x, y, z) for z in (LOWEST, arm.TABLE) for x, y in ((NEAR, LEFT), (NEAR, RIGHT), (FAR, RIGHT), (FAR, LEFT))]
    )
    yield corners[[5, 1, 0, 4]], EDGE
    yield corners[[5, 6, 2, 1]], EDGE
    yield corners[4:], TABLE
    yield _ring(scene.gripper, 0.02), SHADOW
    yield _ring(scene.goal, GOAL_RADIUS), [(one + other) // 2 for one, other in zip(GOAL, TABLE, strict=True)]
    if scene.cube is not None:
        yield _ring(scene.cube, 1.25 * arm.CUBE), SHADOW


def _ring(place: Sequence[float] | np.ndarray, radius: float, height: float = arm.TABLE, sides: int = 24) -> Face:
    turns = np.linspace(0, 2 * np.pi, sides, endpoint=False)
    x, y = place[0] + radius * np.cos(turns), place[1] + radius * np.sin(turns)
    return np.stack([x, y, np.full_like(x, height)], -1)


def _solids(scene: Scene) -> Iterator[tuple[Face, Colour]]:
    gripper, opened = np.asarray(scene.gripper, float), [float(one) for one in scene.fingers]
    radius, rise = arm.FINGER_RADIUS, 0.03 - arm.TIP / 2
    half = (arm.FINGER_HALF_WIDTH, radius, 0.03 + arm.TIP / 2)
    boxes: list[tuple[np.ndarray, Sequence[float], np.ndarray | None, Colour]] = [
        (np.add(gripper, [0.0, radius + opened[0], rise]), half, None, STEEL),
        (np.add(gripper, [0.0, -radius - opened[1], rise]), half, None, STEEL),
        (np.add(gripper, [0.0, 0.0, 0.075]), (0.014, 0.02 + max(opened), 0.01), None, PALM),
        (np.add(gripper, [0.0, 0.0, 0.12]), (0.01, 0.01, 0.03), None, STEEL),
    ]
    if scene.cube is not None:
        cube = np.asarray(scene.cube, float)
        turn = Rotation.from_quat(np.roll(cube[3:], -1)).as_matrix()
        boxes.append((cube[:3], (arm.CUBE,) * 3, turn, CUBE))
    for middle, sizes, turn, colour in boxes:
        yield from ((face, colour) for face in _box(middle, sizes, turn))
    if scene.has_post:
        low, high = (_ring(arm.POST_PLACE, arm.POST_RADIUS, z, 14) for z in (arm.TABLE, arm.TABLE + arm.POST_HEIGHT))
        yield from ((np.stack([low[k], low[k - 13], high[k - 13], high[k]]), POST) for k in range(14))
        yield high, POST


def _box(middle: np.ndarray, half: Sequence[float], turn: np.ndarray | None) -> Iterator[Face]:
    """Yield the six faces of a box, corners counterclockwise as seen from outside."""
    for axis in range(3):
        for way in (1, -1):
            corners = np.zeros((4, 3))
            corners[:, axis] = way * half[axis]
            corners[:, (axis + 1) % 3] = np.array([1, -1, -1, 1])[::way] * half[(axis + 1) % 3]
            corners[:, (axis + 2) % 3] = np.array([1, 1, -1, -1])[::way] * half[(axis + 2) % 3]
            yield middle + (corners if turn is None else corners @ turn.T)


def _draw_goal(brush: ImageDraw.ImageDraw, goal: np.ndarray) -> None:
    """Draw the goal as a ring with a line down to the table, over all solids, so that it is never hidden."""
    (x, y), (_, below) = _flat(np.array([goal, [goal[0], goal[1], arm.TABLE]]))
    radius = FOCAL * GOAL_RADIUS / float((goal - _EYE) @ _SIGHT)
    if below - y > radius:
        brush.line([(x, y + radius), (x, below)], fill=GOAL, width=FINER)
    brush.circle((x, y), radius, outline=GOAL, width=2 * FINER)


def _draw_action(brush: ImageDraw.ImageDraw, gripper: np.ndarray, action: np.ndarray) -> None:
    """Draw an arrow from the gripper, twice as long as the action's step; a ring for hardly any step."""
    start, end = (np.array(one) for one in _flat(np.stack([gripper, gripper + 0.1 * action[:3]])))
    length = float(np.hypot(*(end - start)))
    if length <= 4 * FINER:
        brush.circle(tuple(start), 5 * FINER, outline=ARROW, width=2 * FINER)
        return
    ahead, head = (end - start) / length, min(12.0 * FINER, 0.5 * length)
    neck, aside = end - head * ahead, 0.5 * head * np.array([-ahead[1], ahead[0]])
    brush.line([tuple(start), tuple(neck)], fill=ARROW, width=4 * FINER)
    brush.polygon([tuple(end), tuple(neck + aside), tuple(neck - aside)], fill=ARROW)
