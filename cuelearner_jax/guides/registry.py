"""The table of kinds of guidance: those of the package, of installed packages, and of the user's own code.

A kind of one's own is a class that inherits `Guide`: add it to `guides()`, offer it under the entry-point group
`cuelearner.guidances`, or name it as `package.module:CLASS` wherever the name of a kind is asked for.
"""

from __future__ import annotations

from functools import cache
from importlib import metadata
from typing import Any

from cuelearner_jax import plugins
from cuelearner_jax.config import GuideSizes
from cuelearner_jax.environment import actions_of, offers, spaces_of
from cuelearner_jax.errors import UserError
from cuelearner_jax.guides.base import AnyAim, Guide, HeuristicGuide, NoGuide, ReadingGuide
from cuelearner_jax.guides.bdcoach import BatchCoach
from cuelearner_jax.guides.clic import Clic, ClicShown
from cuelearner_jax.guides.dcoach import DeepCoach
from cuelearner_jax.guides.demonstration import Demonstration
from cuelearner_jax.guides.intent import Intent
from cuelearner_jax.guides.preference import Preference
from cuelearner_jax.guides.relative import Relative
from cuelearner_jax.guides.scalar import Scalar

ENTRY_POINTS = "cuelearner.guidances"
BUILT_IN: tuple[type[Guide], ...] = (
    *(NoGuide, Relative, Intent, HeuristicGuide, AnyAim, Demonstration, Scalar),
    *(DeepCoach, ReadingGuide, BatchCoach, Clic, ClicShown, Preference),
)


@cache
def guides() -> dict[str, type[Guide]]:
    """Return the kinds by their names."""
    table: dict[str, type[Guide]] = {kind.name: kind for kind in BUILT_IN}
    for point in metadata.entry_points(group=ENTRY_POINTS):
        plugins.add(table, plugins.load_part(point.value, "guidance"), "guidance")
    return table


def find(name: str) -> type[Guide]:
    """Return the kind of that name without loading code. Raises UserError if no kind has the name."""
    return plugins.find(guides(), name, "guidance")


def resolve(text: str) -> type[Guide]:
    """Return the kind that a user or caller names, never a file (`plugins.resolve`). Raises UserError if none is."""
    return plugins.resolve(guides(), text, "guidance")


def kind_name(text: str) -> str:
    """Return the name of the kind that a user or caller names (`resolve`); a plain name need not be registered."""
    return resolve(text).name if ":" in text else text


def possible(env: Any, taught: bool) -> tuple[str, ...]:
    """Return the names of the kinds that an agent can be trained with; `taught`: whether the world has a teacher."""
    cues = actions_of(env).cues
    return tuple(
        name
        for name, kind in guides().items()
        if not kind.adapts_only
        and (taught or not kind.asks)
        and (cues or not kind.needs_cues)
        and all(offers(env, need) for need in kind.needs)
    )


def make(name: str, sizes: GuideSizes, env: Any, options: Any = None) -> Guide:
    """Return a kind's guide for an environment, of which only the spaces are used (shapes in place of arrays will do).

    `options`: the kind's own, a `Guide.config` (None: its defaults).
    """
    kind = find(name)
    for need in kind.needs:
        if not offers(env, need):
            why = f"guidance {name!r} needs an environment with `{need}`, which this task does not have"
            raise UserError(f"{why}: choose another guidance")
    return kind(sizes, spaces_of(env), options)
