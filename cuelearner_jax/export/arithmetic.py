"""Rules of numbers: entry by entry, along axes, and between types. See `rules`.

Integers wrap, are divided and converted as XLA does. What NumPy or ONNX would do otherwise is refused.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from jax.lax import RoundingMethod

from cuelearner_jax.export.graph import RULES, Builder, Known, Rule, Value, kind_of

SAME = ("neg", "abs", "sign", "floor", "ceil", "exp", "log", "log1p", "expm1", "sin", "cos", "tan", "tanh", "atan")
SAME += ("sqrt", "rsqrt", "square", "logistic", "is_finite", "add", "sub", "mul", "atan2", "eq", "ne")
ORDERS, LOGIC = ("lt", "le", "gt", "ge"), ("and", "or", "xor", "not")
REDUCTIONS = {"sum": ("sum", ""), "prod": ("prod", "all"), "max": ("largest", "any"), "min": ("smallest", "all")}
REDUCTIONS |= {"and": ("", "all"), "or": ("", "any")}  # of numbers, of booleans

Shape = tuple[int, ...]
Single = Callable[[Builder, dict[str, Any], list[Known], Shape, str], Known]


def output(equation: Any, place: int = 0) -> tuple[Shape, str]:
    """Return shape and kind of an equation's output."""
    aval = equation.outvars[place].aval
    return tuple(aval.shape), kind_of(aval.dtype)


def one(*names: str) -> Callable[[Single], Single]:
    """Register a rule of primitives with one output."""

    def register(single: Single) -> Single:
        def rule(builder: Builder, equation: Any, given: list[Known]) -> list[Known]:
            return [single(builder, equation.params, given, *output(equation))]

        RULES.update(dict.fromkeys(names, rule))
        return single

    return register


def several(name: str) -> Callable[[Rule], Rule]:
    """Register the rule of a primitive with several outputs."""
    return lambda rule: RULES.setdefault(name, rule)


def said_by(op: str, of_bools: str = "", **attributes: Callable[[Any], Any]) -> Single:
    """Return a rule for one operation (another one for booleans); attributes are functions of the parameters."""

    def single(builder: Builder, params: dict[str, Any], given: list[Known], shape: Shape, kind: str) -> Known:
        own = {name: told(params) for name, told in attributes.items()}
        return builder.add(of_bools if of_bools and kind == "bool" else op, given, shape, kind, **own)

    return single


def _reduced(name: str) -> Single:
    """Return the rule of a reduction along axes."""
    op, of_bools = REDUCTIONS[name]

    def single(builder: Builder, params: dict[str, Any], given: list[Known], shape: Shape, kind: str) -> Known:
        if name == "prod" and kind == "int32":
            raise NotImplementedError("a product of integers along an axis")
        axes = list(map(int, params["axes"]))  # none, for ONNX, means all
        return builder.add(of_bools if kind == "bool" else op, given, shape, kind, axes=axes) if axes else given[0]

    return _logic(single) if name in LOGIC else single


def _logic(single: Single) -> Single:
    """Return a rule for booleans only."""

    def rule(builder: Builder, params: dict[str, Any], given: list[Known], shape: Shape, kind: str) -> Known:
        if kind != "bool":
            raise NotImplementedError("bitwise logic of integers")
        return single(builder, params, given, shape, kind)

    return rule


def _of_numbers(single: Single) -> Single:
    """Return a rule that reads booleans as integers, since ONNX neither orders them nor finds their largest."""

    def rule(builder: Builder, params: dict[str, Any], given: list[Known], shape: Shape, kind: str) -> Known:
        return single(builder, params, [_number(builder, value) for value in given], shape, kind)

    return rule


def kind_in(value: Known) -> str:
    """Return how a graph holds a value."""
    return value.kind if isinstance(value, Value) else kind_of(value.dtype)


def _number(builder: Builder, value: Known) -> Known:
    """Return booleans as integers, and other values as they are."""
    if kind_in(value) != "bool":
        return value
    if not isinstance(value, Value):
        return np.asarray(value, np.int32)
    return builder.add("cast", [value], value.shape, "int32", dtype="int32")


for _name in SAME:
    one(_name)(said_by(_name))
for _name in LOGIC:
    one(_name)(_logic(said_by(_name)))
for _name in ORDERS:
    one(_name)(_of_numbers(said_by(_name)))
for _name in ("argmax", "argmin"):
    one(_name)(_of_numbers(said_by(_name, axis=lambda params: int(params["axes"][0]))))


for _name in REDUCTIONS:
    one(f"reduce_{_name}")(_reduced(_name))
one("max")(said_by("max", of_bools="or"))
one("min")(said_by("min", of_bools="and"))
one("select_n")(lambda b, params, given, shape, kind: chosen(b, given[0], given[1:], shape, kind))


@one("convert_element_type")
def _cast(builder: Builder, params: Any, given: list[Known], shape: Shape, kind: str) -> Known:
    (value,) = given
    assert isinstance(value, Value)
    if value.kind == kind:
        return value
    if (value.kind, kind) != ("float32", "int32"):
        return builder.add("cast", [value], shape, kind, dtype=kind)
    # As XLA: NaN becomes 0, and what is out of range the nearest integer. NumPy and ONNX leave both open.
    low, high = np.asarray(-(2**31), np.float32), np.asarray(2**31, np.float32)
    number = builder.add("eq", [value, value], shape, "bool")
    value = builder.add("select", [number, value, np.asarray(0, np.float32)], shape, "float32")
    value = builder.add("max", [value, low], shape, "float32")
    whole = builder.add("cast", [value], shape, kind, dtype=kind)
    above = builder.add("ge", [value, high], shape, "bool")
    return builder.add("select", [above, np.asarray(2**31 - 1, np.int32), whole], shape, kind)


@one("integer_pow")
def _integer_pow(builder: Builder, params: Any, given: list[Known], shape: Shape, kind: str) -> Known:
    """Multiply repeatedly: integers then wrap as those of XLA do."""
    (power,), left, found = given, abs(params["y"]), None
    while left:
        if left % 2:
            found = power if found is None else builder.add("mul", [found, power], shape, kind)
        left //= 2
        power = builder.add("mul", [power, power], shape, kind) if left else power
    if found is None:
        return np.ones(shape, kind)
    return builder.add("div", [np.ones((), kind), found], shape, kind) if params["y"] < 0 else found


@one("pow")
def _pow(builder: Builder, params: Any, given: list[Known], shape: Shape, kind: str) -> Known:
    if any(kind_in(value) != "float32" for value in given):
        raise NotImplementedError("powers with an integer base or exponent")
    return builder.add("pow", given, shape, kind)


@one("div")
def _div(builder: Builder, params: Any, given: list[Known], shape: Shape, kind: str) -> Known:
    if kind != "int32":
        return builder.add("div", given, shape, kind)
    negative = builder.add("neg", [given[0]], tuple(given[0].shape), kind)
    return _divided(builder, "div", given, shape, np.asarray(-1, kind), negative)


@one("rem")
def _rem(builder: Builder, params: Any, given: list[Known], shape: Shape, kind: str) -> Known:
    if kind != "int32":
        return builder.add("rem", given, shape, kind)
    return _divided(builder, "rem", given, shape, given[0], np.asarray(0, kind))


def _divided(builder: Builder, op: str, given: list[Known], shape: Shape, by_zero: Known, by_minus_one: Known) -> Known:
    """Divide integers as XLA does: ONNX stops the process at 0, and at the least integer by -1."""
    x, y = given
    if not isinstance(y, Value) and not np.isin(np.asarray(y), (0, -1)).any():
        return builder.add(op, [x, y], shape, "int32")
    zero, minus = (builder.add("eq", [y, np.asarray(number, np.int32)], tuple(y.shape), "bool") for number in (0, -1))
    odd = builder.add("or", [zero, minus], tuple(y.shape), "bool")
    safe = builder.add("select", [odd, np.asarray(1, np.int32), y], tuple(y.shape), "int32")
    found = builder.add(op, [x, safe], shape, "int32")
    found = builder.add("select", [minus, by_minus_one, found], shape, "int32")
    return builder.add("select", [zero, by_zero, found], shape, "int32")


def select(builder: Builder, which: Known, true: Known, false: Known, shape: Shape, kind: str) -> Known:
    """Select entries; booleans by logic, as onnxruntime cannot select them."""
    if kind != "bool":
        return builder.add("select", [which, true, false], shape, kind)
    other = builder.add("and", [builder.add("not", [which], tuple(which.shape), kind), false], shape, kind)
    return builder.add("or", [builder.add("and", [which, true], shape, kind), other], shape, kind)


def chosen(builder: Builder, which: Known, cases: list[Known], shape: Shape, kind: str) -> Known:
    """Select the case of a number, or of False and True."""
    if kind_in(which) == "bool":
        return select(builder, which, cases[1], cases[0], shape, kind)
    found = cases[-1]
    for number, case in reversed(list(enumerate(cases[:-1]))):
        here = builder.add("le", [which, np.asarray(number, np.int32)], tuple(which.shape), "bool")
        found = select(builder, here, case, found, shape, kind)
    return found


@one("clamp")
def _clamp(builder: Builder, params: Any, given: list[Known], shape: Shape, kind: str) -> Known:
    low, x, high = given
    return builder.add("min", [builder.add("max", [x, low], shape, kind), high], shape, kind)


@one("round")
def _round(builder: Builder, params: Any, given: list[Known], shape: Shape, kind: str) -> Known:
    if params["rounding_method"] != RoundingMethod.TO_NEAREST_EVEN:
        raise NotImplementedError("rounding halves away from zero")
    return builder.add("round", given, shape, kind)
