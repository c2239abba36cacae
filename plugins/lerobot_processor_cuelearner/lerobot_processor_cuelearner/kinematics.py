"""Kinematics of a hand: its position for the joints that an action proposes, and the joints for another position.

    T_i = 1 + f_i S_i + g_i S_i^2,   hinge: f = sin q, g = 1 - cos q;   slide: f = q   (S^2 = 0)
    p = T_1 ... T_n site,   dp/dq_i = T_1 ... T_(i-1) S_i T_i ... T_n site

S_i (4, 4) is the twist of joint i in the robot's zero pose. Twists and site come from an MJCF, once (`hand_of`); what
moves a robot needs NumPy alone. Positions are in the frame of the MJCF's world, in metres.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

PREFIX = "hand_"
ARRAYS = ("twist", "site", "low", "high", "zero", "joints", "golden_joints", "golden_place")
CASES, TOLERANCE = 8, 1e-4  # golden cases, and their largest difference [m]
STEPS, CLOSE = 12, 1e-4  # most Newton steps, and the distance at which they end [m]
LARGEST, DAMPING = 0.3, 1e-3  # largest move of a joint in a step [rad or m], and damping [m]
STIFFNESS = 0.03  # weight of a joint's move, beside the turn of the hand
UNITS = {"radians": 1.0, "degrees": np.pi / 180}


class Hand:
    """A hand at the end of a chain of joints.

    twist (joints, 4, 4), site (3,), low, high and zero (joints,) in radians or metres; joints (action, joints) maps an
    action to joints.
    """

    def __init__(self, arrays: Mapping[str, Any]) -> None:
        """Take `ARRAYS`. Raises ValueError for missing ones, or a hand that does not replay its golden cases."""
        if missing := [name for name in ARRAYS if name not in arrays]:
            raise ValueError(f"the hand's arrays lack {', '.join(missing)}: export the correction again")
        self.arrays = {name: np.asarray(arrays[name], np.float64) for name in ARRAYS}
        self.twist, self.low, self.high, self.zero, self.joints = (
            self.arrays[name] for name in ("twist", "low", "high", "zero", "joints")
        )
        self._square, self._site = self.twist @ self.twist, np.append(self.arrays["site"], 1.0)
        turns = self.twist[:, :3, :3]
        self._hinges = np.abs(turns).max((1, 2)) > 0.5
        self._axes = np.stack([turns[:, 2, 1], turns[:, 0, 2], turns[:, 1, 0]], 1)
        self._entries, self._eye = np.linalg.pinv(self.joints), np.eye(len(self.low))
        apart = np.abs(self._chain(self.arrays["golden_joints"])[0] - self.arrays["golden_place"]).max()
        if not apart <= TOLERANCE:
            raise ValueError(f"the hand's kinematics are off by {apart:.1e} m in golden cases: export them again")

    def place(self, actions: np.ndarray) -> np.ndarray:
        """Return the hand's positions (n, 3) for joint actions (n, action)."""
        return self._chain(actions.astype(np.float64) @ self.joints)[0]

    def move(self, actions: np.ndarray, change: Callable[[np.ndarray], np.ndarray]) -> np.ndarray:
        """Return joint actions (n, action) that move the hand by `change`, a function of its positions (n, 3).

        Newton steps of damped least squares turn the hand as little as the joints allow. A joint stays within its
        limits, or where the action proposed it beyond them. Entries without a joint stay as proposed.
        """
        start = actions.astype(np.float64) @ self.joints
        low, high = np.minimum(self.low, start), np.maximum(self.high, start)
        place, jacobian, turn = self._chain(start)
        goal = place + change(place)
        joints, best, least = start, start, np.full(len(start), np.inf)
        blocked = np.zeros(start.shape)
        for _ in range(STEPS):
            error = goal - place
            far = np.sqrt((error**2).sum(1))
            best, least = np.where((far < least)[:, None], joints, best), np.minimum(far, least)
            if least.max() < CLOSE:
                break
            weight = turn.transpose(0, 2, 1) @ turn + (STIFFNESS + 1e6 * blocked)[:, None] * self._eye
            ways = np.linalg.solve(weight, jacobian.transpose(0, 2, 1))
            step = (ways @ np.linalg.solve(jacobian @ ways + DAMPING**2 * np.eye(3), error[..., None]))[..., 0]
            unlimited = joints + step / np.maximum(1.0, np.abs(step).max(1, keepdims=True) / LARGEST)
            joints = np.clip(unlimited, low, high)
            blocked = np.maximum(blocked, joints != unlimited)
            place, jacobian, turn = self._chain(joints)
        return actions + (best - start) @ self._entries

    def _chain(self, joints: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return position (n, 3), its derivatives (n, 3, joints) and the turning axes (n, 3, joints) at joints."""
        at = joints - self.zero
        first = np.where(self._hinges, np.sin(at), at)[..., None, None]
        second = np.where(self._hinges, 1 - np.cos(at), 0.0)[..., None, None]
        each = np.eye(4) + first * self.twist + second * self._square
        before, point = [np.broadcast_to(np.eye(4), (len(at), 4, 4))], [np.broadcast_to(self._site, (len(at), 4))]
        for number in range(len(self.low)):
            before.append(before[-1] @ each[:, number])
            point.append((each[:, -1 - number] @ point[-1][..., None])[..., 0])
        frames, points = np.stack(before[:-1], 1), np.stack(point[:0:-1], 1)
        moves = frames @ self.twist @ points[..., None]
        turns = frames[..., :3, :3] @ self._axes[..., None]
        return point[-1][:, :3], moves[..., :3, 0].transpose(0, 2, 1), turns[..., 0].transpose(0, 2, 1)


def hand_of(mjcf: Path, site: str, joints: Sequence[str], unit: str, entries: Sequence[str]) -> Hand:
    """Return the hand at a site of an MJCF.

    Args:
        mjcf: the file.
        site: name of the site.
        joints: the MJCF's joint of each entry, in the order of the entries, "" for none; empty: by the entries' names.
        unit: of the entries, one of `UNITS`; entries of sliding joints are in metres.
        entries: names of an action's entries, as "elbow.pos".

    Raises SystemExit, with one line, for a file, site or joint that does not fit.
    """
    try:
        import mujoco
    except ImportError:
        raise SystemExit("--mjcf needs MuJoCo: pip install mujoco") from None
    library: Any = mujoco
    try:
        model = library.MjModel.from_xml_path(str(mjcf))
    except (ValueError, OSError) as error:
        raise SystemExit(f"--mjcf {mjcf} cannot be read ({' '.join(str(error).split())[:160]})") from error
    hinge = int(library.mjtJoint.mjJNT_HINGE)
    column = _columns(mjcf, site, _path(library, model, mjcf, site), entries, joints)
    own = [model.joint(name).id for name in column]
    where, turns = model.jnt_qposadr[own], model.jnt_type[own] == hinge
    maps = np.zeros((len(entries), len(own)))
    maps[list(column.values()), range(len(own))] = np.where(turns, UNITS[unit], 1.0)
    data = library.MjData(model)

    def position(values: np.ndarray) -> np.ndarray:
        data.qpos[:] = model.qpos0
        data.qpos[where] = values
        library.mj_kinematics(model, data)
        return data.site(site).xpos.copy()

    zero = model.qpos0[where]
    cases = zero + np.random.default_rng(0).uniform(-1, 1, (CASES, len(own)))
    golden, at = np.stack([position(case) for case in cases]), position(zero)
    twist = np.zeros((len(own), 4, 4))
    for number, (joint, is_hinge) in enumerate(zip(own, turns, strict=True)):
        axis, anchor = data.xaxis[joint], data.xanchor[joint]
        cross = np.cross(np.eye(3), axis) * is_hinge
        twist[number, :3] = np.column_stack([cross, -cross @ anchor if is_hinge else axis])
    low, high = np.where(model.jnt_limited[own, None] > 0, model.jnt_range[own], [-np.inf, np.inf]).T
    return Hand(dict(zip(ARRAYS, (twist, at, low, high, zero, maps, cases, golden), strict=True)))


def _path(library: Any, model: Any, mjcf: Path, site: str) -> list[str]:
    """Return the names of the hinges and slides from the base to a site. Raises SystemExit for an unknown site."""
    names = [model.site(number).name for number in range(model.nsite)]
    if site not in names:
        raise SystemExit(f"{mjcf} has no site {site}: give --site one of {', '.join(filter(None, names)) or 'its own'}")
    body, path = int(model.site(site).bodyid[0]), []
    while body:
        first, count = int(model.body_jntadr[body]), int(model.body_jntnum[body])
        path = [*range(first, first + count), *path]
        body = int(model.body_parentid[body])
    kinds = int(library.mjtJoint.mjJNT_HINGE), int(library.mjtJoint.mjJNT_SLIDE)
    return [model.joint(number).name for number in path if model.jnt_type[number] in kinds]


def _columns(
    mjcf: Path, site: str, path: Sequence[str], entries: Sequence[str], joints: Sequence[str]
) -> dict[str, int]:
    """Return the entry of each joint on the path to a site, by joint. Raises SystemExit where they do not fit."""
    names = list(joints) or [entry if entry in path else entry.rpartition(".")[0] for entry in entries]
    if len(names) > len(entries):
        raise SystemExit(f"--joints names {len(names)} joints, but an action has {len(entries)} entries")
    if joints and (strange := [name for name in names if name and name not in path]):
        raise SystemExit(f"{strange[0]} of --joints does not move {site}: its joints are {', '.join(path)}")
    column = {name: names.index(name) for name in path if name and name in names}
    if not column or (not joints and len(column) < len(path)):
        raise SystemExit(
            f"{site} of {mjcf} is moved by {', '.join(path) or 'no joint'}, and the action's entries are "
            f"{', '.join(entries)}: give --joints the joint of each entry"
        )
    return column
