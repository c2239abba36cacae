"""Policies from the user's own functions, and the names of policies in messages."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from functools import lru_cache, partial
from typing import Any, cast

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax.core import Tracer
from jaxtyping import Array, Float, PRNGKeyArray

from cuelearner_jax import types, user_code
from cuelearner_jax.errors import UserError, format_value, user_code_error
from cuelearner_jax.policies import foreign
from cuelearner_jax.policies.node import PolicyNode
from cuelearner_jax.spaces import DIRECTIONS, Box, Choices, Space
from cuelearner_jax.types import EnvState

TRIED = 32  # observations in the largest batch with which a function is tried
# Largest differences of equal actions, as shares of an entry's range: asked again, and in two batches, whose sums are
# rounded in another order (two bits of bfloat16).
REPEATED, BATCHED = 1e-4, 0.005


class Opaque(PolicyNode):
    """Any function of a batch of observations: of JAX arrays, or, `on_host`, of NumPy arrays in plain Python.

    The returned actions (n, action) are retracted to the space: unit vectors, or within bounds. A function on the host
    is called back from compiled programs (`jax.pure_callback`): it must give the same for the same observations.
    """

    function: Callable[[Any], Any] = struct.field(pytree_node=False)
    on_host: bool = struct.field(pytree_node=False, default=False)
    actions: Space = struct.field(pytree_node=False, default=DIRECTIONS)

    def act(self, key: PRNGKeyArray, states: EnvState, obs: Float[Array, "n obs"]) -> Float[Array, "n action"]:
        """Return the function's actions. Raises UserError if they have another shape."""
        if self.on_host:
            # Tried while tracing, so that a fault is reported before anything is compiled.
            with jax.ensure_compile_time_eval():  # the function may compute with JAX itself
                _try(cast(Any, self), obs.shape[-1])
            if isinstance(obs, Tracer):
                shape = jax.ShapeDtypeStruct((obs.shape[0], self.actions.size), jnp.float32)
                chosen = jax.pure_callback(self._called_back, shape, obs, vmap_method="expand_dims")
            else:  # called here: one that computes with JAX would wait for the program that waits for it
                chosen = jnp.asarray(self._called_back(np.asarray(obs)))
        else:
            chosen = self._checked(self.function(obs), obs.shape[0], jnp.asarray)
        return _valid(self.actions, chosen)

    def _compare(self, actions: np.ndarray, others: np.ndarray, most: float, when: str) -> None:
        """Raise UserError for actions (..., action) that differ by more than a share `most` of an entry's range."""
        entries = np.subtract(self.actions.high, self.actions.low) if isinstance(self.actions, Box) else 1.0
        apart = np.abs(np.asarray(self.actions.retract(actions)) - np.asarray(self.actions.retract(others)))
        if (apart > most * entries).any():
            raise UserError(
                f"{policy_name(self)} does not repeat itself: the same observation gets another action {when}; give a "
                "policy without memory and sampling, as model.predict(obs, deterministic=True)"
            )

    def _called_back(self, obs: Any) -> np.ndarray:
        """Return the function's actions; NaN once it has failed, which `user_code` reports after the program."""
        nothing = np.full((*obs.shape[:-1], self.actions.size), np.nan, np.float32)
        if user_code.is_waiting():
            return nothing
        try:
            chosen = self._called(np.asarray(obs))
            usable = self.actions.usable(chosen, np)
            if not usable.all():
                count = f"{(~usable).sum()} of {usable.size}"
                raise UserError(
                    f"{policy_name(self)} gave zero or not finite numbers in place of actions, in {count} situations"
                )
            return chosen
        except BaseException as error:  # one that left the compiled program would be an error of XLA's
            user_code.leave(error)
            return nothing

    def _called(self, rows: np.ndarray) -> np.ndarray:
        """Call the function with a batch of any leading axes. Raises UserError for any exception of the function."""
        flat = rows.reshape(-1, rows.shape[-1])
        try:
            chosen = self.function(flat)
        except UserError:
            raise
        except (Exception, SystemExit) as error:
            raise user_code_error(policy_name(self), error) from error
        return self._checked(chosen, len(flat), np.asarray).reshape(*rows.shape[:-1], self.actions.size)

    def _checked(self, chosen: Any, rows: int, as_array: Callable[..., Any]) -> Any:
        """Return the function's result as an array of real numbers.

        Of a pair of actions and None (models of Stable-Baselines3), or a dictionary (of brax), the actions are taken.
        Whole numbers in a space of choices are numbers of choices.
        """
        name, wanted = policy_name(self), (rows, self.actions.size)
        if isinstance(chosen, tuple) and len(chosen) == 2 and (chosen[1] is None or np.ndim(chosen[0]) == 2):
            if not isinstance(chosen[1], dict | None):
                raise foreign.memory_error(name)
            chosen = chosen[0]
        try:
            found = as_array(chosen)
        except Exception as error:  # PyTorch's own kinds too
            why = " ".join(str(error).split())[:200]
            raise UserError(
                f"{name} returned {format_value(chosen)} ({why}): return an array of shape {wanted}"
            ) from error
        is_whole = jnp.issubdtype(found.dtype, jnp.integer)
        if not is_whole and not jnp.issubdtype(found.dtype, jnp.floating):
            raise UserError(f"{name} returned {found.dtype} numbers: return real ones, of shape {wanted}")
        if isinstance(self.actions, Choices) and found.shape == (rows,) and is_whole:
            inside = (found >= 0) & (found < self.actions.size)
            if isinstance(inside, np.ndarray) and not inside.all():
                raise UserError(
                    f"{name} chose {found[~inside][0]}: give the number of a choice, 0 to {self.actions.size - 1}, "
                    "whatever number the environment starts from"
                )
            one_hot = as_array(found[:, None] == np.arange(self.actions.size)).astype(np.float32)
            return one_hot if isinstance(inside, np.ndarray) else jnp.where(inside[:, None], one_hot, jnp.nan)
        if found.shape != wanted:
            raise UserError(f"{name} returned actions of shape {found.shape} for {rows} observations: return {wanted}")
        with np.errstate(over="ignore"):
            return found.astype(np.float32)

    def describe(self) -> dict[str, Any]:
        """Return the description of code, with the function's name."""
        return {"policy": "code", "named": _called(self.function)}


@lru_cache(maxsize=64)  # once for each function
def _try(policy: Opaque, size: int) -> None:
    """Raise UserError for a function that does not repeat its actions, or whose actions depend on the batch.

    Two observations are asked about in turn, each alone, and then among others: `TRIED` in all.
    """
    rows = np.random.default_rng(0).random((TRIED, size), np.float32)
    alone = np.concatenate([policy._called(rows[place : place + 1]) for place in (0, 1, 0, 1)])
    policy._compare(alone[:2], alone[2:], REPEATED, "when it is asked again")
    among = policy._called(rows)
    policy._compare(among, policy._called(rows), REPEATED, "when it is asked again")
    policy._compare(alone[:2], among[:2], BATCHED, f"in a batch of {TRIED}")


@partial(jax.jit, static_argnums=0)
def _valid(actions: Space, chosen: Array) -> Array:
    return actions.retract(actions.only_actions(chosen))


def call_policy(
    policy: types.Policy, key: PRNGKeyArray, states: EnvState, obs: Float[Array, "n obs"], actions: Space
) -> Float[Array, "n action"]:
    """Return a policy's actions, NaN in place of each invalid one. Raises UserError for another shape."""
    chosen, wanted = jnp.asarray(policy.act(key, states, obs)), (obs.shape[0], actions.size)
    if chosen.shape != wanted:
        raise UserError(f"{policy_name(policy)} returned actions of shape {chosen.shape}: return {wanted}")
    return actions.only_actions(chosen)


def policy_name(policy: Any) -> str:
    """Return a policy's name for a message: that of the user's function or class below all layers."""
    while (below := getattr(policy, "base", None) or getattr(policy, "policy", None)) is not None:
        policy = below
    return f"policy {_called(getattr(policy, 'function', type(policy)))}"


def _called(code: Any) -> str:
    """Return the qualified name of a function or class."""
    return getattr(code, "__qualname__", type(code).__qualname__).replace("<locals>.", "")


def policy_of(given: Any, space: Space | None = None) -> Any:
    """Return anything that acts as a policy.

    Args:
        given: a policy; a class or function that gives one when it is called with nothing; a function of a batch of
            observations: one that `jax.jit` made is compiled with what calls it, any other gets NumPy arrays; or a
            policy of another library, see `foreign.function_of`.
        space: the space of the actions of a function (None: not known yet).

    Raises:
        UserError: the object is none of these, a policy that is not a pytree, or a model of another library that is
            known to give other actions than those of the space.
    """
    function = foreign.function_of(given)
    if function is None and not _acts(given) and _required(given) == []:
        try:
            given = given()
        except (Exception, SystemExit) as error:
            raise user_code_error(f"policy {_called(given)}", error) from error
        function = foreign.function_of(given)
    policy = given if function is None else Opaque(function, on_host=True)
    if _acts(policy):
        if any(leaf is policy for leaf in jax.tree.leaves(policy)):
            kind = type(policy).__name__
            raise UserError(
                f"a {kind} has `act` but is not a pytree: make it a flax.struct.PyTreeNode, or give a function"
            )
    elif callable(given) and not isinstance(given, type):
        if len(more := _required(given) or ()) > 1:
            raise UserError(
                f"policy {_called(given)} takes {', '.join(more)}: give a function of observations alone, for instance "
                f"jax.jit(lambda obs: policy(obs, {', '.join(more[1:])})[0])"
            )
        policy = Opaque(given, on_host=not isinstance(given, jax.stages.Wrapped))
    else:
        raise UserError(
            f"{format_value(given)} is no policy: give a function of observations (n, obs), a module of PyTorch, a "
            "model of Stable-Baselines3 or a file in ONNX, or load one"
        )
    if space is None or not isinstance(policy, Opaque):
        return policy
    if isinstance(policy.function, foreign.Foreign):
        policy.function.check(space)
    return policy.replace(actions=space)


def _acts(given: Any) -> bool:
    return hasattr(given, "act") and not isinstance(given, type)


def _required(given: Any) -> list[str] | None:
    """Return the names of the arguments that an object cannot be called without; None: not known, or any number."""
    try:
        parameters = inspect.signature(given).parameters.values()
    except (TypeError, ValueError):  # not callable, or compiled code
        return None
    if any(one.kind in (one.VAR_POSITIONAL, one.VAR_KEYWORD) for one in parameters):
        return None
    return [one.name for one in parameters if one.default is one.empty]
