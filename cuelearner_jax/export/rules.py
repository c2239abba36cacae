"""Rules that express each JAX operation by those of `operations.OPERATIONS`: one rule per primitive, by name.

A rule returns one value from (builder, the primitive's parameters, its inputs, shape and type of the output). A rule
of a primitive with several outputs, or with inner functions, takes the equation. Rules of numbers are in `arithmetic`.
"""

from __future__ import annotations

import itertools
import math
from typing import Any

import jax.numpy as jnp
import numpy as np
from jax.lax import GatherScatterMode

from cuelearner_jax.export.arithmetic import Shape, chosen, kind_in, one, output, said_by, select, several
from cuelearner_jax.export.graph import RULES, Builder, Known, Value

__all__ = ["RULES"]
MOST_UNROLLED = 64  # passes of a scan

one("concatenate")(said_by("concatenate", axis=lambda params: int(params["dimension"])))
one("copy", "copy_p", "stop_gradient")(lambda b, params, given, shape, kind: given[0])
several("optimization_barrier")(lambda builder, equation, given: given)
one("reshape", "squeeze", "expand_dims")(lambda b, params, given, shape, kind: b.reshaped(given[0], shape))
one("transpose")(lambda b, params, given, shape, kind: b.transposed(given[0], params["permutation"]))


@one("broadcast_in_dim")
def _broadcast(builder: Builder, params: Any, given: list[Known], shape: Shape, kind: str) -> Known:
    placed = [1] * len(shape)
    for axis, place in enumerate(params["broadcast_dimensions"]):
        placed[place] = given[0].shape[axis]
    spread = builder.reshaped(given[0], tuple(placed))
    return spread if tuple(placed) == shape else builder.add("broadcast", [spread], shape, kind, shape=list(shape))


@one("stack")
def _stack(builder: Builder, params: Any, given: list[Known], shape: Shape, kind: str) -> Known:
    axis = int(params["axis"])
    row = (*shape[:axis], 1, *shape[axis + 1 :])
    return builder.add("concatenate", [builder.reshaped(one, row) for one in given], shape, kind, axis=axis)


def _cut(builder: Builder, value: Known, start: Any, stop: Any, step: Any = None) -> Known:
    step = [1] * len(value.shape) if step is None else list(step)
    if not isinstance(value, Value):
        return jnp.asarray(value)[tuple(slice(*each) for each in zip(start, stop, step, strict=True))]
    shape = tuple(math.ceil((b - a) / by) for a, b, by in zip(start, stop, step, strict=True))
    ends = {"start": list(map(int, start)), "stop": list(map(int, stop)), "step": list(map(int, step))}
    return value if shape == value.shape else builder.add("slice", [value], shape, value.kind, **ends)


def _part(builder: Builder, value: Known, axis: int, first: int, last: int) -> Known:
    """Slice from `first` to before `last` along one axis."""
    start, stop = [0] * len(value.shape), list(value.shape)
    start[axis], stop[axis] = first, last
    return _cut(builder, value, start, stop)


@one("slice")
def _slice(builder: Builder, params: Any, given: list[Known], shape: Shape, kind: str) -> Known:
    return _cut(builder, given[0], params["start_indices"], params["limit_indices"], params["strides"])


@several("split")
def _split(builder: Builder, equation: Any, given: list[Known]) -> list[Known]:
    ends = np.cumsum([0, *equation.params["sizes"]]).tolist()
    axis = equation.params["axis"]
    return [_part(builder, given[0], axis, *pair) for pair in itertools.pairwise(ends)]


@one("pad")
def _pad(builder: Builder, params: Any, given: list[Known], shape: Shape, kind: str) -> Known:
    value, filling = given
    settings = [tuple(map(int, each)) for each in params["padding_config"]]
    if any(inner for _, _, inner in settings):
        raise NotImplementedError("padding between entries")
    kept = [(max(-low, 0), size - max(-high, 0)) for (low, high, _), size in zip(settings, value.shape, strict=True)]
    value = _cut(builder, value, *zip(*kept, strict=True))
    ends = {"low": [max(low, 0) for low, _, _ in settings], "high": [max(high, 0) for _, high, _ in settings]}
    return builder.add("pad", [value, filling], shape, kind, **ends)


def _taken(builder: Builder, value: Known, places: Known, shape: Shape, kind: str) -> Value:
    """Take entries of the flattened value by their positions."""
    return builder.add("take", [builder.reshaped(value, (math.prod(value.shape),)), places], shape, kind)


@one("rev")
def _rev(builder: Builder, params: Any, given: list[Known], shape: Shape, kind: str) -> Known:
    places = np.flip(np.arange(math.prod(shape), dtype=np.int32).reshape(shape), params["dimensions"])
    return _taken(builder, given[0], places.copy(), shape, kind)


def _strides(shape: Shape) -> list[int]:
    return [math.prod(shape[axis + 1 :]) for axis in range(len(shape))]


def _offsets(sizes: Shape, strides: list[int]) -> np.ndarray:
    """Return the offset of every entry of a block of these sizes from the first entry."""
    numbers = np.zeros(sizes, np.int32)
    for axis, (size, stride) in enumerate(zip(sizes, strides, strict=True)):
        numbers += _along(axis, len(sizes), np.arange(size, dtype=np.int32) * stride)
    return numbers


def _along(axis: int, axes: int, row: np.ndarray) -> np.ndarray:
    """Return a row laid along one of several axes."""
    return row.reshape([-1 if a == axis else 1 for a in range(axes)])


def _clipped(builder: Builder, start: Known, most: int, stride: int) -> Known:
    """Return stride * start, with `start` limited so that a block still fits."""
    if not isinstance(start, Value):
        return np.asarray(np.clip(np.asarray(start, np.int32), 0, most) * np.int32(stride))
    for op, number in (("max", 0), ("min", most), ("mul", stride)):
        start = builder.add(op, [start, np.asarray(number, np.int32)], start.shape, "int32")
    return start


def _summed(builder: Builder, parts: list[Known], shape: Shape) -> Known:
    known = sum((np.asarray(part) for part in parts if not isinstance(part, Value)), np.zeros((), np.int32))
    total: Known = np.broadcast_to(known, shape).astype(np.int32)
    for part in parts:
        if isinstance(part, Value):
            total = builder.add("add", [part, total], shape, "int32")
    return total


@one("dynamic_slice")
def _dynamic_slice(builder: Builder, params: Any, given: list[Known], shape: Shape, kind: str) -> Known:
    value, *starts = given
    strides = _strides(tuple(value.shape))
    parts = [
        _clipped(builder, start, size - cut, stride)
        for start, size, cut, stride in zip(starts, value.shape, shape, strides, strict=True)
    ]
    return _taken(builder, value, _summed(builder, [*parts, _offsets(shape, strides)], shape), shape, kind)


@one("gather")
def _gather(builder: Builder, params: Any, given: list[Known], shape: Shape, kind: str) -> Known:
    """Gather blocks of the operand, one for each row of indices (XLA's Gather)."""
    value, indices = given
    named, sizes = params["dimension_numbers"], params["slice_sizes"]
    fills = params["mode"] == GatherScatterMode.FILL_OR_DROP
    strides, rows = _strides(tuple(value.shape)), tuple(indices.shape[:-1])
    gone = {*named.collapsed_slice_dims, *named.operand_batching_dims}
    inner = [axis for axis in range(len(value.shape)) if axis not in gone]
    block = tuple(sizes[axis] for axis in inner)
    parts: list[Known] = [_offsets(block, [strides[axis] for axis in inner]).reshape((*[1] * len(rows), *block))]
    missed: Known | None = None
    for place, axis in enumerate(named.start_index_map):
        first = _part(builder, indices, len(indices.shape) - 1, place, place + 1)
        first = builder.reshaped(first, (*rows, *[1] * len(block)))
        most = value.shape[axis] - sizes[axis]
        parts.append(_clipped(builder, first, most, strides[axis]))
        if fills and (isinstance(first, Value) or ((first < 0) | (first > most)).any()):
            low = builder.add("lt", [first, np.zeros((), np.int32)], first.shape, "bool")
            high = builder.add("gt", [first, np.asarray(most, np.int32)], first.shape, "bool")
            out = builder.add("or", [low, high], first.shape, "bool")
            missed = out if missed is None else builder.add("or", [missed, out], first.shape, "bool")
    for axis, place in zip(named.operand_batching_dims, named.start_indices_batching_dims, strict=True):
        numbers = np.arange(value.shape[axis], dtype=np.int32) * np.int32(strides[axis])
        parts.append(_along(place, len(rows) + len(block), numbers))
    whole = (*rows, *block)
    found: Known = _taken(builder, value, _summed(builder, parts, whole), whole, kind)
    if missed is not None:
        default = {"float32": np.nan, "int32": np.iinfo(np.int32).min, "bool": True}[kind]
        filling = np.asarray(default if params["fill_value"] is None else params["fill_value"], kind)
        found = select(builder, missed, filling, found, whole, kind)
    blocks, others = iter(range(len(rows), len(whole))), iter(range(len(rows)))
    order = (next(blocks) if axis in named.offset_dims else next(others) for axis in range(len(shape)))
    return builder.transposed(found, tuple(order))


@one("dot_general")
def _dot_general(builder: Builder, params: Any, given: list[Known], shape: Shape, kind: str) -> Known:
    """Express the product as (batch, left, summed) by (batch, summed, right)."""
    left, right = given
    (left_summed, right_summed), (left_batch, right_batch) = params["dimension_numbers"]
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


@one("cumsum")
def _cumsum(builder: Builder, params: Any, given: list[Known], shape: Shape, kind: str) -> Known:
    if params["reverse"]:
        raise NotImplementedError("a cumulative sum from the end")
    return builder.add("cumsum", given, shape, kind, axis=int(params["axis"]))


@several("top_k")
def _top_k(builder: Builder, equation: Any, given: list[Known]) -> list[Known]:
    axes, axis = len(given[0].shape), equation.params.get("axis", -1)
    if kind_in(given[0]) == "bool" or axis not in (-1, axes - 1):
        raise NotImplementedError("the largest of booleans, or along another axis than the last")
    found = [builder.new(*output(equation, place)) for place in (0, 1)]
    names = [value.name for value in found]
    builder.ops.append(["top_k", [builder.name(given[0])], names, {"k": equation.params["k"]}])
    return list(found)


@several("while")
def _while(builder: Builder, equation: Any, given: list[Known]) -> list[Known]:
    named = equation.params
    of_test, of_body = named["cond_nconsts"], named["body_nconsts"]
    start = given[of_test + of_body :]
    carried = [builder.new(*output(equation, place)) for place in range(len(start))]
    results = [builder.new(value.shape, value.kind) for value in carried]
    test = builder.branch(named["cond_jaxpr"], given[:of_test], carried)
    body = builder.branch(named["body_jaxpr"], given[of_test : of_test + of_body], carried)
    attributes = {
        "carried": [value.name for value in carried],
        "kinds": [[value.kind, list(value.shape)] for value in carried],
        "test": test.as_json(),
        "body": body.as_json(),
    }
    names = [value.name for value in results]
    builder.ops.append(["while", [builder.name(value) for value in start], names, attributes])
    return list(results)


@several("scan")
def _scan(builder: Builder, equation: Any, given: list[Known]) -> list[Known]:
    """Unroll a scan; for one observation it has few passes."""
    named = equation.params
    if named["length"] > MOST_UNROLLED:
        raise NotImplementedError(f"a scan of {named['length']} passes")
    fixed, carried = _parts(named)
    consts, carry, over = given[:fixed], given[fixed:][:carried], given[fixed + carried :]
    rows: list[list[Known]] = []
    order = range(named["length"])
    for number in reversed(order) if named["reverse"] else order:
        now = [builder.reshaped(_part(builder, value, 0, number, number + 1), tuple(value.shape[1:])) for value in over]
        found = builder.inlined(named["jaxpr"].jaxpr, named["jaxpr"].consts, [*consts, *carry, *now])
        carry = found[:carried]
        rows.append(found[carried:])
    rows = rows[::-1] if named["reverse"] else rows
    stacked = []
    for place, each in enumerate(zip(*rows, strict=True)):
        shape, kind = output(equation, place + carried)
        parts = [builder.reshaped(value, (1, *value.shape)) for value in each]
        stacked.append(parts[0] if len(parts) == 1 else builder.add("concatenate", parts, shape, kind, axis=0))
    return [*carry, *stacked]


def _parts(named: Any) -> tuple[int, int]:
    """Return the numbers of constant and carried operands of a scan."""
    if "ft_in" in named:  # since JAX 0.11
        consts, carry, _ = named["ft_in"].unpack()
        return len(consts), len(carry)
    return named["num_consts"], named["num_carry"]


@several("cond")
def _cond(builder: Builder, equation: Any, given: list[Known]) -> list[Known]:
    """Evaluate every branch and select one result; nothing in a decision has side effects."""
    which, *operands = given
    branches = equation.params["branches"]
    if not isinstance(which, Value):
        branch = branches[int(np.clip(int(which), 0, len(branches) - 1))]
        return builder.inlined(branch.jaxpr, branch.consts, operands)
    found = [builder.inlined(branch.jaxpr, branch.consts, operands) for branch in branches]
    return [chosen(builder, which, list(each), *output(equation, n)) for n, each in enumerate(zip(*found, strict=True))]
