"""Check the arguments of the public API. Each function returns its argument ready for use, or raises UserError.

Every function takes the argument's name and its value. Its UserError is one line that says what was given and what is
wanted. The functions check values alone and compile nothing.
"""

from __future__ import annotations

import operator
import os
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Float, PRNGKeyArray

from cuelearner_jax.config import LARGEST_FLOAT, normalize_options, plain
from cuelearner_jax.errors import UserError, format_value, suggestion
from cuelearner_jax.policies import Policy, policy_of, teaching
from cuelearner_jax.runs.grid import LARGEST_BUDGET, LARGEST_SEED
from cuelearner_jax.spaces import Space
from cuelearner_jax.types import Teacher

LONGEST = 200  # characters of a name

FoundT = TypeVar("FoundT")
KindT = TypeVar("KindT")


def argument_error(name: str, value: Any, wanted: str) -> UserError:
    """Return the UserError for an argument: its name, the given value, and what is wanted."""
    return UserError(f"{name} is {format_value(value)}: give {wanted}")


def optional(check: Callable[..., FoundT], name: str, value: Any, *more: Any) -> FoundT | None:
    """Return an argument that may be left out (None), else the result of `check`."""
    return None if value is None else check(name, value, *more)


def instance(name: str, value: Any, kind: type[KindT], wanted: str) -> KindT:
    """Return an object of a class; `wanted` says where such an object comes from."""
    if not isinstance(value, kind):
        raise argument_error(name, value, wanted)
    return value


def flag(name: str, value: Any) -> bool:
    """Return True or False; numbers such as 1 are refused."""
    return bool(instance(name, value, bool | np.bool_, "True or False"))  # pyright: ignore[reportArgumentType]


def text(name: str, value: Any, known: Iterable[str] = ()) -> str:
    """Return a word; if `known` words are given, it must be one of these."""
    if not isinstance(value, str) or not 0 < len(value) <= LONGEST or not value.isprintable():
        raise argument_error(name, value, f"a name, in up to {LONGEST} printable characters")
    if (known := list(known)) and value not in known:
        raise UserError(f"{name} is {format_value(value)}{suggestion(value, known)}")
    return value


def whole(name: str, value: Any, least: int, most: int) -> int:
    """Return a whole number between two bounds, both included."""
    try:
        number = None if isinstance(value, bool) else operator.index(value)
    except TypeError:
        number = None
    if number is None or not least <= number <= most:
        raise argument_error(name, value, f"a whole number from {least} to {most:,}")
    return number


def seed(name: str, value: Any) -> int:
    """Return a seed: a whole number."""
    return whole(name, value, 0, LARGEST_SEED - 1)


def budget(name: str, value: Any, least: int = 1) -> int:
    """Return a number of labels."""
    return whole(name, value, least, LARGEST_BUDGET - 1)


def amount(name: str, value: Any, space: Space) -> float:
    """Return a strength or a bound, above 0 and up to a space's reach, in the space's unit."""
    return number(name, value, space.reach, f"a number above 0 and up to {space.reach:g} ({space.unit})")


def number(name: str, value: Any, most: float, wanted: str) -> float:
    """Return a number above 0, up to a bound."""
    found = plain(value)
    if isinstance(found, bool) or not isinstance(found, int | float) or not 0 < found <= most:  # NaN is neither
        raise argument_error(name, value, wanted)
    return float(found)


def several(name: str, values: Any, of_what: str) -> list[Any]:
    """Return the values of a list, tuple, range or array of one axis; text is refused."""
    if not isinstance(values, list | tuple | range) and getattr(values, "ndim", None) != 1:
        raise argument_error(name, values, f"a list of {of_what}")
    return list(values)


def path(name: str, value: Any) -> Path:
    """Return the path of a file, which need not exist."""
    given = os.fspath(value) if isinstance(value, str | os.PathLike) else None
    if not isinstance(given, str) or not given or "\0" in given:
        raise argument_error(name, value, "a path, as text or pathlib.Path")
    try:
        given.encode()
        Path(given).exists()
    except (OSError, UnicodeError) as error:
        why = getattr(error, "strerror", None) or "its name is not UTF-8"
        raise UserError(f"{name} cannot be a path ({why}): give another path") from error
    return Path(given)


def key(name: str, value: Any) -> PRNGKeyArray:
    """Return one random key, typed or of the older raw kind."""
    if isinstance(value, jax.Array):  # traced ones too
        typed = jnp.issubdtype(value.dtype, jax.dtypes.prng_key)
        if value.shape == (() if typed else (2,)) and (typed or value.dtype == jnp.uint32):
            return value
    raise argument_error(name, value, "a key, as jax.random.key(0) gives it")


def tree_like(name: str, value: Any, shapes: Any) -> Any:
    """Return a tree of arrays with these shapes and without more axes."""
    leaves, structure = jax.tree.flatten(value)
    wanted, known = jax.tree.flatten(shapes)
    if structure != known or not all(map(_is_like, leaves, wanted)):
        raise argument_error(name, value, "a state of this world, as its reset and step give them")
    return value


def _is_like(leaf: Any, shape: Any) -> bool:
    counts = isinstance(leaf, bool | int | float | jax.Array)  # traced ones too
    of_numpy = isinstance(leaf, np.ndarray | np.generic) and leaf.dtype.kind in "biuf"
    return (counts or of_numpy) and np.shape(leaf) == shape.shape


def numbers(name: str, value: Any) -> Float[np.ndarray, "..."]:
    """Return numbers of any shape, all finite in single precision."""
    try:
        found = np.asarray(value)
    except Exception:  # rows of different lengths, an array of JAX's that was deleted, whatever else can be no array
        found = np.empty(0, object)
    if found.dtype.kind not in "fiu" and not jnp.issubdtype(
        found.dtype, jnp.floating
    ):  # NumPy has no kind for bfloat16
        raise argument_error(name, value, "an array of real numbers")
    if isinstance(value, np.ma.MaskedArray) and np.ma.getmaskarray(value).any():
        raise UserError(f"{name} is an array with masked numbers: leave these rows out")
    if not (np.abs(found.astype(np.float64)) <= LARGEST_FLOAT).all():
        raise UserError(f"{name} holds numbers that are not finite (in single precision): leave these rows out")
    return found.astype(np.float32)


def observations(name: str, value: Any, size: int | None) -> Float[np.ndarray, "*n obs"]:
    """Return one observation (size,) or many (n, size); `size` None: any size above 0."""
    rows = numbers(name, value)
    width = "obs" if size is None else size
    if rows.ndim not in (1, 2) or rows.shape[-1] != (rows.shape[-1] if size is None else size) or not rows.shape[-1]:
        raise UserError(f"{name}: observations have shape {rows.shape}: give ({width},) or (n, {width})")
    return rows


def action(name: str, value: Any, space: Space) -> Any:
    """Return one action, which may be traced."""
    if isinstance(value, Tracer):
        return value
    found = numbers(name, value)
    if found.shape != (space.size,) or not space.usable(found, np):
        example = np.asarray(space.spread(4))[0].round(2).tolist()
        raise argument_error(name, value, f"an action of shape ({space.size},), for instance {example}")
    return found


def policy(name: str, value: Any) -> Policy:
    """Return anything that acts as a policy: see `policies.policy_of`."""
    try:
        return policy_of(value)
    except UserError as error:
        raise UserError(f"{name}: {error}") from error


def teacher(name: str, value: Any, space: Space) -> Teacher:
    """Return a teacher: the given one, or one that shows what a given policy does itself."""
    answers, acts = (callable(getattr(value, verb, None)) for verb in ("best_action", "act"))
    # not a pytree, so no compiled program could take it
    leaf = answers and any(leaf is value for leaf in jax.tree.leaves(value))
    if isinstance(value, type) or leaf or not (answers or acts or callable(value)):
        raise argument_error(name, value, "a teacher, for instance teacher_of(world), or a function of observations")
    if acts and not answers:
        value = getattr(value, "policy", value)  # for a `CallablePolicy`, which is above this module
    try:
        return teaching(value, space)
    except UserError as error:
        raise UserError(f"{name}: {error}") from error


def settings(name: str, value: Any, kind: type[KindT]) -> KindT:
    """Return a group of settings whose fields have values of the right types.

    Bounds are checked where they are used.
    """
    return normalize_options(instance(name, value, kind, f"a cuelearner_jax.config.{kind.__name__}"), name)
