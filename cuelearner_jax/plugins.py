"""Objects from outside the package: `package.module:NAME`, as entry points write it."""

from __future__ import annotations

import importlib
import sys
from pathlib import Path
from typing import Any, TypeVar

from cuelearner_jax.errors import UserError, closest

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
    module_name, colon, name = reference.partition(":")
    if not colon or not name or not all(part.isidentifier() for part in module_name.split(".")):
        raise UserError(f"{reference!r} does not name {called}: give package.module:NAME")
    here = str(Path.cwd())
    if here not in sys.path:  # an installed command starts without it
        sys.path.insert(0, here)
    try:
        module: Any = importlib.import_module(module_name)
    except ModuleNotFoundError as error:
        if error.name and (module_name == error.name or module_name.startswith(error.name + ".")):
            raise UserError(
                f"no module {module_name!r} for {reference!r}: install it, or run from the folder that holds it"
            ) from error
        raise UserError(f"{module_name} cannot be imported ({error})") from error
    except Exception as error:  # whatever the module's own code raises
        reason = (str(error).strip().splitlines() or [""])[0][:200]
        raise UserError(f"{module_name} cannot be imported ({type(error).__name__}: {reason})") from error
    if not hasattr(module, name):
        there = [other for other, value in vars(module).items() if isinstance(value, kind)]
        raise UserError(f"{module_name} has no {name!r}{closest(name, there) if there else f' and no {kind.__name__}'}")
    found = getattr(module, name)
    if not isinstance(found, kind):
        raise UserError(f"{reference} is a {type(found).__name__}, not {called} ({kind.__name__})")
    return found
