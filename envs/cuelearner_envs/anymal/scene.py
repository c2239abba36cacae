"""Pictures of the quadruped in its world, from above and from the side, rendered by MuJoCo off screen.

Rendering needs OpenGL: a driver of the machine's, or Mesa's in software.
"""

# pyright: reportAttributeAccessIssue=false
# (MuJoCo's compiled module has no stubs)

from __future__ import annotations

import importlib
import os
from types import TracebackType
from typing import Any

import mujoco
import numpy as np
from jaxtyping import Bool, Float, UInt8

from cuelearner_envs.anymal import model as robot
from cuelearner_envs.navigation.world import NavigationWorld, solids_of, tallness
from cuelearner_jax.errors import UserError

Picture = UInt8[np.ndarray, "height width 3"]
LOW, TALL, GOAL = (0.79, 0.8, 0.82, 1), (0.36, 0.39, 0.42, 1), (0.0, 0.62, 0.45, 0.55)
BEAM, HIT = (0.34, 0.71, 0.91, 0.16), (0.8, 0.47, 0.65, 1)
AZIMUTH, SIDES_APART = 130, 30  # side from which the robot is seen, and spacing of the other sides tried [deg]
BEAMS_APART = 3  # every so many-th beam is drawn
NO_OPENGL = (
    "MuJoCo can't render here ({}): install OpenGL for EGL (apt-get install libegl1 libgl1-mesa-dri), "
    "or OSMesa (libosmesa6) and set MUJOCO_GL=osmesa"
)


def furnish(world: NavigationWorld, goal: Float[np.ndarray, "2"], goal_radius: float) -> mujoco.MjModel:
    """Return the robot's model with a world's solids and the goal, for drawing only."""
    spec = mujoco.MjSpec.from_file(str(robot.FILE))
    look: dict[str, Any] = {"contype": 0, "conaffinity": 0}
    box, disc = mujoco.mjtGeom.mjGEOM_BOX, mujoco.mjtGeom.mjGEOM_CYLINDER
    for (x, y, *shape), height in solids_of(world):
        yaw, *sides = shape if len(shape) == 3 else (0.0, *shape)
        kind, size = (box, [*sides, height / 2]) if len(sides) == 2 else (disc, [*sides, height / 2, 0])
        place, turn = [x, y, height / 2], [np.cos(yaw / 2), 0, 0, np.sin(yaw / 2)]
        spec.worldbody.add_geom(type=kind, pos=place, quat=turn, size=size, rgba=_shade(height), **look)
    spec.worldbody.add_geom(type=disc, pos=[*goal, 0.01], size=[goal_radius, 0.01, 0], rgba=GOAL, **look)
    return spec.compile()


class Studio:
    """Renders a model from several sides. Used as a context: the graphics memory is given back at its end."""

    def __init__(self, model: mujoco.MjModel, width: int, height: int):
        """Prepare pictures of `width` by `height` pixels. Raises UserError where OpenGL is missing."""
        self.model, self.data = model, mujoco.MjData(model)
        self.size = width, height
        try:
            self._gl = _gl_context()(width, height)
            self._gl.make_current()
            self._context = mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_100)
        except Exception as error:  # the exception type depends on what is missing: library, display or driver
            raise UserError(NO_OPENGL.format(str(error).strip().split("\n")[0][:80] or type(error).__name__)) from error
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN, self._context)
        self._scene = mujoco.MjvScene(model, maxgeom=4000)
        self._scene.flags[mujoco.mjtRndFlag.mjRND_REFLECTION] = 0

    def __enter__(self) -> Studio:
        return self

    def __exit__(self, *_: type[BaseException] | BaseException | TracebackType | None) -> None:
        self._context.free()
        self._gl.free()

    def pose(self, qpos: Float[np.ndarray, " qpos"]) -> None:
        """Put the model into a configuration."""
        self.data.qpos[:] = qpos
        mujoco.mj_forward(self.model, self.data)

    def picture(
        self,
        camera: mujoco.MjvCamera,
        ends: Float[np.ndarray, "beams 3"] | None = None,
        hits: Bool[np.ndarray, " beams"] | None = None,
    ) -> Picture:
        """Render a camera's view, with the lidar's beams up to their ends [m] and dots at their hits."""
        option, every = mujoco.MjvOption(), mujoco.mjtCatBit.mjCAT_ALL
        mujoco.mjv_updateScene(self.model, self.data, option, None, camera, every, self._scene)
        if ends is not None and hits is not None:
            self._draw(ends, hits)
        rectangle = mujoco.MjrRect(0, 0, *self.size)
        mujoco.mjr_render(rectangle, self._scene, self._context)
        picture = np.empty((self.size[1], self.size[0], 3), np.uint8)
        mujoco.mjr_readPixels(picture, None, rectangle, self._context)
        return picture[::-1]

    def _draw(self, ends: Float[np.ndarray, "beams 3"], hits: Bool[np.ndarray, " beams"]) -> None:
        origin = np.asarray(self.data.site("lidar").xpos)
        line, ball = mujoco.mjtGeom.mjGEOM_LINE, mujoco.mjtGeom.mjGEOM_SPHERE
        for number, end in enumerate(np.asarray(ends, float)):
            if number % BEAMS_APART == 0:
                mujoco.mjv_connector(self._added(line, BEAM), line, 1.0, origin, end)
            if hits[number]:
                self._added(ball, HIT, end)

    def _added(self, kind: Any, colour: tuple, place: np.ndarray | None = None) -> Any:
        """Add a shape to the scene, of 25 mm if it has a size."""
        geom = self._scene.geoms[self._scene.ngeom]
        at, size = np.zeros(3) if place is None else place, np.full(3, 0.025)
        mujoco.mjv_initGeom(geom, kind, size, at, np.eye(3).ravel(), np.asarray(colour, np.float32))
        self._scene.ngeom += 1
        return geom


def above(extent: Float[np.ndarray, "2"]) -> mujoco.MjvCamera:
    """Return a camera that looks down on the whole hall, x to the right."""
    camera = mujoco.MjvCamera()
    camera.lookat[:], camera.azimuth, camera.elevation = (0, 0, 0), 90, -90
    camera.distance = 1.3 * float(np.max(extent))
    return camera


def unobstructed(
    model: mujoco.MjModel, data: mujoco.MjData, azimuth: float = AZIMUTH, distance: float = 3.2
) -> mujoco.MjvCamera:
    """Return a camera at the side nearest to `azimuth` without a solid in between [deg, m]."""
    cameras = []
    for turn in sorted(range(-180, 180, SIDES_APART), key=abs):
        cameras.append(camera := mujoco.MjvCamera())
        camera.lookat[:] = data.qpos[0], data.qpos[1], 0.35
        camera.azimuth, camera.elevation, camera.distance = azimuth + turn, -22, distance
    return next((camera for camera in cameras if _sees(model, data, camera)), cameras[0])


def _sees(model: mujoco.MjModel, data: mujoco.MjData, camera: mujoco.MjvCamera) -> bool:
    """Whether no solid lies between a camera and its target."""
    azimuth, elevation = np.radians([camera.azimuth, camera.elevation])
    ahead = np.array([np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)])
    hit = np.full(1, -1, np.int32)
    away = mujoco.mj_ray(model, data, camera.lookat - camera.distance * ahead, ahead, None, 1, -1, hit)
    return not (0 <= away < camera.distance and model.geom_bodyid[hit[0]] == 0)


def _gl_context() -> Any:
    """Return MuJoCo's OpenGL context class: EGL, which needs no display, unless MUJOCO_GL names another."""
    own = os.environ.get("MUJOCO_GL", "").lower()
    name = own if own in ("egl", "osmesa", "glfw") else "egl"
    if name != "glfw":
        os.environ.setdefault("PYOPENGL_PLATFORM", name)
    return importlib.import_module(f"mujoco.{name}").GLContext


def _shade(height: float) -> list[float]:
    """Return a grey level, darker for taller solids."""
    share = tallness(height)
    return [float((1 - share) * low + share * tall) for low, tall in zip(LOW, TALL, strict=True)]
