"""Make gymnasium_robotics 1.4.2 work with MuJoCo 3.17. The only module that knows its internals.

`gymnasium_robotics.utils.mujoco_utils` asks whether a joint's type, a NumPy integer, is in a list of members of
`mujoco.mjtJoint`. MuJoCo 3.17's members equal no NumPy integer, and every reset fails with an AssertionError.
"""

from __future__ import annotations

import contextlib
import enum
import io
import types
from typing import Any


def register() -> None:
    """Register the environments of gymnasium_robotics with Gymnasium, so that these work beside the MuJoCo here."""
    import gymnasium

    with contextlib.redirect_stderr(io.StringIO()):  # importing prints a notice about other environments
        import gymnasium_robotics

    gymnasium.register_envs(gymnasium_robotics)
    supply_joint_types()


def supply_joint_types() -> None:
    """Give `gymnasium_robotics.utils.mujoco_utils` a view of `mujoco` whose `mjtJoint` compares with NumPy integers.

    Does nothing where the members do so by themselves.
    """
    import mujoco as library
    import numpy as np
    from gymnasium_robotics.utils import mujoco_utils

    mujoco: Any = library  # `Any`, since type checkers do not know its members
    own = mujoco.mjtJoint
    if np.int32(int(own.mjJNT_HINGE)) in (own.mjJNT_HINGE,) or isinstance(mujoco_utils.mujoco, _View):
        return
    mujoco_utils.mujoco = _View(mujoco)  # pyright: ignore[reportAttributeAccessIssue]


class _View(types.ModuleType):
    """A module with everything that `mujoco` has, and joint types that are integers."""

    def __init__(self, module: Any) -> None:
        super().__init__(module.__name__)
        names = [name for name in dir(module.mjtJoint) if name.startswith("mjJNT_")]
        self.module = module
        self.mjtJoint = enum.IntEnum("mjtJoint", {name: int(getattr(module.mjtJoint, name)) for name in names})

    def __getattr__(self, name: str) -> Any:
        return getattr(self.module, name)
