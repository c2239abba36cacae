"""Errors of the user's own policies, teachers and environments: exceptions, and invalid actions.

A function that is called back on the host leaves its exception here and returns NaN, because JAX logs an exception that
leaves a compiled program, and loses its traceback. Code that reads a program's results on the host asks here first.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any, ParamSpec, TypeVar

import numpy as np

from cuelearner_jax.devices import fixed_numerics
from cuelearner_jax.errors import UserError

P = ParamSpec("P")
T = TypeVar("T")

_errors: list[BaseException] = []  # errors left by functions on the host, which other threads call


def leave(error: BaseException) -> None:
    """Keep the exception of a function on the host until `tell` is called."""
    _errors.append(error)


def is_waiting() -> bool:
    """Return whether a function on the host has failed since `tell` was last called."""
    return bool(_errors)


def tell() -> None:
    """Raise the first exception that a function on the host left, if there is one, and forget all of them."""
    if _errors:
        first, *_ = _errors
        _errors.clear()
        raise first


def report_user_errors(function: Callable[P, T]) -> Callable[P, T]:
    """Return a public function that computes with fixed numerics, and raises what functions on the host left."""

    @functools.wraps(function)
    def wrapped(*arguments: P.args, **keywords: P.kwargs) -> T:
        try:
            with fixed_numerics():
                return function(*arguments, **keywords)
        finally:
            tell()

    return wrapped


def check_actions(actions: Any, whose: str) -> None:
    """Raise UserError unless all of a program's actions are finite; `actions` may also be whether they are.

    `whose`: for the message, for instance "policy my_policy".
    """
    tell()
    actions = np.asarray(actions)
    if not (actions if actions.dtype == bool else np.isfinite(actions)).all():
        raise UserError(f"{whose} gave actions that are not finite, or directions of length 0: give actions everywhere")
