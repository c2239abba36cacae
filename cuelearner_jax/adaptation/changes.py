"""The changes that a reading considers: derived from a world's declarations, or the user's own distortions."""

from __future__ import annotations

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from cuelearner_jax import plugins
from cuelearner_jax.environment import Environment, actions_of
from cuelearner_jax.errors import UserError, format_value
from cuelearner_jax.reading import families
from cuelearner_jax.reading.families import Distortion, Family

SITUATIONS = 8  # situations in which distortions at zero are checked to change nothing
SAME = 1e-4  # largest difference of an entry in that check


def load(reference: str) -> Any:
    """Return the changes that `package.module:NAME` names, for `family_of`."""
    return plugins.load(reference, object, "changes of the world")


def family_of(changes: Any, env: Any) -> Family:
    """Return a user's distortions: one, a list of them, or what a function of the environment returns of these."""
    changes = changes(env) if callable(changes) else changes
    several = (changes,) if isinstance(changes, Distortion) else changes
    if not isinstance(several, list | tuple) or not all(isinstance(one, Distortion) for one in several):
        advice = "give a cuelearner_jax.Distortion, several, or a function of the environment that returns them"
        raise UserError(f"changes is {format_value(changes)}: {advice}")
    return families.check_family(several)


def check_acts(family: Family, env: Environment) -> None:
    """Raise UserError unless distortions fit a world, and change nothing where their unknowns are zero."""
    k_reset, k_action = jax.random.split(jax.random.key(0))
    space, keys = actions_of(env), jax.random.split(k_reset, SITUATIONS)
    obs, actions = jax.vmap(env.reset)(keys)[1], space.sample(k_action, (SITUATIONS,))
    for one in family:
        nothing = jnp.zeros(len(one.unknowns))
        acts = jax.vmap(partial(families.undo_action, (one,), nothing))
        for name, rows, result in (
            ("sees", obs, jax.vmap(partial(families.undo_observation, (one,), nothing))(obs)),
            ("acts" if one.plans is None else "plans", actions, acts(obs, actions)),
        ):
            if result.shape != rows.shape or not np.allclose(result, rows, atol=SAME, rtol=SAME):
                raise UserError(
                    f"distortion {one.name!r}: {name} changes the shape or entries of a row although all of its "
                    "unknowns are zero: let it change nothing at zero"
                )


def rebuild_family(layer: dict[str, Any], env: Any, changes: Any = None) -> Family:
    """Return the distortions of a policy that was read from a file, `layer` being its plain values.

    `changes`: code of the user's own distortions, as `family_of` takes it; None: none was named.
    """
    code, names = layer["code"], layer["distortions"]
    if code and changes is None:
        why = f"this policy corrects changes of code, {code}, which is not loaded because a file names it"
        raise UserError(f"{why}: add --changes {code} (from Python changes=...) if you trust that code")
    by_name = {one.name: one for one in (family_of(changes, env) if code else families.declared_distortions(env))}
    family = tuple(by_name[name] for name in names if name in by_name)
    units = [(one["name"], one["unit"]) for one in layer["changes"]]
    if len(family) < len(names) or [(one.name, one.unit) for one in families.unknowns_of(family)] != units:
        why = f"this policy corrects {', '.join(names)}, which {code or 'this world'} lacks or has otherwise"
        raise UserError(f"{why}: give the code that made the policy")
    return family
