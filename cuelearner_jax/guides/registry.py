"""The registry of kinds of guidance: those of the package, of installed packages, and of the user's own code.

A kind of one's own is a `Kind`: pass it to `register`, offer it under the entry-point group `cuelearner.guidances`, or
name it as `package.module:NAME` wherever the name of a kind is asked for.
"""

from __future__ import annotations

from functools import cache
from importlib import metadata
from typing import Any

from cuelearner_jax.config import GuideSizes
from cuelearner_jax.environment import actions_of, offers, spaces_of
from cuelearner_jax.errors import UserError, suggestion
from cuelearner_jax.guides import (
    baselines,
    bdcoach,
    clic,
    dcoach,
    demonstration,
    intent,
    reading,
    relative,
    scalar,
)
from cuelearner_jax.guides.base import Guide, Kind
from cuelearner_jax.plugins import load

ENTRY_POINTS = "cuelearner.guidances"

_TAUGHT = (demonstration.KIND, scalar.KIND, dcoach.KIND, reading.KIND)
_PEERS = (bdcoach.KIND, clic.KIND, clic.SHOWN)
_BUILT_IN = (
    baselines.NONE,
    relative.KIND,
    intent.KIND,
    baselines.HEURISTIC,
    baselines.ANY_AIM,
    *_TAUGHT,
    *_PEERS,
)
_KINDS: dict[str, Kind] = {kind.name: kind for kind in _BUILT_IN}


def register(kind: Kind) -> Kind:
    """Register a kind under its name. Raises UserError if another kind has the name."""
    if _KINDS.setdefault(kind.name, kind) != kind:
        raise UserError(f"another guidance is already called {kind.name!r}: give yours another name")
    return kind


def kinds() -> tuple[Kind, ...]:
    """Return the registered kinds, those of installed packages included."""
    _register_installed()
    return tuple(_KINDS.values())


def find_or_none(name: str) -> Kind | None:
    """Return the kind of that name, or None, for results whose kind is not known here."""
    _register_installed()
    return _KINDS.get(name)


def find(name: str) -> Kind:
    """Return the kind of that name without loading code. Raises UserError if no kind has the name."""
    _register_installed()
    if name not in _KINDS:
        raise UserError(f"unknown guidance {name!r}{suggestion(name, _KINDS)} (name your own as package.module:NAME)")
    return _KINDS[name]


def resolve(text: str) -> Kind:
    """Return the kind that a user or caller names: by its name, or as `package.module:NAME`, whose code is loaded.

    Never pass text from a file. Raises UserError if there is no such kind.
    """
    return register(load(text, Kind, "a kind of guidance")) if ":" in text else find(text)


def kind_name(text: str) -> str:
    """Return the name of the kind that a user or caller names (`resolve`); a plain name need not be registered."""
    return resolve(text).name if ":" in text else text


def possible(env: Any, taught: bool) -> tuple[str, ...]:
    """Return the names of the kinds that an agent can be trained with; `taught`: whether the world has a teacher."""
    trained = (kind for kind in kinds() if not kind.adapts_only and (taught or not kind.asks))
    cues = actions_of(env).cues
    said = (kind for kind in trained if cues or not kind.needs_cues)
    return tuple(kind.name for kind in said if all(offers(env, need) for need in kind.needs))


def make(name: str, sizes: GuideSizes, env: Any, options: Any = None) -> Guide:
    """Return a kind's guide for an environment (shapes in place of arrays will do).

    Args:
        name: name of the kind.
        sizes: sizes of its model.
        env: the environment, of which only the spaces are used.
        options: the kind's own, a `Kind.config`; None: its defaults.

    Raises:
        UserError: no such kind, or the environment lacks what it needs.
    """
    kind = find(name)
    for need in kind.needs:
        if not offers(env, need):
            raise UserError(
                f"guidance {kind.name!r} needs an environment with `{need}`, which this task does not "
                "have: choose another guidance"
            )
    return kind.make(sizes, spaces_of(env), options)


@cache
def _register_installed() -> None:
    for point in metadata.entry_points(group=ENTRY_POINTS):
        register(load(point.value, Kind, "a kind of guidance"))
