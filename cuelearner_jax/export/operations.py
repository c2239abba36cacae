"""A decision's operations in NumPy, and their compilation into one function. `decide.py` contains this file."""

from __future__ import annotations

import math
import operator
from collections import Counter
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np

LARGEST_ARRAY = 1 << 28  # limit on the entries of an operation's output

Values = dict[str, np.ndarray]
Run = Callable[[Values], None]


class ContractError(ValueError):
    """Raised for an invalid decision folder, or an observation that violates the contract. One line."""


def compile_ops(ops: list[list[Any]], kept: set[str] | None = None) -> Run:
    """Return a graph's operations as one function, which adds their results to the values it is given.

    Args:
        ops: each [name, inputs, outputs, attributes]; see `OPERATIONS`, `SETTLED`, `_loop` and `_highest`.
        kept: names read afterwards; if given, large results reuse the memory of the call before.
    """
    steps: list[Run] = []
    for name, inputs, outputs, attributes in ops if kept is None else _joined(ops, kept):
        if name == "while":
            steps.append(_loop(inputs, outputs, **attributes))
        elif name == "top_k":
            steps.append(_highest(inputs[0], *outputs, **attributes))
        elif name in SETTLED:
            steps.append(_step(SETTLED[name](**attributes), inputs, outputs[0]))
        elif name not in OPERATIONS and name != "layer":
            raise ContractError(f"this decision has an operation {name!r}, which this runner does not know: update it")
        elif kept is not None and name in INTO:
            steps.append(_into(INTO[name], inputs, outputs[0]))
        else:
            steps.append(_step(OPERATIONS[name], inputs, outputs[0]))

    def run(values: Values) -> None:
        for step in steps:
            step(values)

    return run


def _step(function: Callable[..., Any], inputs: list[str], output: str) -> Run:
    if len(inputs) == 1:
        (only,) = inputs

        def step(values: Values) -> None:
            values[output] = function(values[only])
    elif len(inputs) == 2:
        one, other = inputs

        def step(values: Values) -> None:
            values[output] = function(values[one], values[other])
    else:

        def step(values: Values) -> None:
            values[output] = function(*[values[name] for name in inputs])

    return step


def _joined(ops: list[list[Any]], kept: set[str]) -> list[list[Any]]:
    """Fuse bias, rectifier and the following product, where nothing else reads the values between."""
    looks = Counter([*_looked_at(ops), *kept])
    made = {output: op for op in ops for output in op[2]}

    def before(name: str, wanted: str) -> list[list[Any]] | None:
        """Return the operation that computes a value, last, after the reshapes that follow it."""
        passed = []
        while name in made and looks[name] == 1:
            passed.append(made[name])
            if made[name][0] == wanted:
                return passed
            if made[name][0] != "reshape":
                break
            name = made[name][1][0]
        return None

    gone, joined = set(), {}
    for op in ops:
        if op[0] != "matmul" or not (rectified := before(op[1][0], "max")):
            continue
        *inner, floor = rectified[-1][1]
        if floor in made or not (added := before(inner[0], "add")):
            continue
        gone |= {id(each) for each in (*rectified, *added)}
        joined[id(op)] = ["layer", [*added[-1][1], floor, op[1][1]], op[2], {}]
    return [joined.get(id(op), op) for op in ops if id(op) not in gone]


def _looked_at(ops: list[list[Any]]) -> Iterator[str]:
    for name, inputs, _, attributes in ops:
        yield from inputs
        for part in ("test", "body") if name == "while" else ():
            yield from attributes[part]["outputs"]
            yield from _looked_at(attributes[part]["ops"])


def _into(function: Callable[..., Any], inputs: list[str], output: str) -> Run:
    """Reuse one output array for all calls: allocating large arrays takes longer than the arithmetic."""
    own: list[np.ndarray] = []

    def step(values: Values) -> None:
        given = [values[name] for name in inputs]
        values[output] = function(*given, out=own[0]) if own else function(*given)
        if not own and isinstance(values[output], np.ndarray):
            own.append(values[output])

    return step


def _loop(
    inputs: list[str],
    outputs: list[str],
    carried: list[str],
    kinds: list[Any],
    test: dict[str, Any],
    body: dict[str, Any],
) -> Run:
    """Repeat `body` on the carried values (of these types and shapes) while `test` of them is true."""
    look, work = compile_ops(test["ops"]), compile_ops(body["ops"])

    def run(values: Values) -> None:
        values.update(zip(carried, [values[name] for name in inputs], strict=True))
        while True:
            look(values)
            if not values[test["outputs"][0]]:
                break
            work(values)
            values.update(zip(carried, [values[name] for name in body["outputs"]], strict=True))
        values.update(zip(outputs, [values[name] for name in carried], strict=True))

    return run


def _highest(given: str, largest: str, places: str, k: int) -> Run:
    """Compute the k largest entries along the last axis, ties by position, and their positions."""

    def run(values: Values) -> None:
        x = values[given]
        order = np.argsort(~_ordinal(x), axis=-1, kind="stable")[..., :k].astype(np.int32)
        values[largest], values[places] = np.take_along_axis(x, order, -1), order

    return run


def _ordinal(x: np.ndarray) -> np.ndarray:
    """Return integers in the order that XLA sorts numbers in: -0 before 0, and NaN last."""
    if x.dtype.kind == "i":
        return x
    bits = np.ascontiguousarray(x).view(np.int32)
    return np.where(np.isnan(x), LAST, bits ^ ((bits >> 31) & LAST))


def _rounded(x: np.ndarray) -> np.ndarray:
    """Round to the nearest bfloat16, ties to even; the result stays in single precision."""
    bits = np.atleast_1d(x).view(np.uint32)
    up = ((bits >> np.uint32(16)) & np.uint32(1)) + np.uint32(0x7FFF)
    return ((bits + up) & np.uint32(0xFFFF0000)).view(np.float32).reshape(x.shape)


def _layer(
    one: np.ndarray, other: np.ndarray, floor: np.ndarray, weights: np.ndarray, out: np.ndarray | None = None
) -> np.ndarray:
    """Return max(one + other, floor) @ weights, skipping units of a large layer that no row activates (a third)."""
    row, rows = (one, other) if one.size < other.size else (other, one)
    width = weights.shape[0]
    fits = row.shape[-1:] == rows.shape[-1:] == (width,) and row.size == width and weights.ndim == 2
    if not fits or rows.size < LARGE * width or floor.size != 1 or floor.item() != 0:
        x = np.maximum(one + other, floor).reshape(*weights.shape[:-2], -1, weights.shape[-2])
        return np.matmul(x, weights, out=out)
    rows, row = rows.reshape(-1, width), row.reshape(width)
    on = np.flatnonzero(~(rows.max(axis=0) + row <= 0))  # NaN counts as on
    x = rows[:, on]
    x += row[on]
    return np.matmul(np.maximum(x, 0, out=x), weights[on], out=out)


def _argument(function: Callable[..., Any]) -> Callable[..., Any]:
    return lambda axis: lambda x: np.asarray(function(x, axis=axis), np.int32)


def _reduction(function: np.ufunc) -> Callable[..., Any]:
    return lambda axes: lambda x, axis=tuple(axes): function.reduce(x, axis, x.dtype)


def _slices(start: list[int], stop: list[int], step: list[int]) -> Callable[..., Any]:
    return operator.itemgetter(tuple(slice(*each) for each in zip(start, stop, step, strict=True)))


def _spread(shape: list[int]) -> Callable[..., Any]:
    _check_entries(math.prod(shape))
    return lambda x: np.broadcast_to(x, shape)


def _check_entries(count: int) -> None:
    if count > LARGEST_ARRAY:
        raise ContractError(f"this decision makes an array of {count:,} entries: export the policy anew")


def _filling(low: list[int], high: list[int]) -> Callable[..., Any]:
    _check_entries(max([*low, *high], default=0))
    return lambda x, value: np.pad(x, list(zip(low, high, strict=True)), constant_values=value)


def _quotient(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Divide; integers round toward zero."""
    return np.asarray(np.trunc(np.true_divide(x, y)), x.dtype) if x.dtype.kind in "iu" else np.divide(x, y)


ONE = np.float32(1)
LARGE = 32  # rows
LAST = np.int32(2**31 - 1)

# For float32, int32 or bool arrays of fixed shapes. Elementwise ones take equal or broadcastable shapes.
OPERATIONS: dict[str, Callable[..., Any]] = {
    "neg": np.negative,
    "abs": np.abs,
    "sign": np.sign,
    "floor": np.floor,
    "ceil": np.ceil,
    "round": np.rint,  # halves to even
    "exp": np.exp,
    "log": np.log,
    "log1p": np.log1p,
    "expm1": np.expm1,
    "sin": np.sin,
    "cos": np.cos,
    "tan": np.tan,
    "tanh": np.tanh,
    "atan": np.arctan,
    "sqrt": np.sqrt,
    "rsqrt": lambda x: ONE / np.sqrt(x),
    "square": np.square,
    "logistic": lambda x: ONE / (ONE + np.exp(-x)),
    "is_finite": np.isfinite,
    "not": np.logical_not,
    "bfloat16": _rounded,
    "add": np.add,
    "sub": np.subtract,
    "mul": np.multiply,
    "div": _quotient,
    "rem": np.fmod,
    "pow": np.power,
    "atan2": np.arctan2,
    "max": np.maximum,
    "min": np.minimum,
    "and": np.logical_and,
    "or": np.logical_or,
    "xor": np.logical_xor,
    "eq": np.equal,
    "ne": np.not_equal,
    "lt": np.less,
    "le": np.less_equal,
    "gt": np.greater,
    "ge": np.greater_equal,
    "select": np.where,  # (which, where true, where false)
    "take": np.take,  # from x flattened to one row
    "matmul": np.matmul,
}

# Operations that can write into a given array. "layer" is in no file: `_joined` makes it.
INTO = {name: OPERATIONS[name] for name in ("add", "sub", "mul", "max", "min", "matmul")} | {"layer": _layer}

# Operations with attributes, as functions that return the function of the arrays. For small arrays, preparing an
# operation is most of the work.
SETTLED: dict[str, Callable[..., Callable[..., Any]]] = {
    "cast": lambda dtype: operator.methodcaller("astype", dtype),
    "reshape": lambda shape: operator.methodcaller("reshape", tuple(shape)),
    "transpose": lambda axes: operator.methodcaller("transpose", tuple(axes)),
    "broadcast": _spread,
    "concatenate": lambda axis: lambda *parts: np.concatenate(parts, axis),
    "slice": _slices,
    "pad": _filling,
    "sum": _reduction(np.add),
    "prod": _reduction(np.multiply),
    "largest": _reduction(np.maximum),
    "smallest": _reduction(np.minimum),
    "all": _reduction(np.logical_and),
    "any": _reduction(np.logical_or),
    "argmax": _argument(np.argmax),
    "argmin": _argument(np.argmin),
    "cumsum": lambda axis: lambda x: np.cumsum(x, axis, dtype=x.dtype),
}
