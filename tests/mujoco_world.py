"""This package's navigation worlds in MuJoCo, with a lidar of MuJoCo's rays, as an independent reference."""

# pyright: reportAttributeAccessIssue=false
# (MuJoCo's compiled module has no stubs)

from __future__ import annotations

import mujoco
import numpy as np

from cuelearner_envs.navigation.world import FAR_AWAY, NavigationWorld

LIDAR_HEIGHT = 0.5  # of the rays above the floor [m]: below the top of every solid
FIELD_OF_VIEW, BEAMS = np.deg2rad(270.0), 271
ANGLES = np.linspace(-FIELD_OF_VIEW / 2, FIELD_OF_VIEW / 2, BEAMS)  # from straight ahead [rad]


def model(world: NavigationWorld) -> mujoco.MjModel:
    """A static MuJoCo model of one world (no batch): boxes and upright cylinders, no rows that only fill up."""
    geoms = []
    for (x, y, yaw, length, width), height in _used(world.boxes, world.box_heights):
        size = f"{length!r} {width!r} {height / 2!r}"
        geoms.append(f'<geom type="box" pos="{x!r} {y!r} {height / 2!r}" euler="0 0 {yaw!r}" size="{size}"/>')
    for (x, y, radius), height in _used(world.circles, world.circle_heights):
        geoms.append(f'<geom type="cylinder" pos="{x!r} {y!r} {height / 2!r}" size="{radius!r} {height / 2!r}"/>')
    solids = "\n".join(geoms)
    return mujoco.MjModel.from_xml_string(f'<mujoco><compiler angle="radian"/><worldbody>{solids}</worldbody></mujoco>')


def settled(model: mujoco.MjModel) -> mujoco.MjData:
    """The data in which rays are cast: everything where the model says."""
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    return data


def scan(model: mujoco.MjModel, data: mujoco.MjData, pose: np.ndarray, max_range: float) -> np.ndarray:
    """MuJoCo's distances along beams from a pose (x, y, yaw) [m, rad], at most `max_range` [m]."""
    x, y, yaw = (float(value) for value in pose)
    origin, geom = np.array([x, y, LIDAR_HEIGHT]), np.zeros(1, np.int32)
    turned = yaw + ANGLES
    beams = np.stack([np.cos(turned), np.sin(turned), np.zeros_like(turned)], axis=-1)
    found = np.array([mujoco.mj_ray(model, data, origin, beam, None, 1, -1, geom) for beam in beams])
    return np.minimum(np.where(found < 0, max_range, found), max_range)


def poses(rng: np.random.Generator, world: NavigationWorld, count: int) -> np.ndarray:
    """Random poses in the hall (count, 3) in single precision [m, rad], some of them inside solids."""
    half = np.append(np.asarray(world.extent, float) / 2, np.pi)
    return rng.uniform(-half, half, (count, 3)).astype(np.float32)


def _used(rows, heights) -> list[tuple[list[float], float]]:
    pairs = zip(np.asarray(rows, float).tolist(), np.asarray(heights, float).tolist(), strict=True)
    return [(row, height) for row, height in pairs if abs(row[0]) < FAR_AWAY / 2]
