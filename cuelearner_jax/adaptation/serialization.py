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
from cuelearner_jax.agents.protocol import AgentFunctions
from cuelearner_jax.config import GuideSizes, Scalars
from cuelearner_jax.environment import Spaces, actions_of, offers, spaces_of, view_of
from cuelearner_jax.errors import UserError
from cuelearner_jax.guides import registry as guidances
from cuelearner_jax.guides.base import Guide
from cuelearner_jax.policies import Agent, Guided, Heuristic, describe, layers, policy_of, uniform_in
from cuelearner_jax.reading.policy import KIND as READING
from cuelearner_jax.reading.policy import Read, unread
from cuelearner_jax.run_config import kind_from_json, part_from_json

# the arrays of each kind that can be stored
ARRAYS: dict[str, tuple[str, ...]] = {
    "agent": ("params",),
    "guided": ("model", "bound"),
    READING: ("correction", "bound"),
}
ARRAYS |= {"uniform": (), "heuristic": (), "code": ()}
PARTS = ((GuideSizes, "sizes"), (Scalars, "scalars"))  # groups in a guided policy's values
DERIVED = ("clip_radius_deg", "fitted")  # left out of a description: the other values and the arrays hold them already


def to_json(policy: Any, named: str | None = None) -> dict[str, Any]:
    """Return a policy, or a block of policies, as plain values; `named`: the reference of user code in it, if any.

    Raises UserError for a policy that cannot be stored.
    """
    described = describe(policy)
    for layer in layers(described):
        if layer.get("asks"):
            raise UserError("a policy that asks a teacher cannot be stored: give one that acts without a teacher")
        if layer["policy"] not in ARRAYS or (layer["policy"] == "guided" and layer["sizes"] is None):
            raise UserError(f"a policy of kind {layer['policy']} cannot be stored in a folder: give another kind")
        if layer["policy"] == "code":
            layer["named"] = named or "code"
        for change in layer.get("changes", ()):
            change.pop("value")
        for name in DERIVED:
            layer.pop(name, None)
    return described


def arrays_of(policy: Any) -> Any:
    """Return the arrays of a policy, or of a block of policies."""
    kind, policy = describe(policy)["policy"], getattr(policy, "policy", policy)  # `Common` holds it as `policy`
    arrays = {name: getattr(policy, name) for name in ARRAYS.get(kind, ())}
    below = {"base": arrays_of(policy.base)} if hasattr(policy, "base") else {}
    return {**{name: array for name, array in arrays.items() if array is not None}, **below}


def shapes_of(values: dict[str, Any], env: Any, rows: int | None = None, changes: Any = None) -> Any:
    """Return the shapes of a policy's arrays from its plain values; `rows`: number of policies in a block.

    `changes`: the user's own distortions in it, as for `from_json`.

    Shapes in place of arrays will do for `env`. Raises UserError or ValueError if the policy cannot act in it.
    """
    spaces = spaces_of(env)

    def one(values: dict[str, Any]) -> Any:
        if values["policy"] == "agent":
            return {"params": _agent(values, spaces).init(jax.random.key(0))[0]}
        if values["policy"] == "guided":
            bound = {"bound": jnp.zeros(())} if values["bounded"] else {}
            return {"base": one(values["base"]), "model": _guidance(values, env).init(jax.random.key(0)), **bound}
        if values["policy"] == READING:
            own = _unread(values, env, own_changes.rebuild_family(values, env, changes))
            return {"base": one(values["base"]), "correction": own.correction, "bound": own.bound}
        return {}

    leading = () if rows is None else (rows,)
    shapes = jax.eval_shape(lambda: one(values))
    return jax.tree.map(lambda leaf: jax.ShapeDtypeStruct((*leading, *leaf.shape), leaf.dtype), shapes)


def from_json(values: dict[str, Any], arrays: Any, env: Any, code: Any = None, changes: Any = None) -> Any:
    """Return the policy of plain values and arrays, to act in a world.

    Args:
        values, arrays: the policy's plain values and arrays.
        env: the world.
        code: the policy that stands for code in it; None: none was given.
        changes: the user's own distortions in it, as `changes.family_of` takes them; None: none were given.

    Raises:
        UserError: the policy's code was not given, or it needs what the environment has not.
    """
    kind = values["policy"]
    if kind == "agent":
        return Agent(arrays["params"], _agent(values, spaces_of(env)), view_of(env))
    if kind == "uniform":
        return uniform_in(env)
    if kind == "heuristic":
        if not offers(env, "heuristic"):
            raise UserError("the policy is the task's heuristic, and this world has none: choose another world")
        return Heuristic(view_of(env))
    if kind == "guided":
        base = from_json(values["base"], arrays["base"], env, code, changes)
        sizes, scalars = (configuration.from_json(of, values[part]) for of, part in PARTS)
        return Guided(base, arrays["model"], view_of(env), scalars, _guidance(values, env), arrays.get("bound"), sizes)
    if kind == READING:
        base = from_json(values["base"], arrays["base"], env, code, changes)
        own = _unread(values, env, own_changes.rebuild_family(values, env, changes))
        return own.replace(base=base, correction=arrays["correction"], bound=arrays["bound"])
    if kind != "code":
        raise UserError(f"{kind!r} is not a kind of policy that this program knows: use the cuelearner that wrote it")
    if code is None:
        raise UserError(
            f"this policy is made of code, {values['named']}, which is not loaded because a file names it: add "
            f"--base {values['named']} if you trust that code"
        )
    return policy_of(code, actions_of(env))


def _unread(values: dict[str, Any], env: Any, family: Any) -> Read:
    sizes = values["labels"], values["mixed"]
    return unread(None, actions_of(env), family, env.obs_size, *sizes, named=values["code"])


def _agent(values: dict[str, Any], spaces: Spaces) -> AgentFunctions:
    """Return an agent's functions. Raises UserError if no agent of that name is known."""
    return part_from_json("agent", values["agent"]).make(values["frame"], spaces)


def _guidance(values: dict[str, Any], env: Any) -> Guide:
    """Return the guide of a guided policy. Raises UserError if no kind of that name is known."""
    name = values["guidance"]
    if name not in guidances.guides():
        raise UserError(
            f"the policy is under a guidance from outside, {name!r}: name its code by --guidance package.module:NAME, "
            "if you trust that code"
        )
    sizes, options = configuration.from_json(GuideSizes, values["sizes"]), kind_from_json(name, values["options"])
    return guidances.make(name, sizes, env, options)
