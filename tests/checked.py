"""The type checker of the tests: beartype, so that the shapes in signatures are held against what passes through."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar

from beartype import BeartypeConf, beartype

Function = TypeVar("Function", bound=Callable)

PACKAGES = ["cuelearner_envs", "cuelearner_jax"]  # whose functions and methods are checked
# Folders and files of tests in which an operand of a lower rank is filled up by NumPy's rule,
# which brax and MuJoCo's MJX rely on; elsewhere it is an error.
DOORS = "cuelearner_jax.api."  # what users call looks at its arguments itself, and says more
LOOSE_RANKS = ("bridges", "experiments/test_train_walking.py", "cli/test_anymal.py", "envs/anymal", "examples")

_conf = BeartypeConf(is_pep484_tower=True)  # an int is a float, as pyright has it


def checked(function: Function) -> Function:
    """The function with its arguments and its result checked at every call.

    Constructors are left alone: JAX rebuilds pytrees with whatever stands for their leaves (shapes, axes, None), which
    is not what their fields are declared to hold.
    """
    left_alone = function.__name__ == "__init__" or function.__module__.startswith(DOORS)
    return function if left_alone else beartype(function, conf=_conf)
