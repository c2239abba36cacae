"""Convert policies to plain values and arrays, and back.

A policy's values are those of its `describe()`. The stored kinds are `agent` with its `params`; `guided` with its
`model` and, where there is one, its `bound`; `reading` with its `correction` and `bound`; `uniform`; `heuristic`; and
the name of `code`, as package.module:NAME.

Code is never loaded because a file names it: the caller who opens the policy names the code again.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp

from cuelearner_jax import config as configuration
from cuelearner_jax.adaptation import changes as own_changes
from cuelearner_jax.config import GuideSizes, Scalars
from cuelearner_jax.environment import actions_of, offers, spaces_of, view_of
from cuelearner_jax.errors import UserError
from cuelearner_jax.guides import registry as guidances
from cuelearner_jax.guides.base import Guide
from cuelearner_jax.policies import Agent, Guided, Heuristic, describe, layers, policy_of, uniform_in
from cuelearner_jax.reading.policy import KIND as READING
from cuelearner_jax.reading.policy import ReadingPolicy, unread
from cuelearner_jax.run_config import kind_from_json, part_from_json

# the kinds that can be stored, and the arrays of those that have any
STORED = ("agent", "guided", READING, "uniform", "heuristic", "code")
ARRAYS = {Agent: ("params",), Guided: ("model", "bound"), ReadingPolicy: ("correction", "bound")}
DERIVED = ("clip_radius_deg", "fitted")  # left out of a description: the other values and the arrays hold them already


def to_json(policy: Any, reference: str | None = None) -> dict[str, Any]:
    """Return a policy, or a block of policies, as plain values; `reference`: the reference of user code in it, if any.

    Raises UserError for a policy that cannot be stored.
    """
    described = describe(policy)
    for layer in layers(described):
        if layer.get("asks"):
            raise UserError("a policy that asks a teacher cannot be stored: give one that acts without a teacher")
        if layer["policy"] not in STORED or (layer["policy"] == "guided" and layer["sizes"] is None):
            raise UserError(f"a policy of kind {layer['policy']} cannot be stored in a folder: give another kind")
        if layer["policy"] == "code":
            layer["named"] = reference or "code"
        for change in layer.get("changes", ()):
            change.pop("value")
        for name in DERIVED:
            layer.pop(name, None)
    return described


def arrays_of(policy: Any) -> Any:
    """Return the arrays of a policy, or of a block of policies."""
    policy = getattr(policy, "policy", policy)  # `Common` holds it as `policy`
    names = next((names for kind, names in ARRAYS.items() if isinstance(policy, kind)), ())
    arrays = {name: array for name in names if (array := getattr(policy, name)) is not None}
    return {**arrays, "base": arrays_of(policy.base)} if hasattr(policy, "base") else arrays


def with_arrays(policy: Any, arrays: Any) -> Any:
    """Return a policy of `from_json` with these arrays, a tree as `arrays_of` returns."""
    own = {name: with_arrays(policy.base, part) if name == "base" else part for name, part in arrays.items()}
    return policy.replace(**own) if own else policy


def from_json(values: dict[str, Any], env: Any, code: Any = None, changes: Any = None) -> Any:
    """Return the policy of plain values, with shapes in place of its arrays (`with_arrays`), to act in a world.

    `env`: the world; shapes in place of its arrays will do. `code`, `changes`: what stands for code in the values, and
    the user's own distortions, as `changes.family_of` takes them; None: none were given.
    """
    kind, key = values["policy"], jax.random.key(0)
    if kind == "agent":
        functions = part_from_json("agent", values["agent"]).make(values["frame"], spaces_of(env))
        return Agent(jax.eval_shape(functions.init, key)[0], functions, view_of(env))
    if kind == "uniform":
        return uniform_in(env)
    if kind == "heuristic":
        if not offers(env, "heuristic"):
            raise UserError("the policy is the task's heuristic, and this world has none: choose another world")
        return Heuristic(view_of(env))
    if kind == "guided":
        base, guide = from_json(values["base"], env, code, changes), _guidance(values, env)
        scalars = configuration.from_json(Scalars, values["scalars"])
        bound = jnp.zeros(()) if values["bounded"] else None
        return Guided(base, jax.eval_shape(guide.init, key), view_of(env), scalars, guide, bound, guide.sizes)
    if kind == READING:
        base, family = from_json(values["base"], env, code, changes), own_changes.rebuild_family(values, env, changes)
        return unread(base, actions_of(env), family, env.obs_size, values["labels"], values["mixed"], values["code"])
    if kind != "code":
        raise UserError(f"{kind!r} is not a kind of policy that this program knows: use the cuelearner that wrote it")
    if code is None:
        why = f"this policy is made of code, {values['named']}, which is not loaded because a file names it"
        raise UserError(f"{why}: add --base {values['named']} if you trust that code")
    return policy_of(code, actions_of(env))


def _guidance(values: dict[str, Any], env: Any) -> Guide:
    """Return the guide of a guided policy. Raises UserError if no kind of that name is known."""
    if (name := values["guidance"]) not in guidances.guides():
        advice = "name its code by --guidance package.module:NAME, if you trust that code"
        raise UserError(f"the policy is under a guidance from outside, {name!r}: {advice}")
    sizes, options = configuration.from_json(GuideSizes, values["sizes"]), kind_from_json(name, values["options"])
    return guidances.make(name, sizes, env, options)
