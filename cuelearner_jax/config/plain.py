"""Convert configurations to plain JSON values, and back."""

from __future__ import annotations

import dataclasses
import hashlib
import json
from types import UnionType
from typing import Any, Literal, Union, get_args, get_origin, get_type_hints

import jax
import numpy as np
from jax.core import Tracer

from cuelearner_jax.errors import UserError


def plain(given: Any) -> Any:
    """Return numbers of NumPy and JAX as Python's, lists and arrays as tuples, and any other value unchanged."""
    if isinstance(given, list | tuple):
        return tuple(map(plain, given))
    if isinstance(given, np.ndarray | np.generic | jax.Array) and not isinstance(given, Tracer):
        found = given.tolist()
        return tuple(found) if isinstance(found, list) else found
    return given


def to_json(config: Any) -> dict[str, Any]:
    """Return a configuration as plain JSON values."""
    return json.loads(json.dumps(dataclasses.asdict(config)))


def from_json(kind: type, values: dict[str, Any]) -> Any:
    """Return a flat configuration dataclass (Sizes, Scalars, Schedule, a task's) from JSON values; lists become tuples.

    Raises UserError for an unknown field, or a value of another type than its field's.
    """
    types, known = get_type_hints(kind), {field.name for field in dataclasses.fields(kind)}
    values = {name: tuple(value) if isinstance(value, list) else value for name, value in values.items()}
    for name, value in values.items():
        if name not in known or not fits(value, types[name]):
            raise UserError(f"{name} is {value!r} in a file of another version of cuelearner or of the task")
    return kind(**values)


def fits(value: Any, kind: Any) -> bool:
    """Return whether a value has a field's type. For types that no configuration uses, every value fits."""
    origin, parts = get_origin(kind), get_args(kind)
    if origin is Literal:
        return any(type(value) is type(choice) and value == choice for choice in parts)
    if origin in (Union, UnionType):
        return any(fits(value, part) for part in parts)
    if origin is tuple:
        parts = parts[:1] * len(value) if isinstance(value, tuple) and parts[1:] == (...,) else parts
        return isinstance(value, tuple) and len(value) == len(parts) and all(map(fits, value, parts))
    if kind in (int, float):
        return (type(value) is int and abs(value) < 1 << 63) or (kind is float and type(value) is float)
    return isinstance(value, kind) if isinstance(kind, type) else True


def defaults(kind: type) -> dict[str, Any]:
    """Return the default values of a configuration dataclass's fields, as JSON values."""
    fields = [field for field in dataclasses.fields(kind) if field.init]
    plain = {field.name: field.default for field in fields if field.default is not dataclasses.MISSING}
    made = {field.name: field.default_factory for field in fields if field.default_factory is not dataclasses.MISSING}
    return json.loads(json.dumps({**plain, **{name: factory() for name, factory in made.items()}}))


def digest(values: dict[str, Any]) -> str:
    """Return a short hash of JSON values: equal configurations have equal hashes."""
    return hashlib.sha256(json.dumps(values, sort_keys=True).encode()).hexdigest()[:12]
