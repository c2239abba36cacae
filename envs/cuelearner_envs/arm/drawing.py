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
Faces = list[Float[np.ndarray, "corners 3"]]
SIZE = (480, 360)  # width and height [pixels]
FINER = 2  # the picture is drawn this many times larger and averaged down
AZIMUTH, ELEVATION, DISTANCE = math.radians(28.0), math.radians(-45.0), 0.98  # [rad, rad, m]
LOOK_AT = np.array([1.34, 0.75, 0.47])  # [m]
FOCAL = 1.6  # of the picture's height
BACKGROUND, TABLE, EDGE = (236, 240, 243), (214, 205, 190), (170, 160, 145)
CUBE, POST, STEEL, PALM, GOAL, SHADOW = (
    (214, 96, 60),
    (70, 95, 150),
    (95, 100, 108),
    (60, 64, 72),
    (0, 158, 115),
    (178, 169, 154),
)
ARROW = (0, 114, 178)
TABLE_BOX = (1.05, 1.55), (0.4, 1.1)  # x and y of the table's top [m]
GOAL_RADIUS = 0.018  # [m]
LIGHT = np.array([-0.35, 0.3, 0.88])


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
    width, height = SIZE[0] * FINER, SIZE[1] * FINER
    image = Image.new("RGB", (width, height), BACKGROUND)
    brush = ImageDraw.Draw(image)
    for face, colour in _ground(scene):
        brush.polygon(_flat(face), fill=colour)
    solids = [(face, _shaded(face, colour)) for faces, colour in _solids(scene) for face in faces if _faces_us(face)]
    solids.sort(key=lambda one: -_depth(one[0]))
    for face, colour in solids:
        brush.polygon(_flat(face), fill=colour, outline=_darker(colour))
    _draw_goal(brush, scene.goal)
    if scene.action is not None:
        _draw_action(brush, scene.gripper, scene.action)
    return np.asarray(image.resize(SIZE, Image.Resampling.LANCZOS))


def _axes() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the camera's axes: to the right, up, and along its view."""
    cos, sin = math.cos(ELEVATION), math.sin(ELEVATION)
    sight = np.array([cos * math.cos(AZIMUTH), cos * math.sin(AZIMUTH), sin])
    right = np.array([math.sin(AZIMUTH), -math.cos(AZIMUTH), 0.0])
    return right, np.cross(right, sight), sight


_RIGHT, _UP, _SIGHT = _axes()
_EYE = LOOK_AT - DISTANCE * _SIGHT


def _flat(places: np.ndarray) -> list[tuple[float, float]]:
    """Return the picture positions of points (n, 3) [fine pixels]."""
    off = np.asarray(places, float) - _EYE
    scale = FOCAL * SIZE[1] * FINER / np.maximum(off @ _SIGHT, 0.05)
    x = SIZE[0] * FINER / 2 + scale * (off @ _RIGHT)
    y = SIZE[1] * FINER / 2 - scale * (off @ _UP)
    return list(zip(x.tolist(), y.tolist(), strict=True))


def _depth(face: np.ndarray) -> float:
    return float((face.mean(0) - _EYE) @ _SIGHT)


def _normal(face: np.ndarray) -> np.ndarray:
    found = np.cross(face[1] - face[0], face[2] - face[1])
    return found / max(float(np.linalg.norm(found)), 1e-12)


def _faces_us(face: np.ndarray) -> bool:
    return float(_normal(face) @ (face.mean(0) - _EYE)) < 0


def _shaded(face: np.ndarray, colour: tuple[int, int, int]) -> tuple[int, int, int]:
    share = 0.62 + 0.38 * max(float(_normal(face) @ LIGHT) / float(np.linalg.norm(LIGHT)), 0.0)
    return tuple(round(share * part) for part in colour)  # pyright: ignore[reportReturnType]


def _darker(colour: tuple[int, int, int]) -> tuple[int, int, int]:
    return tuple(round(0.75 * part) for part in colour)  # pyright: ignore[reportReturnType]


def _ground(scene: Scene) -> Iterator[tuple[np.ndarray, tuple[int, int, int]]]:
    """Yield the table, and the shadows of goal, gripper, cube and post on it."""
    (x0, x1), (y0, y1) = TABLE_BOX
    low = [(x0, y1), (x0, y0), (x1, y0), (x1, y1)]
    yield np.array([(x0, y0, arm.TABLE), (x0, y0, 0.3), (x0, y1, 0.3), (x0, y1, arm.TABLE)]), EDGE
    yield np.array([(x0, y0, arm.TABLE), (x1, y0, arm.TABLE), (x1, y0, 0.3), (x0, y0, 0.3)]), EDGE
    yield np.array([(x, y, arm.TABLE) for x, y in low]), TABLE
    yield _disc(scene.gripper[:2], 0.02), SHADOW
    yield _disc(scene.goal[:2], GOAL_RADIUS), _mixed(GOAL, TABLE)
    if scene.cube is not None:
        yield _disc(scene.cube[:2], 1.25 * arm.CUBE), SHADOW


def _mixed(one: tuple[int, int, int], other: tuple[int, int, int]) -> tuple[int, int, int]:
    return tuple((a + b) // 2 for a, b in zip(one, other, strict=True))  # pyright: ignore[reportReturnType]


def _disc(place: Sequence[float] | np.ndarray, radius: float) -> np.ndarray:
    turns = np.linspace(0, 2 * np.pi, 24, endpoint=False)
    x, y = place[0] + radius * np.cos(turns), place[1] + radius * np.sin(turns)
    return np.stack([x, y, np.full_like(x, arm.TABLE)], -1)


def _solids(scene: Scene) -> Iterator[tuple[Faces, tuple[int, int, int]]]:
    gripper = np.asarray(scene.gripper, float)
    radius, wide = arm.FINGER_RADIUS, arm.FINGER_HALF_WIDTH
    for way, opening in ((1.0, float(scene.fingers[0])), (-1.0, float(scene.fingers[1]))):
        middle = gripper + np.array([0.0, way * (radius + opening), 0.03 - arm.TIP / 2])
        yield _box(middle, (wide, radius, 0.03 + arm.TIP / 2)), STEEL
    yield _box(gripper + np.array([0.0, 0.0, 0.075]), (0.014, 0.02 + float(np.max(scene.fingers)), 0.01)), PALM
    yield _box(gripper + np.array([0.0, 0.0, 0.12]), (0.01, 0.01, 0.03)), STEEL
    if scene.has_post:
        yield _column(), POST
    if scene.cube is not None:
        cube = np.asarray(scene.cube, float)
        yield _box(cube[:3], (arm.CUBE,) * 3, Rotation.from_quat(np.roll(cube[3:], -1)).as_matrix()), CUBE


def _box(middle: np.ndarray, half: Sequence[float], turn: np.ndarray | None = None) -> Faces:
    """Return the six faces of a box, corners counterclockwise as seen from outside."""
    faces, turn = [], np.eye(3) if turn is None else turn
    for axis in range(3):
        first, second = (axis + 1) % 3, (axis + 2) % 3
        for way in (1.0, -1.0):
            corners = np.zeros((4, 3))
            corners[:, axis] = way * half[axis]
            corners[:, first] = np.array([1, -1, -1, 1])[:: int(way)] * half[first]
            corners[:, second] = np.array([1, 1, -1, -1])[:: int(way)] * half[second]
            faces.append(middle + corners @ turn.T)
    return faces


def _column(sides: int = 14) -> Faces:
    """Return the post: a column of flat sides, and its top."""
    turns = np.linspace(0, 2 * np.pi, sides, endpoint=False)
    x, y = arm.POST_PLACE[0] + arm.POST_RADIUS * np.cos(turns), arm.POST_PLACE[1] + arm.POST_RADIUS * np.sin(turns)
    low, high = (np.stack([x, y, np.full(sides, z)], -1) for z in (arm.TABLE, arm.TABLE + arm.POST_HEIGHT))
    walls = [np.stack([low[k], low[k - sides + 1], high[k - sides + 1], high[k]]) for k in range(sides)]
    return [*walls, high]


def _draw_goal(brush: ImageDraw.ImageDraw, goal: np.ndarray) -> None:
    """Draw the goal as a ring with a line down to the table, over all solids, so that it is never hidden."""
    (x, y), (_, below) = _flat(np.array([goal, [goal[0], goal[1], arm.TABLE]]))
    radius = FOCAL * SIZE[1] * FINER * GOAL_RADIUS / float((goal - _EYE) @ _SIGHT)
    if below - y > radius:
        brush.line([(x, y + radius), (x, below)], fill=GOAL, width=FINER)
    brush.ellipse([x - radius, y - radius, x + radius, y + radius], outline=GOAL, width=2 * FINER)


def _draw_action(brush: ImageDraw.ImageDraw, gripper: np.ndarray, action: np.ndarray) -> None:
    """Draw an arrow from the gripper, twice as long as the action's step, and the fingers' motion."""
    action = np.asarray(action, float)
    start, end = (np.array(one) for one in _flat(np.stack([gripper, gripper + 0.1 * action[:3]])))
    way = end - start
    length = float(np.hypot(*way))
    if length > 4 * FINER:
        ahead, head = way / length, min(12.0 * FINER, 0.5 * length)
        aside = np.array([-ahead[1], ahead[0]])
        neck = end - head * ahead
        brush.line([tuple(start), tuple(neck)], fill=ARROW, width=4 * FINER)
        brush.polygon([tuple(end), tuple(neck + 0.5 * head * aside), tuple(neck - 0.5 * head * aside)], fill=ARROW)
    else:
        x, y = start
        brush.ellipse([x - 5 * FINER, y - 5 * FINER, x + 5 * FINER, y + 5 * FINER], outline=ARROW, width=2 * FINER)
