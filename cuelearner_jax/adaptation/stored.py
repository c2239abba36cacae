"""Policies as plain values and arrays, and back.

A policy's values are those of its `describe()`. Kept are an `agent` with its `params`; `guided` with its `model` and,
where there is one, its `bound`; `uniform`; `heuristic`; and the name of `code`, as package.module:NAME.

Code is never loaded because a file names it: whoever opens the policy gives it again.
"""

from __future__ import annotations

from typing import Any, get_args

import jax
import jax.numpy as jnp

from cuelearner_jax import config as configuration
from cuelearner_jax.agents.protocol import AgentFunctions
from cuelearner_jax.agents.registry import AGENTS
from cuelearner_jax.config import Frame, GuideSizes, Scalars, check_guide, check_part
from cuelearner_jax.environment import Spaces, offers, spaces_of, view_of
from cuelearner_jax.errors import UserError
from cuelearner_jax.guides import registry as guidances
from cuelearner_jax.guides.base import NAME
from cuelearner_jax.policies import Agent, Guided, Heuristic, describe, layers, uniform_in
from cuelearner_jax.run_config import kind_from_json, part_from_json

Told = dict[str, Any]
KINDS = ("agent", "uniform", "heuristic", "guided", "code")
PARTS = ((GuideSizes, "sizes"), (Scalars, "scalars"))  # of a guided policy's values
DERIVED = ("clip_radius_deg", "fitted")  # of a description: the other values and the arrays say them already
MOST_LAYERS = 16  # of a policy that was adapted again and again


def told(policy: Any, named: str | None = None) -> Told:
    """A policy, or a block of them, as plain values.

    Args:
        policy: the policy.
        named: how the code in it is named, if there is any.

    Raises:
        UserError: it asks a teacher, or is refined in a way that cannot be kept.
    """
    described = describe(policy)
    for layer in layers(described):
        if layer.get("asks"):
            raise UserError("a policy that asks a teacher cannot be kept in a folder: give one that acts by itself")
        if layer["policy"] not in KINDS:
            raise UserError(f"a policy of kind {layer['policy']} cannot be kept in a folder: give another")
        if layer["policy"] == "guided" and layer["sizes"] is None:
            raise UserError("a policy under a guidance of unknown sizes cannot be kept in a folder: give them as sizes")
        if layer["policy"] == "code":
            layer["named"] = named or "code"
        for name in DERIVED:
            layer.pop(name, None)
    return described


def check(values: Told, outermost: bool = True, depth: int = MOST_LAYERS) -> None:
    """Whether plain values from a file say what a policy is made of.

    Args:
        values: as `told` gives them.
        outermost: is it the policy itself, not one that it refines?
        depth: layers that it may have.

    Raises:
        UserError: a size or scalar that cannot work.
        ValueError, TypeError, KeyError, AttributeError: anything else that `told` would not have written.
    """
    kind = values["policy"]
    if kind not in (("guided",) if outermost else KINDS) or not depth:
        raise ValueError(f"{kind!r} is no policy here")
    if kind == "agent":
        check_part(part_from_json(AGENTS, values["agent"]), "agent")
        if set(values) != {"policy", "agent", "frame"} or values["frame"] not in get_args(Frame):
            raise ValueError(f"an agent is told by {sorted(values)}, in the frame {values.get('frame')!r}")
    if kind == "code" and not isinstance(values["named"], str):
        raise TypeError(f"code is named {values['named']!r}")
    if kind == "guided":
        sizes, scalars = (configuration.from_json(of, values[part]) for of, part in PARTS)
        check_guide(sizes, scalars)
        if not NAME.fullmatch(values["guidance"]) or type(values["bounded"]) is not bool:
            raise ValueError(f"a guidance is called {values['guidance']!r}, and bounded {values['bounded']!r}")
        kind_from_json(values["guidance"], values["options"])
        check(values["base"], outermost=False, depth=depth - 1)


def arrays_of(policy: Any) -> Any:
    """The arrays of a policy, or of a block of them."""
    kind, policy = describe(policy)["policy"], getattr(policy, "policy", policy)  # that `Common` holds
    if kind == "agent":
        return {"params": policy.params}
    if kind == "guided":
        bound = {} if policy.bound is None else {"bound": policy.bound}
        return {"base": arrays_of(policy.base), "model": policy.model, **bound}
    return {}


def shapes_of(values: Told, env: Any, rows: int | None = None) -> Any:
    """The shapes of a policy's arrays.

    Args:
        values: from `told`.
        env: of the policy's task, shapes in place of arrays will do.
        rows: of a block of so many policies; None: of one.

    Raises:
        UserError, ValueError: the environment is none that the policy can act in.
    """
    spaces = spaces_of(env)

    def one(values: Told) -> Any:
        if values["policy"] == "agent":
            return {"params": _agent(values, spaces).init(jax.random.key(0))[0]}
        if values["policy"] == "guided":
            bound = {"bound": jnp.zeros(())} if values["bounded"] else {}
            return {"base": one(values["base"]), "model": _guidance(values, env).init(jax.random.key(0)), **bound}
        return {}

    shapes = jax.eval_shape(lambda: one(values))
    leading = () if rows is None else (rows,)
    return jax.tree.map(lambda leaf: jax.ShapeDtypeStruct((*leading, *leaf.shape), leaf.dtype), shapes)


def made(values: Told, arrays: Any, env: Any, code: Any = None) -> Any:
    """The policy of plain values and arrays; the inverse of `told` and `arrays_of`.

    Args:
        values: from `told`.
        arrays: of one policy, or of a block of them.
        env: where it is to act.
        code: the policy that stands for `code` (see `policies.policy_of`).

    Raises:
        UserError: the policy's code was not given, or it needs what the environment has not.
        KeyError, TypeError, ValueError: the values make no sense.
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
        base = made(values["base"], arrays["base"], env, code)
        sizes, scalars = (configuration.from_json(of, values[part]) for of, part in PARTS)
        return Guided(base, arrays["model"], view_of(env), scalars, _guidance(values, env), arrays.get("bound"), sizes)
    if kind == "code":
        if code is None:
            raise UserError(
                f"this policy is made of code, {values['named']}, which is not loaded because a file names it: add "
                f"--base {values['named']} if you trust that code"
            )
        return code
    raise ValueError(f"{kind!r} is no policy")


def _agent(values: Told, spaces: Spaces) -> AgentFunctions:
    """The functions of an agent. Raises UserError if it is not known here."""
    return part_from_json(AGENTS, values["agent"]).make(values["frame"], spaces)


def _guidance(values: Told, env: Any) -> Any:
    """The guide of a guided policy. Raises UserError if its kind is not known here."""
    name = values["guidance"]
    if guidances.registered(name) is None:
        raise UserError(
            f"the policy is under a guidance from outside, {name!r}: name its code by --guidance package.module:NAME, "
            "if you trust that code"
        )
    sizes, options = configuration.from_json(GuideSizes, values["sizes"]), kind_from_json(name, values["options"])
    return guidances.make(name, sizes, env, options)
