"""Rules that express each JAX operation by those of `runner.OPERATIONS`: one rule per primitive, by name.

A rule returns one value from (builder, the equation, its inputs, shape and type of the output). A rule of a primitive
with several outputs takes (builder, the equation, its inputs). Integers wrap and are converted as XLA does. What NumPy
or ONNX would do otherwise is refused.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from functools import partial
from typing import Any

import jax.numpy as jnp
import numpy as np
from jax.lax import GatherScatterMode, RoundingMethod

from cuelearner_jax.export.graph import RULES, Builder, Operand, Rule, Value, kind_of

SAME = ("neg", "abs", "sign", "floor", "ceil", "exp", "log", "log1p", "expm1", "sin", "cos", "tan", "tanh", "atan")
SAME += ("sqrt", "rsqrt", "square", "logistic", "is_finite", "add", "sub", "mul", "atan2", "eq", "ne")
# of numbers, of booleans
REDUCTIONS = {"reduce_sum": ("sum", ""), "reduce_max": ("largest", "any"), "reduce_min": ("smallest", "all")}
REDUCTIONS |= {"reduce_and": ("", "all"), "reduce_or": ("", "any"), "max": ("max", "or"), "min": ("min", "and")}
REDUCTIONS |= {name: ("", name) for name in ("and", "or", "xor", "not")}
ENDS = ("start_indices", "limit_indices", "strides")  # of a slice
MOST_UNROLLED = 64  # passes of a scan

Shape = tuple[int, ...]
Single = Callable[[Builder, Any, list[Operand], Shape, str], Operand]


def output(equation: Any, place: int = 0) -> tuple[Shape, str]:
    """Return shape and kind of an equation's output."""
    aval = equation.outvars[place].aval
    return tuple(aval.shape), kind_of(aval.dtype)


def one(*names: str) -> Callable[[Single], Single]:
    """Register a rule of primitives with one output."""

    def register(single: Single) -> Single:
        def rule(builder: Builder, equation: Any, inputs: list[Operand]) -> list[Operand]:
            return [single(builder, equation, inputs, *output(equation))]

        RULES.update(dict.fromkeys(names, rule))
        return single

    return register


def several(name: str) -> Callable[[Rule], Rule]:
    """Register the rule of a primitive with several outputs."""
    return partial(RULES.setdefault, name)


def kind_in(value: Operand) -> str:
    """Return how a graph holds a value."""
    return value.kind if isinstance(value, Value) else kind_of(value.dtype)


# --- numbers, entry by entry and along axes ---

one("clamp")(lambda b, e, x, shape, kind: b.add("min", [b.add("max", x[1::-1], shape, kind), x[2]], shape, kind))
one("copy", "copy_p", "stop_gradient")(lambda b, equation, inputs, shape, kind: inputs[0])
one(*SAME)(lambda b, equation, inputs, shape, kind: b.add(equation.primitive.name, inputs, shape, kind))
one("select_n")(lambda b, equation, inputs, shape, kind: select_case(b, inputs[0], inputs[1:], shape, kind))


@one("lt", "le", "gt", "ge", "argmax", "argmin")
def _order(builder: Builder, equation: Any, inputs: list[Operand], shape: Shape, kind: str) -> Operand:
    """Order numbers; booleans as integers, since ONNX neither orders them nor finds their largest."""
    whole: list[Operand] = [
        value
        if kind_in(value) != "bool"
        else builder.add("cast", [value], value.shape, "int32", dtype="int32")
        if isinstance(value, Value)
        else np.asarray(value, np.int32)
        for value in inputs
    ]
    axis = {"axis": int(equation.params["axes"][0])} if "axes" in equation.params else {}
    return builder.add(equation.primitive.name, whole, shape, kind, **axis)


@one(*REDUCTIONS)
def _reduction(builder: Builder, equation: Any, inputs: list[Operand], shape: Shape, kind: str) -> Operand:
    of_numbers, of_bools = REDUCTIONS[equation.primitive.name]
    if not (op := of_bools if kind == "bool" else of_numbers):
        raise NotImplementedError("bitwise logic of integers")
    if "axes" not in equation.params:
        return builder.add(op, inputs, shape, kind)
    axes = list(map(int, equation.params["axes"]))  # none, for ONNX, means all
    return builder.add(op, inputs, shape, kind, axes=axes) if axes else inputs[0]


@one("convert_element_type")
def _cast(builder: Builder, equation: Any, inputs: list[Operand], shape: Shape, kind: str) -> Operand:
    (value,) = inputs
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
def _integer_pow(builder: Builder, equation: Any, inputs: list[Operand], shape: Shape, kind: str) -> Operand:
    """Multiply repeatedly: integers then wrap as those of XLA do."""
    (power,), exponent, product = inputs, abs(equation.params["y"]), None
    while exponent:
        if exponent % 2:
            product = power if product is None else builder.add("mul", [product, power], shape, kind)
        exponent //= 2
        power = builder.add("mul", [power, power], shape, kind) if exponent else power
    if product is None:
        return np.ones(shape, kind)
    return builder.add("div", [np.ones((), kind), product], shape, kind) if equation.params["y"] < 0 else product


@one("pow")
def _pow(builder: Builder, equation: Any, inputs: list[Operand], shape: Shape, kind: str) -> Operand:
    if any(kind_in(value) != "float32" for value in inputs):
        raise NotImplementedError("powers with an integer base or exponent")
    return builder.add("pow", inputs, shape, kind)


@one("div", "rem")
def _division(builder: Builder, equation: Any, inputs: list[Operand], shape: Shape, kind: str) -> Operand:
    """Divide; not integers by 0 or -1, at which ONNX stops the process."""
    if kind == "int32" and (isinstance(inputs[1], Value) or np.isin(np.asarray(inputs[1]), (0, -1)).any()):
        raise NotImplementedError("a division of integers by 0, by -1, or by what depends on the observation")
    return builder.add(equation.primitive.name, inputs, shape, kind)


def select(builder: Builder, which: Operand, true: Operand, false: Operand, shape: Shape, kind: str) -> Operand:
    """Select entries; booleans by logic, as onnxruntime cannot select them."""
    if kind != "bool":
        return builder.add("select", [which, true, false], shape, kind)
    other = builder.add("and", [builder.add("not", [which], tuple(which.shape), kind), false], shape, kind)
    return builder.add("or", [builder.add("and", [which, true], shape, kind), other], shape, kind)


def select_case(builder: Builder, which: Operand, cases: list[Operand], shape: Shape, kind: str) -> Operand:
    """Select the case of a number, or of False and True."""
    if kind_in(which) == "bool":
        return select(builder, which, cases[1], cases[0], shape, kind)
    result = cases[-1]
    for number, case in reversed(list(enumerate(cases[:-1]))):
        here = builder.add("le", [which, np.asarray(number, np.int32)], tuple(which.shape), "bool")
        result = select(builder, here, case, result, shape, kind)
    return result


@one("round")
def _round(builder: Builder, equation: Any, inputs: list[Operand], shape: Shape, kind: str) -> Operand:
    if equation.params["rounding_method"] != RoundingMethod.TO_NEAREST_EVEN:
        raise NotImplementedError("rounding halves away from zero")
    return builder.add("round", inputs, shape, kind)


# --- shapes, places and products ---

several("optimization_barrier")(lambda builder, equation, inputs: inputs)
one("reshape", "squeeze", "expand_dims")(lambda b, equation, inputs, shape, kind: b.reshaped(inputs[0], shape))
one("transpose")(lambda b, equation, inputs, shape, kind: b.transposed(inputs[0], equation.params["permutation"]))
one("slice")(lambda b, equation, inputs, shape, kind: _cut(b, inputs[0], *map(equation.params.get, ENDS)))


@one("concatenate", "stack")
def _concatenate(builder: Builder, equation: Any, inputs: list[Operand], shape: Shape, kind: str) -> Operand:
    axis = int(equation.params["axis" if equation.primitive.name == "stack" else "dimension"])
    if equation.primitive.name == "stack":
        inputs = [builder.reshaped(each, (*shape[:axis], 1, *shape[axis + 1 :])) for each in inputs]
    return builder.add("concatenate", inputs, shape, kind, axis=axis)


@one("broadcast_in_dim")
def _broadcast(builder: Builder, equation: Any, inputs: list[Operand], shape: Shape, kind: str) -> Operand:
    placed = [1] * len(shape)
    for axis, place in enumerate(equation.params["broadcast_dimensions"]):
        placed[place] = inputs[0].shape[axis]
    spread = builder.reshaped(inputs[0], tuple(placed))
    return spread if tuple(placed) == shape else builder.add("broadcast", [spread], shape, kind, shape=list(shape))


def _cut(builder: Builder, value: Operand, start: Any, stop: Any, step: Any = None) -> Operand:
    step = [1] * len(value.shape) if step is None else list(step)
    if not isinstance(value, Value):
        return jnp.asarray(value)[tuple(slice(*each) for each in zip(start, stop, step, strict=True))]
    shape = tuple(math.ceil((b - a) / by) for a, b, by in zip(start, stop, step, strict=True))
    ends = {"start": list(map(int, start)), "stop": list(map(int, stop)), "step": list(map(int, step))}
    return value if shape == value.shape else builder.add("slice", [value], shape, value.kind, **ends)


def _part(builder: Builder, value: Operand, axis: int, first: int, last: int) -> Operand:
    start, stop = [0] * len(value.shape), list(value.shape)
    start[axis], stop[axis] = first, last
    return _cut(builder, value, start, stop)


@several("split")
def _split(builder: Builder, equation: Any, inputs: list[Operand]) -> list[Operand]:
    ends = np.cumsum([0, *equation.params["sizes"]]).tolist()
    return [_part(builder, inputs[0], equation.params["axis"], *pair) for pair in itertools.pairwise(ends)]


@one("pad")
def _pad(builder: Builder, equation: Any, inputs: list[Operand], shape: Shape, kind: str) -> Operand:
    value, filling = inputs
    low, high, inner = (list(map(int, each)) for each in zip(*equation.params["padding_config"], strict=True))
    if any(inner) or min(*low, *high) < 0:
        raise NotImplementedError("padding between entries, or by less than nothing")
    return builder.add("pad", [value, filling], shape, kind, low=low, high=high)


def _take_entries(builder: Builder, value: Operand, places: Operand, shape: Shape, kind: str) -> Value:
    """Take entries of the flattened value by their positions."""
    return builder.add("take", [builder.reshaped(value, (math.prod(value.shape),)), places], shape, kind)


@one("rev")
def _rev(builder: Builder, equation: Any, inputs: list[Operand], shape: Shape, kind: str) -> Operand:
    places = np.flip(np.arange(math.prod(shape), dtype=np.int32).reshape(shape), equation.params["dimensions"])
    return _take_entries(builder, inputs[0], places.copy(), shape, kind)


def _strides(shape: Shape) -> list[int]:
    return [math.prod(shape[axis + 1 :]) for axis in range(len(shape))]


def _offsets(sizes: Shape, strides: list[int]) -> np.ndarray:
    """Return the offset of every entry of a block of these sizes from the first entry."""
    return np.asarray(np.tensordot(np.array(strides, np.int32), np.indices(sizes, np.int32), 1), np.int32)


def _clipped(builder: Builder, start: Operand, most: int, stride: int) -> Operand:
    """Return stride * start, with `start` limited so that a block still fits."""
    if not isinstance(start, Value):
        return np.asarray(np.clip(np.asarray(start, np.int32), 0, most) * np.int32(stride))
    for op, number in (("max", 0), ("min", most), ("mul", stride)):
        start = builder.add(op, [start, np.asarray(number, np.int32)], start.shape, "int32")
    return start


def _summed(builder: Builder, parts: list[Operand], shape: Shape) -> Operand:
    constant = sum((np.asarray(part) for part in parts if not isinstance(part, Value)), np.zeros((), np.int32))
    total: Operand = np.broadcast_to(constant, shape).astype(np.int32)
    for part in parts:
        if isinstance(part, Value):
            total = builder.add("add", [part, total], shape, "int32")
    return total


@one("dynamic_slice")
def _dynamic_slice(builder: Builder, equation: Any, inputs: list[Operand], shape: Shape, kind: str) -> Operand:
    value, *starts = inputs
    strides = _strides(tuple(value.shape))
    parts = [
        _clipped(builder, start, size - cut, stride)
        for start, size, cut, stride in zip(starts, value.shape, shape, strides, strict=True)
    ]
    return _take_entries(builder, value, _summed(builder, [*parts, _offsets(shape, strides)], shape), shape, kind)


@one("gather")
def _gather(builder: Builder, equation: Any, inputs: list[Operand], shape: Shape, kind: str) -> Operand:
    """Gather blocks of the operand, one for each row of indices (XLA's Gather)."""
    value, indices = inputs
    dims, sizes = equation.params["dimension_numbers"], equation.params["slice_sizes"]
    fills = equation.params["mode"] == GatherScatterMode.FILL_OR_DROP
    strides, rows = _strides(tuple(value.shape)), tuple(indices.shape[:-1])
    gone = {*dims.collapsed_slice_dims, *dims.operand_batching_dims}
    inner = [axis for axis in range(len(value.shape)) if axis not in gone]
    block = tuple(sizes[axis] for axis in inner)
    parts: list[Operand] = [_offsets(block, [strides[axis] for axis in inner]).reshape((*[1] * len(rows), *block))]
    missed: Operand | None = None
    for place, axis in enumerate(dims.start_index_map):
        first = _part(builder, indices, len(indices.shape) - 1, place, place + 1)
        first = builder.reshaped(first, (*rows, *[1] * len(block)))
        most = value.shape[axis] - sizes[axis]
        parts.append(_clipped(builder, first, most, strides[axis]))
        if fills and (isinstance(first, Value) or ((first < 0) | (first > most)).any()):
            low = builder.add("lt", [first, np.zeros((), np.int32)], first.shape, "bool")
            high = builder.add("gt", [first, np.asarray(most, np.int32)], first.shape, "bool")
            out = builder.add("or", [low, high], first.shape, "bool")
            missed = out if missed is None else builder.add("or", [missed, out], first.shape, "bool")
    for axis, place in zip(dims.operand_batching_dims, dims.start_indices_batching_dims, strict=True):
        numbers = np.arange(value.shape[axis], dtype=np.int32) * np.int32(strides[axis])
        parts.append(numbers.reshape([-1 if a == place else 1 for a in range(len(rows) + len(block))]))
    whole = (*rows, *block)
    result: Operand = _take_entries(builder, value, _summed(builder, parts, whole), whole, kind)
    if missed is not None:
        if (filling := equation.params["fill_value"]) is None:
            filling = {"float32": np.nan, "int32": np.iinfo(np.int32).min, "bool": True}[kind]
        result = select(builder, missed, np.asarray(filling, kind), result, whole, kind)
    blocks, others = iter(range(len(rows), len(whole))), iter(range(len(rows)))
    order = (next(blocks) if axis in dims.offset_dims else next(others) for axis in range(len(shape)))
    return builder.transposed(result, tuple(order))


@one("dot_general")
def _dot_general(builder: Builder, equation: Any, inputs: list[Operand], shape: Shape, kind: str) -> Operand:
    """Express the product as (batch, left, summed) by (batch, summed, right)."""
    left, right = inputs
    (left_summed, right_summed), (left_batch, right_batch) = equation.params["dimension_numbers"]
    left_free = [a for a in range(len(left.shape)) if a not in (*left_summed, *left_batch)]
    right_free = [a for a in range(len(right.shape)) if a not in (*right_summed, *right_batch)]
    if not kind_in(left) == kind_in(right) == kind or kind == "bool":
        raise NotImplementedError("products of booleans or of different types")
    size = lambda value, axes: math.prod(value.shape[a] for a in axes)  # noqa: E731
    batch = (size(left, left_batch),) if left_batch else ()
    m, k, n = size(left, left_free), size(left, left_summed), size(right, right_free)
    left = builder.reshaped(builder.transposed(left, (*left_batch, *left_free, *left_summed)), (*batch, m, k))
    right = builder.reshaped(builder.transposed(right, (*right_batch, *right_summed, *right_free)), (*batch, k, n))
    return builder.reshaped(builder.add("matmul", [left, right], (*batch, m, n), kind), shape)


@several("while")
def _while(builder: Builder, equation: Any, inputs: list[Operand]) -> list[Operand]:
    params = equation.params
    of_test, of_body = params["cond_nconsts"], params["body_nconsts"]
    start = inputs[of_test + of_body :]
    carried = [builder.new(*output(equation, place)) for place in range(len(start))]
    results = [builder.new(value.shape, value.kind) for value in carried]
    test = builder.branch(params["cond_jaxpr"], inputs[:of_test], carried)
    body = builder.branch(params["body_jaxpr"], inputs[of_test : of_test + of_body], carried)
    kinds = [[value.kind, list(value.shape)] for value in carried]
    parts = {"carried": test.inputs, "kinds": kinds, "test": test._asdict(), "body": body._asdict()}
    builder.ops.append(["while", list(map(builder.name, start)), [value.name for value in results], parts])
    return list(results)


@several("scan")
def _scan(builder: Builder, equation: Any, inputs: list[Operand]) -> list[Operand]:
    """Unroll a scan; for one observation it has few passes."""
    params = equation.params
    if params["length"] > MOST_UNROLLED:
        raise NotImplementedError(f"a scan of {params['length']} passes")
    if "ft_in" in params:  # since JAX 0.11
        fixed, carried, _ = map(len, params["ft_in"].unpack())
    else:
        fixed, carried = params["num_consts"], params["num_carry"]
    consts, carry, over = inputs[:fixed], inputs[fixed:][:carried], inputs[fixed + carried :]
    rows: list[list[Operand]] = []
    for number in range(params["length"])[:: -1 if params["reverse"] else 1]:
        now = [builder.reshaped(_part(builder, value, 0, number, number + 1), tuple(value.shape[1:])) for value in over]
        outputs = builder.inlined(params["jaxpr"].jaxpr, params["jaxpr"].consts, [*consts, *carry, *now])
        carry = outputs[:carried]
        rows.append(outputs[carried:])
    rows = rows[::-1] if params["reverse"] else rows
    stacked = []
    for place, each in enumerate(zip(*rows, strict=True)):
        shape, kind = output(equation, place + carried)
        parts = [builder.reshaped(value, (1, *value.shape)) for value in each]
        stacked.append(parts[0] if len(parts) == 1 else builder.add("concatenate", parts, shape, kind, axis=0))
    return [*carry, *stacked]


@several("cond")
def _cond(builder: Builder, equation: Any, inputs: list[Operand]) -> list[Operand]:
    """Evaluate every branch and select one result; nothing in a decision has side effects."""
    which, *operands = inputs
    branches = equation.params["branches"]
    if not isinstance(which, Value):
        branch = branches[int(np.clip(int(which), 0, len(branches) - 1))]
        return builder.inlined(branch.jaxpr, branch.consts, operands)
    results = [builder.inlined(branch.jaxpr, branch.consts, operands) for branch in branches]
    cases = enumerate(zip(*results, strict=True))
    return [select_case(builder, which, list(each), *output(equation, number)) for number, each in cases]
