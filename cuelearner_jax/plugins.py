"""Load objects from outside the package by `package.module:NAME`, as entry points write it."""

from __future__ import annotations

import importlib
import os
import re
import sys
from typing import Any, TypeVar

from cuelearner_jax.errors import UserCodeError, UserError, first_line, suggestion

REFERENCE = re.compile(r"[^\W\d]\w*(\.[^\W\d]\w*)*:[^\W\d]\w*")

T = TypeVar("T")


def load(reference: str, kind: type[T], called: str) -> T:
    """Return the object that `package.module:NAME` leads to; modules of the current folder can be named too.

    `kind`: class of the object. `called`: such an object in messages, as "a task".
    """
    if not REFERENCE.fullmatch(reference):
        raise UserError(f"{reference!r} does not name {called}: give package.module:NAME, for instance my_code:MINE")
    module_name, _, name = reference.partition(":")
    if os.getcwd() not in sys.path and "" not in sys.path:  # an installed command starts without it
        sys.path.append(os.getcwd())
    importlib.invalidate_caches()  # the file may be newer than Python's cache of its folder
    try:
        module: Any = importlib.import_module(module_name)
    except (Exception, SystemExit) as error:  # whatever the module's own code raises
        missing = error.name if isinstance(error, ModuleNotFoundError) else None
        if missing and f"{module_name}.".startswith(f"{missing}."):
            where = "run in the folder that holds it, or install it"
            raise UserError(f"no module {missing!r} for {reference}: {where}") from error
        why = f"{type(error).__name__}: {first_line(error)}"
        raise UserCodeError(f"{module_name} fails to import ({why}): mend it first") from error
    if not hasattr(module, name):
        fitting = [other for other, value in vars(module).items() if isinstance(value, kind) and other[0] != "_"]
        raise UserError(f"{module_name} has no {name!r}{suggestion(name, fitting) if fitting else f', nor {called}'}")
    if not isinstance(value := getattr(module, name), kind):
        meaning = f"{called} is a {kind.__module__}.{kind.__name__}"
        raise UserError(f"{reference} is of type {type(value).__name__}: {meaning}")
    return value


# The parts that a user may bring, by their sort: the function that the class of such a part must have
NEEDS = {"agent": "make", "arbiter": "follow", "guidance": "act"}


def add(table: dict[str, type[T]], kind: type[T], sort: str) -> type[T]:
    """Put a class into a table of parts, under its name. Raises UserError if another class has the name."""
    name = getattr(kind, "NAME", None) or kind.name  # pyright: ignore[reportAttributeAccessIssue]
    if table.setdefault(name, kind) is not kind:
        raise UserError(f"another {sort} is already called {name!r}: give yours another name")
    return kind


def find(table: dict[str, type[T]], name: str, sort: str) -> type[T]:
    """Return the class of that name without loading code. Raises UserError if no class has the name."""
    if name not in table:
        raise UserError(f"unknown {sort} {name!r}{suggestion(name, table)} (name your own as package.module:NAME)")
    return table[name]


def resolve(table: dict[str, type[T]], text: str, sort: str) -> type[T]:
    """Return the class that a user names, by its name or as `package.module:NAME`, whose code is loaded.

    Never pass text from a file. Raises UserError if there is no such class.
    """
    return add(table, load_part(text, sort), sort) if ":" in text else find(table, text, sort)


def load_part(reference: str, sort: str) -> Any:
    """Return the class of a part that a reference names. Raises UserError if there is none."""
    kind: Any = load(reference, type, f"a class of a part ({sort})")
    if not (hasattr(kind, "NAME") or hasattr(kind, "name")) or not callable(getattr(kind, NEEDS[sort], None)):
        raise UserError(f"{reference} is no {sort}: give a class with a name and a function `{NEEDS[sort]}`")
    return kind
