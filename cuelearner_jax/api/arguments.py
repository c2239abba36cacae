"""Arguments of the face, checked at the door: each function returns its argument ready for use, or names it.

Every function takes the argument's name and its value, and raises UserError with one line that says what was given and
what is wanted. They look at values alone and compile nothing.
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
    """Build the error for an argument: what was given, and what is wanted."""
    return UserError(f"{name} is {format_value(value)}: give {wanted}")


def optional(check: Callable[..., FoundT], name: str, value: Any, *more: Any) -> FoundT | None:
    """An argument that may be left out (None), else as `check` has it."""
    return None if value is None else check(name, value, *more)


def instance(name: str, value: Any, kind: type[KindT], wanted: str) -> KindT:
    """An object of a class; `wanted` says where one comes from."""
    if not isinstance(value, kind):
        raise argument_error(name, value, wanted)
    return value


def flag(name: str, value: Any) -> bool:
    """True or False, and nothing that merely counts as such."""
    return bool(instance(name, value, bool | np.bool_, "True or False"))  # pyright: ignore[reportArgumentType]


def text(name: str, value: Any, known: Iterable[str] = ()) -> str:
    """A word: one of those that are known, if any are named."""
    if not isinstance(value, str) or not 0 < len(value) <= LONGEST or not value.isprintable():
        raise argument_error(name, value, f"a name, in up to {LONGEST} printable characters")
    if (known := list(known)) and value not in known:
        raise UserError(f"{name} is {format_value(value)}{suggestion(value, known)}")
    return value


def whole(name: str, value: Any, least: int, most: int) -> int:
    """A whole number between two bounds, both of which it may be."""
    try:
        number = None if isinstance(value, bool) else operator.index(value)
    except TypeError:
        number = None
    if number is None or not least <= number <= most:
        raise argument_error(name, value, f"a whole number from {least} to {most:,}")
    return number


def seed(name: str, value: Any) -> int:
    """A seed."""
    return whole(name, value, 0, LARGEST_SEED - 1)


def budget(name: str, value: Any, least: int = 1) -> int:
    """A number of labels."""
    return whole(name, value, least, LARGEST_BUDGET - 1)


def amount(name: str, value: Any, space: Space) -> float:
    """A strength or a bound, above 0 and up to a space's reach, in the space's unit."""
    return number(name, value, space.reach, f"a number above 0 and up to {space.reach:g} ({space.unit})")


def number(name: str, value: Any, most: float, wanted: str) -> float:
    """A number above 0, up to a bound."""
    found = plain(value)
    if isinstance(found, bool) or not isinstance(found, int | float) or not 0 < found <= most:  # NaN is neither
        raise argument_error(name, value, wanted)
    return float(found)


def several(name: str, values: Any, of_what: str) -> list[Any]:
    """Values in a list, tuple, range or array of one axis; no text, whose letters would be meant."""
    if not isinstance(values, list | tuple | range) and getattr(values, "ndim", None) != 1:
        raise argument_error(name, values, f"a list of {of_what}")
    return list(values)


def path(name: str, value: Any) -> Path:
    """A path, of a file that need not be there."""
    given = os.fspath(value) if isinstance(value, str | os.PathLike) else None
    if not isinstance(given, str) or not given or "\0" in given:
        raise argument_error(name, value, "a path, as text or pathlib.Path")
    try:
        given.encode()
        Path(given).exists()
    except (OSError, UnicodeError) as error:
        why = getattr(error, "strerror", None) or "its name is not UTF-8"
        raise UserError(f"{name} can be no path ({why}): give another") from error
    return Path(given)


def key(name: str, value: Any) -> PRNGKeyArray:
    """One key of random numbers, typed or as older code has it."""
    if isinstance(value, jax.Array):  # traced ones too
        typed = jnp.issubdtype(value.dtype, jax.dtypes.prng_key)
        if value.shape == (() if typed else (2,)) and (typed or value.dtype == jnp.uint32):
            return value
    raise argument_error(name, value, "a key, as jax.random.key(0) gives it")


def tree_like(name: str, value: Any, shapes: Any) -> Any:
    """A tree of arrays such as these shapes, without more axes."""
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
    """Numbers that single precision holds, of any shape, all of them finite."""
    try:
        found = np.asarray(value)
    except Exception:  # rows of different lengths, an array of JAX's that was deleted, whatever else can be no array
        found = np.empty(0, object)
    if found.dtype.kind not in "fiu" and not jnp.issubdtype(found.dtype, jnp.floating):  # bfloat16 is of no kind
        raise argument_error(name, value, "an array of real numbers")
    if isinstance(value, np.ma.MaskedArray) and np.ma.getmaskarray(value).any():
        raise UserError(f"{name} is an array with masked numbers: leave these rows out")
    if not (np.abs(found.astype(np.float64)) <= LARGEST_FLOAT).all():
        raise UserError(f"{name} holds numbers that are not finite (in single precision): leave these rows out")
    return found.astype(np.float32)


def observations(name: str, value: Any, size: int | None) -> Float[np.ndarray, "*n obs"]:
    """One observation (size,) or many (n, size); None: of any size above 0."""
    rows = numbers(name, value)
    width = "obs" if size is None else size
    if rows.ndim not in (1, 2) or rows.shape[-1] != (rows.shape[-1] if size is None else size) or not rows.shape[-1]:
        raise UserError(f"{name}: observations have shape {rows.shape}: give ({width},) or (n, {width})")
    return rows


def action(name: str, value: Any, space: Space) -> Any:
    """One action, which may be traced."""
    if isinstance(value, Tracer):
        return value
    found = numbers(name, value)
    if found.shape != (space.size,) or not space.usable(found, np):
        example = np.asarray(space.spread(4))[0].round(2).tolist()
        raise argument_error(name, value, f"an action of shape ({space.size},), for instance {example}")
    return found


def policy(name: str, value: Any) -> Policy:
    """Anything that acts as a policy, as a policy: see `policies.policy_of`."""
    try:
        return policy_of(value)
    except UserError as error:
        raise UserError(f"{name}: {error}") from error


def teacher(name: str, value: Any, space: Space) -> Teacher:
    """Who answers: a teacher, or whatever acts as a policy in a space of actions, which teaches what it does itself."""
    answers, acts = (callable(getattr(value, verb, None)) for verb in ("best_action", "act"))
    leaf = answers and any(leaf is value for leaf in jax.tree.leaves(value))  # no pytree: no program can be given it
    if isinstance(value, type) or leaf or not (answers or acts or callable(value)):
        raise argument_error(name, value, "a teacher, for instance teacher_of(world), or a function of observations")
    if acts and not answers:
        value = getattr(value, "policy", value)  # of a `CallablePolicy`, which stands above this file
    try:
        return teaching(value, space)
    except UserError as error:
        raise UserError(f"{name}: {error}") from error


def settings(name: str, value: Any, kind: type[KindT]) -> KindT:
    """A group of settings with values of its fields' types; their bounds are checked where they are used."""
    return normalize_options(instance(name, value, kind, f"a cuelearner_jax.config.{kind.__name__}"), name)
