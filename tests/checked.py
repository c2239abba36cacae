"""Type checking in tests: beartype verifies the shapes in signatures."""

from __future__ import annotations

from collections.abc import Callable
from functools import wraps
from typing import TypeVar

from beartype import BeartypeConf, beartype

Function = TypeVar("Function", bound=Callable)

PACKAGES = ["cuelearner_envs", "cuelearner_jax"]  # packages whose functions and methods are checked
# Folders and files of tests in which an operand of a lower rank is filled up by NumPy's rule,
# which brax and MuJoCo's MJX rely on; elsewhere it is an error.
DOORS = "cuelearner_jax.api."  # public functions check their arguments themselves, with better messages
LOOSE_RANKS = ("bridges", "experiments/test_train_walking.py", "cli/test_anymal.py", "envs/anymal", "examples")

_conf = BeartypeConf(is_pep484_tower=True)  # an int is a float, as pyright has it


def checked(function: Function) -> Function:
    """Return the function with its arguments and result checked at every call.

    Constructors are left alone: JAX rebuilds pytrees with whatever stands for their leaves (shapes, axes, None), which
    is not what their fields are declared to hold. The checks are written at the first call: a process calls a part of
    the functions that it imports, and beartype needs milliseconds for each.
    """
    if function.__name__ == "__init__" or function.__module__.startswith(DOORS):
        return function
    checks: list[Function] = []

    @wraps(function)
    def checking(*arguments, **named):
        __tracebackhide__ = True
        if not checks:
            checks.append(beartype(function, conf=_conf))
        return checks[0](*arguments, **named)

    return checking
