"""Sources of instances: an environment id of Gymnasium's registry, or the user's own class or function.

The last functions make gymnasium_robotics 1.4.2 work with MuJoCo 3.17. Its `utils.mujoco_utils` asks whether a joint's
type, a NumPy integer, is in a list of members of `mujoco.mjtJoint`. MuJoCo 3.17's members equal no NumPy integer, and
every reset would fail with an AssertionError.
"""

from __future__ import annotations

import contextlib
import enum
import inspect
import io
import json
import os
import sys
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from importlib.util import find_spec
from pkgutil import resolve_name
from types import SimpleNamespace
from typing import Any

from cuelearner_jax.errors import UserError, near


@dataclass(frozen=True)
class Source:
    """A maker of instances and the number of their processes. Hashable, since compiled programs hold it."""

    name: str  # an id of Gymnasium's registry, or what the user's code is called
    arguments: str  # arguments of the environment, by name, as JSON
    max_steps: int  # an episode is truncated after so many; 0: as the environment says
    processes: int  # 0: one for each processor; 1: this one
    size: int = 0  # entries of an observation
    factory: Callable[..., Any] | None = None  # None: by the id
    draws: bool = False  # True if its instances are drawn, which takes one process

    @property
    def make(self) -> Callable[[], Any]:
        """A function without arguments that makes one instance."""
        arguments = json.loads(self.arguments)
        if self.draws and (self.factory is None or _takes_render_mode(self.factory)):
            arguments["render_mode"] = "rgb_array"
        if self.factory is not None:
            return partial(make_from_code, self.factory, arguments)
        return partial(make_registered, self.name, arguments, self.max_steps, self.spec)

    @property
    def spec(self) -> Any:
        """The id's specification in the caller's own registry, which another process lacks; None: there is none."""
        return resolve_name("gymnasium:registry").get(self.name) if self.factory is None else None


def _takes_render_mode(factory: Callable[..., Any]) -> bool:
    parameters = inspect.signature(factory).parameters.values()
    return any(one.name == "render_mode" or one.kind is one.VAR_KEYWORD for one in parameters)


def check_installed() -> None:
    """Raise UserError unless Gymnasium is installed."""
    if find_spec("gymnasium") is None:
        raise UserError("Gymnasium is not installed: pip install 'cuelearner-jax[gymnasium]'")


def registry_spec(name: str) -> Any:
    """Return the specification of an id in Gymnasium's registry, without importing the id's module."""
    check_installed()
    if ":" in name:
        advice = f"only its caller may name that, as gymnasium:{name} in place of TASK"
        raise UserError(f"the id {name!r} would import code: {advice}")
    import gymnasium

    # Where the caller imported that package, its environments are registered, and fail.
    if "gymnasium_robotics" in sys.modules or (name not in gymnasium.registry and find_spec("gymnasium_robotics")):
        register_robotics()
    try:
        return gymnasium.registry.get(name) or gymnasium.spec(name)  # `spec` finds an id without its version
    except gymnasium.error.Error as error:
        raise UserError(
            f"Gymnasium has no environment {name!r}{near(name, gymnasium.registry)}; "
            "of an id that your own code registers give the class or function (gymnasium:package.module:NAME)"
        ) from error


def make_registered(name: str, arguments: dict[str, Any], max_steps: int, spec: Any = None) -> Any:
    """Return an environment of a specification, by default that of this process's registry."""
    try:
        own = registry_spec(name)  # makes those of gymnasium_robotics work too
    except UserError:
        if (own := spec) is None:
            raise
    import gymnasium

    return gymnasium.make(spec or own, **({"max_episode_steps": max_steps} if max_steps else {}), **arguments)


def make_from_code(factory: Callable[..., Any], arguments: dict[str, Any]) -> Any:
    """Return an environment of the user's code."""
    try:
        return factory(**arguments)
    except AssertionError:  # of gymnasium_robotics, if the user's code makes one of its environments
        if "gymnasium_robotics" not in sys.modules:
            raise
        _supply_joint_types()
        return factory(**arguments)


def register_robotics() -> None:
    """Register the environments of gymnasium_robotics with Gymnasium, so that these work beside the MuJoCo here."""
    import gymnasium

    with contextlib.redirect_stderr(io.StringIO()):  # importing prints a notice about other environments
        try:
            import gymnasium_robotics
        except AttributeError as error:  # of PyOpenGL, which finds no library
            library = os.environ.get("MUJOCO_GL", "")
            advice = "install libosmesa6 or libegl1, or set MUJOCO_GL=egl or osmesa"
            raise UserError(f"MUJOCO_GL={library} finds no library: {advice}") from error

    gymnasium.register_envs(gymnasium_robotics)
    _supply_joint_types()


def _supply_joint_types() -> None:
    """Give gymnasium_robotics a view of `mujoco` whose `mjtJoint` compares with NumPy integers, where it does not."""
    import numpy as np
    from gymnasium_robotics.utils import mujoco_utils

    library: Any = mujoco_utils.mujoco
    own = library.mjtJoint
    if np.int32(int(own.mjJNT_HINGE)) not in (own.mjJNT_HINGE,):
        kinds = {name: int(getattr(own, name)) for name in dir(own) if name.startswith("mjJNT_")}
        view: Any = SimpleNamespace(**{**vars(library), "mjtJoint": enum.IntEnum("mjtJoint", kinds)})
        mujoco_utils.mujoco = view
