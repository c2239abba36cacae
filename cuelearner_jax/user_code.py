"""Errors of the user's own policies, teachers and environments: exceptions, and invalid actions.

User code runs inside compiled programs, whose exceptions are long and unclear. A function that is called back on the
host leaves its exception here and returns NaN. NaN spreads, and code that reads a program's results on the host asks
here first. Exceptions while JAX traces are recognised by the frames of their traceback. Threads may call policies at
the same time: each thread then gets only its own policy's error.
"""

from __future__ import annotations

import functools
import sysconfig
import threading
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import FrameType
from typing import Any, ParamSpec, TypeVar

import jax
import numpy as np

from cuelearner_jax.devices import fixed_numerics
from cuelearner_jax.errors import NotFinite, UserError, no_space, user_code_error

P = ParamSpec("P")
T = TypeVar("T")

# The kind of object that has a method of that name; other objects are called code.
METHODS = {"act": "policy", "best_action": "teacher", "nearest_good": "teacher"}
METHODS |= dict.fromkeys(("reset", "step", "remember", "recall", "recall_next"), "environment")
METHODS |= dict.fromkeys(("features", "aims", "heuristic", "mirror", "observation"), "environment")
_PACKAGE = Path(__file__).parent
_OURS = (_PACKAGE, *(_PACKAGE.parent / place / "cuelearner_envs" for place in ("", "envs")))
_LIBRARIES = tuple(Path(sysconfig.get_path(name)) for name in ("stdlib", "purelib", "platlib"))

_left: dict[
    str, UserError
] = {}  # errors left by functions on the host, which other threads call; by their names in messages
_working: Counter[int] = Counter()  # calls of `report_user_errors` functions at work, by thread
_counting = threading.Lock()


def leave(whose: str, error: UserError) -> None:
    """Keep the exception of a function on the host until `tell` is called; of several of one function, the first."""
    _left.setdefault(whose, error)


def is_waiting() -> bool:
    """Return whether a function on the host has failed since `tell` was last called, if no other thread works."""
    return bool(_left) and _is_alone()


def tell(whose: str = "") -> None:
    """Raise the UserError that a function on the host left, if there is one, and forget all of them.

    While other threads work, only the error of the policy `whose` is raised and forgotten.
    """
    names = list(_left) if _is_alone() else [whose] if whose in _left else []
    first = [error for name in names if (error := _left.pop(name, None))][:1]
    if first:
        raise first[0]


def _is_alone() -> bool:
    with _counting:
        return len(_working) <= 1


@contextmanager
def _at_work() -> Iterator[None]:
    own = threading.get_ident()
    with _counting:
        _working[own] += 1
        if len(_working) == 1 and _working[own] == 1:
            _left.clear()
    try:
        yield
    finally:
        with _counting:
            _working[own] -= 1
            if not _working[own]:
                del _working[own]


def report_user_errors(function: Callable[P, T]) -> Callable[P, T]:
    """Return a public function that computes with fixed numerics, and reports faults of the user's code in one line.

    The UserError has the original as `__cause__`.
    """

    @functools.wraps(function)
    def wrapped(*arguments: P.args, **named: P.kwargs) -> T:
        with _at_work(), fixed_numerics():
            try:
                found = function(*arguments, **named)
            except Exception as error:
                tell()
                raise_in_one_line(error)
                raise
            tell()
            return found

    return wrapped


def raise_in_one_line(error: Exception) -> None:
    """Raise a UserError from an exception of the user's own code; do nothing for any other exception.

    A full disk is not a fault of the code that met it.
    """
    if isinstance(error, UserError | NotFinite) or no_space(error):
        return
    if code := _of_user(error):
        name = getattr(code, "co_qualname", code.co_name)
        role = METHODS.get(code.co_name, "code")
        raise user_code_error(f"{role} {name.replace('<locals>.', '')}", error) from error


def _of_user(error: BaseException) -> Any:
    """Return the code of the user's function that was called first on the way to an exception; None: there is none."""
    step = error.__traceback__
    while step is not None:
        if _is_users(step.tb_frame):
            return step.tb_frame.f_code
        step = step.tb_next
    return None


def _is_users(frame: FrameType) -> bool:
    file = frame.f_code.co_filename
    if file.startswith("<frozen") or not frame.f_globals.get("__name__", ""):
        return False
    return not any(Path(file).is_relative_to(place) for place in (*_OURS, *_LIBRARIES))


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
        raise UserError(f"{name}: {error}") from error
    except Exception as error:
        raise_in_one_line(error)
        raise UserError(
            f"{name} cannot {verb} in this world, whose observations have {obs.shape[-1]} entries: give one made for it"
        ) from error


def check_actions(actions: Any, whose: str) -> None:
    """Raise UserError unless all of a program's actions are finite.

    Args:
        actions: on the host, of any shape; or whether all of them are finite.
        whose: for the message, for instance "policy my_policy".
    """
    tell(whose)
    found = np.asarray(actions)
    if not (found if found.dtype == bool else np.isfinite(found)).all():
        raise UserError(f"{whose} gave actions that are not finite, or zero: give a direction in every situation")
