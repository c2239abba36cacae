"""Load objects from outside the package by `package.module:NAME`, as entry points write it."""

from __future__ import annotations

import importlib
import os
import re
import sys
from typing import Any, Generic, TypeVar

from cuelearner_jax.errors import UserCodeError, UserError, suggestion

REFERENCE = re.compile(r"[^\W\d]\w*(\.[^\W\d]\w*)*:[^\W\d]\w*")

T = TypeVar("T")


def load(reference: str, kind: type[T], called: str) -> T:
    """Return the object that `package.module:NAME` leads to; modules of the current folder can be named too.

    `kind`: class of the object. `called`: such an object in messages, as "a task". Raises UserError if there is none,
    UserCodeError if the module fails to import.
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
        why = (str(error).strip().splitlines() or [""])[0][:200]
        raise UserCodeError(f"{module_name} fails to import ({type(error).__name__}: {why}): mend it first") from error
    if not hasattr(module, name):
        fitting = [other for other, value in vars(module).items() if isinstance(value, kind)]
        raise UserError(f"{module_name} has no {name!r}{suggestion(name, fitting) if fitting else f', nor {called}'}")
    if not isinstance(value := getattr(module, name), kind):
        wanted = f"{called} is a {kind.__module__}.{kind.__name__}"
        raise UserError(f"{reference} is of type {type(value).__name__}: {wanted}")
    return value


class PartRegistry(Generic[T]):
    """Option classes of parts of one sort (agents, say), by `NAME` or package.module:NAME."""

    def __init__(self, sort: str, needs: str, *built_in: Any) -> None:
        """`sort`: the word for such a part in messages. `needs`: the function that such a class must have."""
        self._sort, self._needs, self._found = sort, needs, {kind.NAME: kind for kind in built_in}

    def register(self, kind: Any) -> Any:
        """Make a class known under its name and return it. Raises UserError if another one has the name."""
        if self._found.setdefault(kind.NAME, kind) is not kind:
            raise UserError(f"another {self._sort} is already called {kind.NAME!r}: give yours another name")
        return kind

    def find(self, name: str) -> type[T]:
        """Return the class of that name without loading code. Raises UserError if no class has the name."""
        if name not in self._found:
            own = f"name your own by --{self._sort} package.module:NAME, if you trust that code"
            raise UserError(f"unknown {self._sort} {name!r}{suggestion(name, self._found)} ({own})")
        return self._found[name]

    def resolve(self, text: str) -> type[T]:
        """Return the class that a user names, by its name or as `package.module:NAME`, whose code is loaded.

        Never pass text from a file. Raises UserError if there is no such class.
        """
        if ":" not in text:
            return self.find(text)
        kind: Any = load(text, type, f"options of the {self._sort}")
        if not hasattr(kind, "NAME") or not callable(getattr(kind, self._needs, None)):
            wanted = f"a class of options with NAME, ABOUT and {self._needs}"
            raise UserError(f"{text} is not an {self._sort}: give {wanted}")
        return self.register(kind)
