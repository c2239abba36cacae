"""Type checking in tests: beartype verifies the shapes in signatures."""

from __future__ import annotations

import re
from collections.abc import Callable
from contextlib import suppress
from functools import wraps
from inspect import isroutine
from types import SimpleNamespace
from typing import Any, get_type_hints

import jaxtyping
from beartype import BeartypeConf, beartype

PACKAGES = ["cuelearner_envs", "cuelearner_jax"]  # packages whose functions and methods are checked
DOORS = "cuelearner_jax.api."  # public functions check their arguments themselves, with better messages
# Folders and files of tests in which an operand of a lower rank is filled up by NumPy's rule,
# which brax and MuJoCo's MJX rely on; elsewhere it is an error.
LOOSE_RANKS = ("bridges", "cli/test_anymal.py", "envs/anymal", "examples")

# An int is a float, as pyright has it. What damaged files hold is a TypeError, as it is without checks.
_conf = BeartypeConf(is_pep484_tower=True, violation_type=jaxtyping.TypeCheckError)
_with_dimensions = jaxtyping.jaxtyped
# Of jaxtyping, and the package's aliases of such.
_named = re.compile(
    r"\b(Float|Int|UInt|Bool|Shaped|Num|Integer|Key|PyTree|PRNGKeyArray|Observations?|(Candidate)?Actions?|Rows|Number)\b"
)


def install() -> None:
    """Check functions and methods of `PACKAGES`, which must not be imported yet."""
    jaxtyping.jaxtyped = checked  # which the hook writes above each function and class
    jaxtyping.install_import_hook(PACKAGES, "beartype.beartype")


def checked(function: Any = None, **_: Any) -> Any:
    """Return the function with its arguments and result checked at every call.

    Constructors are left alone: JAX rebuilds pytrees with whatever stands for their leaves (shapes, axes, None), which
    is not what their fields are declared to hold. The checks are written at the first call, since a process calls a
    part of the functions that it imports. jaxtyping keeps the dimensions of a call, which takes longer than all
    checks, and functions that name no array have none.
    """
    if function is None:
        return checked
    if not isroutine(function) or function.__name__ == "__init__" or function.__module__.startswith(DOORS):
        return function
    made: list[Callable] = []

    @wraps(function)
    def checking(*arguments, **keywords):
        __tracebackhide__ = True
        if not made:
            made.append(_with_checks(function))
        return made[0](*arguments, **keywords)

    return checking


def _with_checks(function: Any) -> Callable:
    declared = function.__annotations__
    function.__annotations__ = _known_hints(function)
    checks = beartype(function, conf=_conf)
    function.__annotations__ = declared
    named = any(_named.search(str(annotation)) for annotation in declared.values())
    return _with_dimensions(checks, typechecker=None) if named else checks


def _known_hints(function: Any) -> dict[str, Any]:
    """Return the annotations that mean something at run time: not what is imported for type checkers alone."""
    try:
        return get_type_hints(function, include_extras=True)
    except NameError:
        found = {}
        for name, annotation in function.__annotations__.items():
            alone = SimpleNamespace(__annotations__={name: annotation})
            with suppress(NameError):
                found |= get_type_hints(alone, function.__globals__, include_extras=True)
        return found
