"""Rules that express each JAX operation by those of `operations.OPERATIONS`: one rule per primitive, by name.

A rule returns one value from (builder, the primitive's parameters, its inputs, shape and type of the output). A rule
of a primitive with several outputs, or with inner functions, takes the equation.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from typing import Any

import jax.numpy as jnp
import numpy as np
from jax.lax import GatherScatterMode, RoundingMethod

from cuelearner_jax.export.graph import KINDS, RULES, Builder, Known, Rule, Value

SAME = ("neg", "abs", "sign", "floor", "ceil", "exp", "log", "log1p", "expm1", "sin", "cos", "tan", "tanh", "atan")
SAME += ("sqrt", "rsqrt", "square", "logistic", "is_finite", "add", "sub", "mul", "div", "rem", "pow", "atan2")
SAME += ("eq", "ne", "lt", "le", "gt", "ge", "and", "or", "xor", "not")
REDUCTIONS = {"sum": "sum", "prod": "prod", "max": "largest", "min": "smallest", "and": "all", "or": "any"}
MOST_UNROLLED = 64  # passes of a scan

Shape = tuple[int, ...]
Single = Callable[[Builder, dict[str, Any], list[Known], Shape, str], Known]


def _out(equation: Any, place: int = 0) -> tuple[Shape, str]:
    aval = equation.outvars[place].aval
    return tuple(aval.shape), KINDS[str(aval.dtype)]


def _one(*names: str) -> Callable[[Single], Single]:
    """Register a function for primitives with one output."""

    def register(single: Single) -> Single:
        def rule(builder: Builder, equation: Any, given: list[Known]) -> list[Known]:
            return [single(builder, equation.params, given, *_out(equation))]

        RULES.update(dict.fromkeys(names, rule))
        return single

    return register


def _several(name: str) -> Callable[[Rule], Rule]:
    """Register the rule of a primitive with several outputs."""
    return lambda rule: RULES.setdefault(name, rule)


def _said_by(op: str, of_bools: str = "", **attributes: Callable[[Any], Any]) -> Single:
    """Return a rule for one operation (another one for booleans); attributes are functions of the parameters."""

    def single(builder: Builder, params: dict[str, Any], given: list[Known], shape: Shape, kind: str) -> Known:
        own = {name: told(params) for name, told in attributes.items()}
        return builder.add(of_bools if of_bools and kind == "bool" else op, given, shape, kind, **own)

    return single


for _name in SAME:
    _one(_name)(_said_by(_name))
for _name in ("argmax", "argmin"):
    _one(_name)(_said_by(_name, axis=lambda params: int(params["axes"][0])))
for _name, _op in REDUCTIONS.items():
    _one(f"reduce_{_name}")(_said_by(_op, axes=lambda params: list(map(int, params["axes"]))))
_one("max")(_said_by("max", of_bools="or"))
_one("min")(_said_by("min", of_bools="and"))
_one("concatenate")(_said_by("concatenate", axis=lambda params: int(params["dimension"])))
_one("copy", "copy_p", "optimization_barrier", "stop_gradient")(lambda b, params, given, shape, kind: given[0])
_one("reshape", "squeeze", "expand_dims")(lambda b, params, given, shape, kind: b.reshaped(given[0], shape))
_one("transpose")(lambda b, params, given, shape, kind: b.transposed(given[0], params["permutation"]))
_one("select_n")(lambda b, params, given, shape, kind: _chosen(b, given[0], given[1:], shape, kind))


@_one("convert_element_type")
def _cast(builder: Builder, params: Any, given: list[Known], shape: Shape, kind: str) -> Known:
    (value,) = given
    assert isinstance(value, Value)
    return value if value.kind == kind else builder.add("cast", [value], shape, kind, dtype=kind)


@_one("integer_pow")
def _integer_pow(builder: Builder, params: Any, given: list[Known], shape: Shape, kind: str) -> Known:
    return builder.add("pow", [given[0], np.asarray(params["y"], kind)], shape, kind)


def _chosen(builder: Builder, which: Known, cases: list[Known], shape: Shape, kind: str) -> Known:
    """Select the case of a number, or of False and True."""
    is_bool = which.kind == "bool" if isinstance(which, Value) else which.dtype == bool
    if is_bool:
        return builder.add("select", [which, cases[1], cases[0]], shape, kind)
    found = cases[-1]
    for number, case in reversed(list(enumerate(cases[:-1]))):
        here = builder.add("le", [which, np.asarray(number, np.int32)], tuple(which.shape), "bool")
        found = builder.add("select", [here, case, found], shape, kind)
    return found


@_one("clamp")
def _clamp(builder: Builder, params: Any, given: list[Known], shape: Shape, kind: str) -> Known:
    low, x, high = given
    return builder.add("min", [builder.add("max", [x, low], shape, kind), high], shape, kind)


@_one("broadcast_in_dim")
def _broadcast(builder: Builder, params: Any, given: list[Known], shape: Shape, kind: str) -> Known:
    placed = [1] * len(shape)
    for axis, place in enumerate(params["broadcast_dimensions"]):
        placed[place] = given[0].shape[axis]
    spread = builder.reshaped(given[0], tuple(placed))
    return spread if tuple(placed) == shape else builder.add("broadcast", [spread], shape, kind, shape=list(shape))


@_one("stack")
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


@_one("slice")
def _slice(builder: Builder, params: Any, given: list[Known], shape: Shape, kind: str) -> Known:
    return _cut(builder, given[0], params["start_indices"], params["limit_indices"], params["strides"])


@_several("split")
def _split(builder: Builder, equation: Any, given: list[Known]) -> list[Known]:
    ends = np.cumsum([0, *equation.params["sizes"]]).tolist()
    axis = equation.params["axis"]
    return [_part(builder, given[0], axis, *pair) for pair in itertools.pairwise(ends)]


@_one("pad")
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


@_one("rev")
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


@_one("dynamic_slice")
def _dynamic_slice(builder: Builder, params: Any, given: list[Known], shape: Shape, kind: str) -> Known:
    value, *starts = given
    strides = _strides(tuple(value.shape))
    parts = [
        _clipped(builder, start, size - cut, stride)
        for start, size, cut, stride in zip(starts, value.shape, shape, strides, strict=True)
    ]
    return _taken(builder, value, _summed(builder, [*parts, _offsets(shape, strides)], shape), shape, kind)


@_one("gather")
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
        if fills and isinstance(first, Value):
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
        found = builder.add("select", [missed, filling, found], whole, kind)
    blocks, others = iter(range(len(rows), len(whole))), iter(range(len(rows)))
    order = (next(blocks) if axis in named.offset_dims else next(others) for axis in range(len(shape)))
    return builder.transposed(found, tuple(order))


@_one("dot_general")
def _dot_general(builder: Builder, params: Any, given: list[Known], shape: Shape, kind: str) -> Known:
    """Express the product as (batch, left, summed) by (batch, summed, right)."""
    left, right = given
    (left_summed, right_summed), (left_batch, right_batch) = params["dimension_numbers"]
    left_free = [a for a in range(len(left.shape)) if a not in (*left_summed, *left_batch)]
    right_free = [a for a in range(len(right.shape)) if a not in (*right_summed, *right_batch)]
    size = lambda value, axes: math.prod(value.shape[a] for a in axes)  # noqa: E731
    batch = (size(left, left_batch),) if left_batch else ()
    m, k, n = size(left, left_free), size(left, left_summed), size(right, right_free)
    left = builder.reshaped(builder.transposed(left, (*left_batch, *left_free, *left_summed)), (*batch, m, k))
    right = builder.reshaped(builder.transposed(right, (*right_batch, *right_summed, *right_free)), (*batch, k, n))
    return builder.reshaped(builder.add("matmul", [left, right], (*batch, m, n), kind), shape)


@_one("round")
def _round(builder: Builder, params: Any, given: list[Known], shape: Shape, kind: str) -> Known:
    if params["rounding_method"] != RoundingMethod.TO_NEAREST_EVEN:
        raise NotImplementedError("rounding halves away from zero")
    return builder.add("round", given, shape, kind)


@_one("cumsum")
def _cumsum(builder: Builder, params: Any, given: list[Known], shape: Shape, kind: str) -> Known:
    if params["reverse"]:
        raise NotImplementedError("a cumulative sum from the end")
    return builder.add("cumsum", given, shape, kind, axis=int(params["axis"]))


@_several("top_k")
def _top_k(builder: Builder, equation: Any, given: list[Known]) -> list[Known]:
    found = [builder.new(*_out(equation, place)) for place in (0, 1)]
    names = [value.name for value in found]
    builder.ops.append(["top_k", [builder.name(given[0])], names, {"k": equation.params["k"]}])
    return list(found)


@_several("while")
def _while(builder: Builder, equation: Any, given: list[Known]) -> list[Known]:
    named = equation.params
    of_test, of_body = named["cond_nconsts"], named["body_nconsts"]
    start = given[of_test + of_body :]
    carried = [builder.new(*_out(equation, place)) for place in range(len(start))]
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


@_several("scan")
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
        shape, kind = _out(equation, place + carried)
        parts = [builder.reshaped(value, (1, *value.shape)) for value in each]
        stacked.append(parts[0] if len(parts) == 1 else builder.add("concatenate", parts, shape, kind, axis=0))
    return [*carry, *stacked]


def _parts(named: Any) -> tuple[int, int]:
    """Return the numbers of constant and carried operands of a scan."""
    if "ft_in" in named:  # since JAX 0.11
        consts, carry, _ = named["ft_in"].unpack()
        return len(consts), len(carry)
    return named["num_consts"], named["num_carry"]


@_several("cond")
def _cond(builder: Builder, equation: Any, given: list[Known]) -> list[Known]:
    """Evaluate every branch and select one result; nothing in a decision has side effects."""
    which, *operands = given
    branches = equation.params["branches"]
    if not isinstance(which, Value):
        chosen = branches[int(np.clip(int(which), 0, len(branches) - 1))]
        return builder.inlined(chosen.jaxpr, chosen.consts, operands)
    found = [builder.inlined(branch.jaxpr, branch.consts, operands) for branch in branches]
    return [_chosen(builder, which, list(each), *_out(equation, n)) for n, each in enumerate(zip(*found, strict=True))]
