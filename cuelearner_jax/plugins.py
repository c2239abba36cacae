"""Objects from outside the package: `package.module:NAME`, as entry points write it."""

from __future__ import annotations

import importlib
import os
import re
import sys
from typing import Any, TypeVar

from cuelearner_jax.errors import UserError, closest

REFERENCE = re.compile(r"[^\W\d]\w*(\.[^\W\d]\w*)*:[^\W\d]\w*")

T = TypeVar("T")


def load(reference: str, kind: type[T], called: str) -> T:
    """The object that a reference names; modules of the current folder can be named too.

    Args:
        reference: `package.module:NAME`.
        kind: what it must be an instance of.
        called: what a message calls such an object, for instance "a task".

    Raises:
        UserError: no such module or name, the module does not import, or the object is something else.
    """
    if not REFERENCE.fullmatch(reference):
        raise UserError(f"{reference!r} does not name {called}: give package.module:NAME, for instance my_code:MINE")
    module_name, _, name = reference.partition(":")
    if os.getcwd() not in sys.path and "" not in sys.path:  # an installed command starts without it
        sys.path.append(os.getcwd())
    importlib.invalidate_caches()  # the file may be younger than what Python knows of its folder
    try:
        module: Any = importlib.import_module(module_name)
    except (Exception, SystemExit) as error:  # whatever the module's own code raises
        missing = error.name if isinstance(error, ModuleNotFoundError) else None
        if missing and f"{module_name}.".startswith(f"{missing}."):
            raise UserError(
                f"no module {missing!r} for {reference}: run in the folder that holds it, or install it"
            ) from error
        told = (str(error).strip().splitlines() or [""])[0][:200]
        raise UserError(f"{module_name} fails to import ({type(error).__name__}: {told}): mend it first") from error
    if not hasattr(module, name):
        there = [other for other, value in vars(module).items() if isinstance(value, kind)]
        raise UserError(f"{module_name} has no {name!r}{closest(name, there) if there else f', nor {called}'}")
    found = getattr(module, name)
    if not isinstance(found, kind):
        raise UserError(
            f"{reference} is of type {type(found).__name__}: {called} is a {kind.__module__}.{kind.__name__}"
        )
    return found
