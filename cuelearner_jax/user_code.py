"""Errors of the user's own policies, teachers and environments: exceptions, and invalid actions.

An exception of the user's code keeps its own traceback. A function that is called back on the host leaves its exception
here and returns NaN, because exceptions that leave a compiled program are long and unclear. Code that reads a program's
results on the host asks here first.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any, ParamSpec, TypeVar

import jax
import numpy as np

from cuelearner_jax.devices import fixed_numerics
from cuelearner_jax.errors import UserCodeError, UserError

P = ParamSpec("P")
T = TypeVar("T")

_left: list[BaseException] = []  # errors left by functions on the host, which other threads call


def leave(error: BaseException) -> None:
    """Keep the exception of a function on the host until `tell` is called."""
    _left.append(error)


def is_waiting() -> bool:
    """Return whether a function on the host has failed since `tell` was last called."""
    return bool(_left)


def tell() -> None:
    """Raise the first exception that a function on the host left, if there is one, and forget all of them."""
    if _left:
        first = _left[0]
        _left.clear()
        raise first


def report_user_errors(function: Callable[P, T]) -> Callable[P, T]:
    """Return a public function that computes with fixed numerics, and raises what functions on the host left."""

    @functools.wraps(function)
    def wrapped(*arguments: P.args, **named: P.kwargs) -> T:
        try:
            with fixed_numerics():
                found = function(*arguments, **named)
            tell()
            return found
        except Exception:
            tell()
            raise
        finally:
            _left.clear()

    return wrapped


def acts_in(name: str, policy: Any, env: Any) -> None:
    """Raise UserError for a policy that cannot act in a world, without acting."""
    _tried(name, "act", env, policy.act)


def answers_in(name: str, teacher: Any, env: Any) -> None:
    """Raise UserError for a teacher that cannot answer in a world, without asking."""
    _tried(name, "answer", env, lambda key, states, obs: jax.vmap(teacher.best_action)(states, obs))


def _tried(name: str, verb: str, env: Any, function: Any) -> None:
    """Trace a function of a key, states (1, ...) and observations (1, obs) of a world."""
    own = jax.random.key(0)
    states, obs = jax.eval_shape(lambda: jax.vmap(env.reset)(own[None]))
    try:
        jax.eval_shape(function, own, states, obs)
    except UserError as error:
        if name in str(error):
            raise
        raise type(error)(f"{name}: {error}") from error.__cause__
    except Exception as error:
        raise UserCodeError(
            f"{name} cannot {verb} in this world, whose observations have {obs.shape[-1]} entries: "
            f"{type(error).__name__}: {' '.join(str(error).split())[:200]}"
        ) from error


def check_actions(actions: Any, whose: str) -> None:
    """Raise UserError unless all of a program's actions are finite.

    Args:
        actions: on the host, of any shape; or whether all of them are finite.
        whose: for the message, for instance "policy my_policy".
    """
    tell()
    found = np.asarray(actions)
    if not (found if found.dtype == bool else np.isfinite(found)).all():
        raise UserError(f"{whose} gave actions that are not finite, or zero: give a direction in every situation")
