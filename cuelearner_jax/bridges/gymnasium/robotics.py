"""Make gymnasium_robotics 1.4.2 work with MuJoCo 3.17. The only module that knows its internals.

`gymnasium_robotics.utils.mujoco_utils` asks whether a joint's type, a NumPy integer, is in a list of members of
`mujoco.mjtJoint`. MuJoCo 3.17's members equal no NumPy integer, and every reset fails with an AssertionError.
"""

from __future__ import annotations

import contextlib
import enum
import io
from types import SimpleNamespace
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
    import numpy as np
    from gymnasium_robotics.utils import mujoco_utils

    library: Any = mujoco_utils.mujoco
    own = library.mjtJoint
    if np.int32(int(own.mjJNT_HINGE)) not in (own.mjJNT_HINGE,):
        kinds = {name: int(getattr(own, name)) for name in dir(own) if name.startswith("mjJNT_")}
        view: Any = SimpleNamespace(**{**vars(library), "mjtJoint": enum.IntEnum("mjtJoint", kinds)})
        mujoco_utils.mujoco = view
