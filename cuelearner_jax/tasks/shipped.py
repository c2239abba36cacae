"""The trained agents that the package contains: `shipped:NAME` wherever the folder of a policy is named."""

from __future__ import annotations

import os
from importlib.util import find_spec
from pathlib import Path

from cuelearner_jax.errors import UserError

PREFIX = "shipped:"


def names() -> tuple[str, ...]:
    """Return the names of all shipped agents, each with its prefix."""
    return tuple(sorted(f"{PREFIX}{folder.parent.name}" for folder in _place().glob("*/config.json")))


def is_shipped(name: str | os.PathLike[str]) -> bool:
    """Return whether a word names a shipped agent, known or not."""
    return isinstance(name, str) and name.startswith(PREFIX)


def folder_of(name: str | os.PathLike[str]) -> Path:
    """Return the folder that the user names, as `shipped:NAME` or as a path.

    Raises UserError for a shipped agent that does not exist. A path is not checked.
    """
    if not is_shipped(name):
        return Path(name)
    if (text := os.fspath(name)) not in names():
        raise UserError(f"no shipped agent {text!r}: give one of {', '.join(names())}")
    return _place() / text.removeprefix(PREFIX)


def _place() -> Path:
    """Return the folder of all shipped agents, without importing the package that holds them."""
    return Path(str(getattr(find_spec("cuelearner_envs"), "origin", ""))).parent / "agents"
