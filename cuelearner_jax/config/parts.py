"""Options of a part (an agent, an arbiter, a kind of guidance): one frozen dataclass, bounds beside its fields.

    @part
    class Config:
        layers: Layers = (64, 64)
        \"\"\"Hidden layers.\"\"\"
        learning_rate: Annotated[float, Bounds(0)] = 0.1
        \"\"\"Step size.\"\"\"

Floats, and whole numbers annotated with `TRACED`, are traced: another value costs no new compile. All other fields
shape the program. The docstring below a field is its help on the command line.
"""

from __future__ import annotations

import dataclasses
import math
from typing import Annotated, Any, NamedTuple, TypeVar, dataclass_transform, get_args, get_origin, get_type_hints

import jax

from cuelearner_jax.config.plain import fits, plain
from cuelearner_jax.errors import UserError, format_value, suggestion

LARGEST = 2**31 - 1  # counters and indices are 32-bit integers
LARGEST_FLOAT = 3.4028234e38  # scalars are computed in single precision
TRACED = "traced"  # annotates a whole number that does not shape the program

PartT = TypeVar("PartT")


class Bounds(NamedTuple):
    """The range of numbers that a field may hold; for a tuple each of its entries."""

    least: float = -math.inf
    most: float = math.inf
    above: bool = False  # True if `least` itself is excluded

    def __contains__(self, number: object) -> bool:
        """Whether a number is within the bounds."""
        assert isinstance(number, int | float)
        return (number > self.least if self.above else number >= self.least) and number <= self.most

    def __str__(self) -> str:
        """Describe the allowed numbers for a message."""
        if math.isinf(self.most):
            return "a positive number" if self.least or self.above else "a number that is not negative"
        if self.above:
            return f"a number above {self.least:g} and up to {self.most:g}"
        return f"a number from {self.least:g} to {self.most:g}"


POSITIVE = Bounds(1)  # bounds of whole numbers
SHARE = Bounds(0, 1)
Layers = Annotated[tuple[int, ...], POSITIVE]  # hidden widths of a network


@dataclass_transform(frozen_default=True)
def part(kind: type[PartT]) -> type[PartT]:
    """Make a class a frozen dataclass of options, and a pytree of its floats."""
    made = dataclasses.dataclass(frozen=True)(kind)
    register(made)
    return made


def register(kind: type, *traced_too: type) -> None:
    """Register a dataclass as a pytree: floats, `TRACED` fields and those of `traced_too` are its leaves."""
    hints, extras = get_type_hints(kind), get_type_hints(kind, include_extras=True)
    names = [field.name for field in dataclasses.fields(kind)]
    traced = [name for name in names if hints[name] in (float, *traced_too) or TRACED in get_args(extras[name])]
    jax.tree_util.register_dataclass(kind, traced, [name for name in names if name not in traced])


def static(options: PartT) -> PartT:
    """Return the options with None in place of floats: what a program is compiled for."""
    return jax.tree.map(lambda leaf: None, options)


def check_types(group: Any, prefix: str, **changes: Any) -> dict[str, Any]:
    """Return checked values for a configuration's fields: NumPy's numbers as Python's, lists as tuples.

    Raises UserError for no such field, or a value of another type than its field's.

    Args:
        group: a configuration, or its class.
        prefix: name of the group in messages.
        changes: the values by field (default: those that the configuration holds).
    """
    fields = [field.name for field in dataclasses.fields(group) if field.init]
    kinds = get_type_hints(group if isinstance(group, type) else type(group))
    values = changes or {name: getattr(group, name) for name in fields}
    kept = {}
    for name, given in values.items():
        if name not in fields:
            raise UserError(f"{prefix} has no field {format_value(name)}{suggestion(name, fields)}")
        value = plain(given)
        kind = kinds[name]
        if not fits(value, kind):
            words = " or ".join(map(str, get_args(kind))) if str(get_origin(kind)) == "typing.Literal" else ""
            raise UserError(
                f"{prefix}.{name} is {format_value(value)}: give {words or f'a value of type {_called(kind)}'}"
            )
        kept[name] = value
    return kept


def normalize_options(group: PartT, prefix: str) -> PartT:
    """Return a configuration with its values as `check_types` returns them. Raises UserError likewise."""
    kept = check_types(group, prefix)
    changed = {name: value for name, value in kept.items() if value is not getattr(group, name)}
    return dataclasses.replace(group, **changed) if changed else group  # pyright: ignore[reportArgumentType]


def _called(kind: Any) -> str:
    return kind.__name__ if isinstance(kind, type) and not get_args(kind) else str(kind)


def check_part(group: Any, prefix: str) -> None:
    """Raise UserError for the first field of a group with a value of the wrong type or out of bounds."""
    check_types(group, prefix)
    hints = get_type_hints(type(group), include_extras=True)
    for field in dataclasses.fields(group):
        value, name = getattr(group, field.name), f"{prefix}.{field.name}"
        bounds = next((extra for extra in get_args(hints[field.name]) if isinstance(extra, Bounds)), None)
        for number in value if isinstance(value, tuple) else (value,):
            if isinstance(number, float) and not abs(number) <= LARGEST_FLOAT:
                raise UserError(f"{name} is {number}: give a finite number (in single precision)")
            if isinstance(number, int) and abs(number) > LARGEST:
                raise UserError(f"{name} is {number}: give at most {LARGEST}, which is counted in 32 bits")
            if bounds is not None and number not in bounds:
                raise UserError(f"{name} is {value}: give {bounds}")
        if bounds is not None and value == ():
            raise UserError(f"{name} is empty: give at least one layer")


def check_multiple(value: int, unit: int, name: str, unit_name: str) -> None:
    """Raise UserError unless a value is a multiple of `unit`."""
    if value % unit:
        raise UserError(f"{name} is {value}: give a multiple of {unit_name} ({unit})")
