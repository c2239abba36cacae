"""How each operation of JAX is said by those of `operations.OPERATIONS`: one rule a primitive, by its name."""

from __future__ import annotations

import math
from typing import Any

import jax.numpy as jnp
import numpy as np
from jax.lax import GatherScatterMode, RoundingMethod

from cuelearner_jax.export.graph import KINDS, RULES, Builder, Known, Rule, Value

SAME = ("neg", "abs", "sign", "floor", "ceil", "exp", "log", "log1p", "expm1", "sin", "cos", "tan", "tanh", "atan")
SAME += ("sqrt", "rsqrt", "square", "logistic", "is_finite", "add", "sub", "mul", "div", "rem", "pow", "atan2")
SAME += ("eq", "ne", "lt", "le", "gt", "ge", "and", "or", "xor", "not")
MOST_UNROLLED = 64  # passes of a scan


def _out(equation: Any, place: int = 0) -> tuple[tuple[int, ...], str]:
    aval = equation.outvars[place].aval
    return tuple(aval.shape), KINDS[str(aval.dtype)]


def _elementwise(op: str) -> Rule:
    def rule(builder: Builder, equation: Any, given: list[Known]) -> list[Known]:
        return [builder.add(op, given, *_out(equation))]

    return rule


def _logical(of_numbers: str, of_bools: str) -> Rule:
    def rule(builder: Builder, equation: Any, given: list[Known]) -> list[Known]:
        shape, kind = _out(equation)
        return [builder.add(of_bools if kind == "bool" else of_numbers, given, shape, kind)]

    return rule


def _passed(builder: Builder, equation: Any, given: list[Known]) -> list[Known]:
    return given


def _reshaped(builder: Builder, equation: Any, given: list[Known]) -> list[Known]:
    return [builder.reshaped(given[0], _out(equation)[0])]


def _reduction(op: str) -> Rule:
    def rule(builder: Builder, equation: Any, given: list[Known]) -> list[Known]:
        return [builder.add(op, given, *_out(equation), axes=list(map(int, equation.params["axes"])))]

    return rule


def _argument(op: str) -> Rule:
    def rule(builder: Builder, equation: Any, given: list[Known]) -> list[Known]:
        (axis,) = equation.params["axes"]
        return [builder.add(op, given, *_out(equation), axis=int(axis))]

    return rule


def _cast(builder: Builder, equation: Any, given: list[Known]) -> list[Known]:
    shape, kind = _out(equation)
    (value,) = given
    assert isinstance(value, Value)
    return [value if value.kind == kind else builder.add("cast", [value], shape, kind, dtype=kind)]


def _integer_pow(builder: Builder, equation: Any, given: list[Known]) -> list[Known]:
    shape, kind = _out(equation)
    return [builder.add("pow", [given[0], np.asarray(equation.params["y"], kind)], shape, kind)]


def _select(builder: Builder, equation: Any, given: list[Known]) -> list[Known]:
    which, *cases = given
    return [_chosen(builder, which, cases, *_out(equation))]


def _chosen(builder: Builder, which: Known, cases: list[Known], shape: tuple[int, ...], kind: str) -> Known:
    """The case of a number, or of False and True."""
    is_bool = which.kind == "bool" if isinstance(which, Value) else which.dtype == bool
    if is_bool:
        return builder.add("select", [which, cases[1], cases[0]], shape, kind)
    found = cases[-1]
    for number, case in reversed(list(enumerate(cases[:-1]))):
        here = builder.add("le", [which, np.asarray(number, np.int32)], tuple(which.shape), "bool")
        found = builder.add("select", [here, case, found], shape, kind)
    return found


def _clamp(builder: Builder, equation: Any, given: list[Known]) -> list[Known]:
    low, x, high = given
    shape, kind = _out(equation)
    return [builder.add("min", [builder.add("max", [x, low], shape, kind), high], shape, kind)]


def _broadcast(builder: Builder, equation: Any, given: list[Known]) -> list[Known]:
    value, (shape, kind) = given[0], _out(equation)
    placed = [1] * len(shape)
    for axis, place in enumerate(equation.params["broadcast_dimensions"]):
        placed[place] = value.shape[axis]
    spread = builder.reshaped(value, tuple(placed))
    if tuple(placed) == shape:
        return [spread]
    return [builder.add("broadcast", [spread], shape, kind, shape=list(shape))]


def _transpose(builder: Builder, equation: Any, given: list[Known]) -> list[Known]:
    return [builder.transposed(given[0], equation.params["permutation"])]


def _concatenate(builder: Builder, equation: Any, given: list[Known]) -> list[Known]:
    return [builder.add("concatenate", given, *_out(equation), axis=int(equation.params["dimension"]))]


def _stack(builder: Builder, equation: Any, given: list[Known]) -> list[Known]:
    (shape, kind), axis = _out(equation), int(equation.params["axis"])
    row = (*shape[:axis], 1, *shape[axis + 1 :])
    return [builder.add("concatenate", [builder.reshaped(one, row) for one in given], shape, kind, axis=axis)]


def _cut(builder: Builder, value: Known, start: Any, stop: Any, step: Any = None) -> Known:
    step = [1] * len(value.shape) if step is None else list(step)
    if not isinstance(value, Value):
        return jnp.asarray(value)[tuple(slice(*each) for each in zip(start, stop, step, strict=True))]
    shape = tuple(math.ceil((b - a) / by) for a, b, by in zip(start, stop, step, strict=True))
    ends = {"start": list(map(int, start)), "stop": list(map(int, stop)), "step": list(map(int, step))}
    return value if shape == value.shape else builder.add("slice", [value], shape, value.kind, **ends)


def _slice(builder: Builder, equation: Any, given: list[Known]) -> list[Known]:
    named = equation.params
    return [_cut(builder, given[0], named["start_indices"], named["limit_indices"], named["strides"])]


def _split(builder: Builder, equation: Any, given: list[Known]) -> list[Known]:
    value, axis, at, found = given[0], equation.params["axis"], 0, []
    for size in equation.params["sizes"]:
        start, stop = [0] * len(value.shape), list(value.shape)
        start[axis], stop[axis] = at, at + size
        found.append(_cut(builder, value, start, stop))
        at += size
    return found


def _pad(builder: Builder, equation: Any, given: list[Known]) -> list[Known]:
    value, filling = given
    settings = [tuple(map(int, each)) for each in equation.params["padding_config"]]
    if any(inner for _, _, inner in settings):
        raise NotImplementedError("padding between entries")
    kept = [(max(-low, 0), size - max(-high, 0)) for (low, high, _), size in zip(settings, value.shape, strict=True)]
    value = _cut(builder, value, *zip(*kept, strict=True))
    ends = {"low": [max(low, 0) for low, _, _ in settings], "high": [max(high, 0) for _, high, _ in settings]}
    return [builder.add("pad", [value, filling], *_out(equation), **ends)]


def _taken(builder: Builder, value: Known, places: Known, shape: tuple[int, ...], kind: str) -> Value:
    """Entries of a value by their numbers in one row of all of them."""
    return builder.add("take", [builder.reshaped(value, (math.prod(value.shape),)), places], shape, kind)


def _rev(builder: Builder, equation: Any, given: list[Known]) -> list[Known]:
    shape, kind = _out(equation)
    places = np.flip(np.arange(math.prod(shape), dtype=np.int32).reshape(shape), equation.params["dimensions"])
    return [_taken(builder, given[0], places.copy(), shape, kind)]


def _strides(shape: tuple[int, ...]) -> list[int]:
    return [math.prod(shape[axis + 1 :]) for axis in range(len(shape))]


def _offsets(sizes: tuple[int, ...], strides: list[int]) -> np.ndarray:
    """Of every entry of a block of these sizes from its first."""
    numbers = np.zeros(sizes, np.int32)
    for axis, (size, stride) in enumerate(zip(sizes, strides, strict=True)):
        numbers += (np.arange(size, dtype=np.int32) * stride).reshape(
            [-1 if a == axis else 1 for a in range(len(sizes))]
        )
    return numbers


def _along(axis: int, axes: int, row: np.ndarray) -> np.ndarray:
    """A row laid along one of several axes."""
    return row.reshape([-1 if a == axis else 1 for a in range(axes)])


def _clipped(builder: Builder, start: Known, most: int, stride: int) -> Known:
    """stride * start, where a block that begins there still fits."""
    if not isinstance(start, Value):
        return np.asarray(np.clip(np.asarray(start, np.int32), 0, most) * np.int32(stride))
    shape = start.shape
    start = builder.add("max", [start, np.zeros((), np.int32)], shape, "int32")
    start = builder.add("min", [start, np.asarray(most, np.int32)], shape, "int32")
    return builder.add("mul", [start, np.asarray(stride, np.int32)], shape, "int32")


def _summed(builder: Builder, parts: list[Known], shape: tuple[int, ...]) -> Known:
    known = sum((np.asarray(part) for part in parts if not isinstance(part, Value)), np.zeros((), np.int32))
    total: Known = np.broadcast_to(known, shape).astype(np.int32)
    for part in parts:
        if isinstance(part, Value):
            total = builder.add("add", [part, total], shape, "int32")
    return total


def _dynamic_slice(builder: Builder, equation: Any, given: list[Known]) -> list[Known]:
    value, *starts = given
    shape, kind = _out(equation)
    strides = _strides(tuple(value.shape))
    parts = [
        _clipped(builder, start, size - cut, stride)
        for start, size, cut, stride in zip(starts, value.shape, shape, strides, strict=True)
    ]
    return [_taken(builder, value, _summed(builder, [*parts, _offsets(shape, strides)], shape), shape, kind)]


def _gather(builder: Builder, equation: Any, given: list[Known]) -> list[Known]:
    """Blocks of the operand, one for each row of indices (XLA's Gather)."""
    value, indices = given
    named, sizes, (shape, kind) = equation.params["dimension_numbers"], equation.params["slice_sizes"], _out(equation)
    fills = equation.params["mode"] == GatherScatterMode.FILL_OR_DROP
    strides, rows = _strides(tuple(value.shape)), tuple(indices.shape[:-1])
    gone = {*named.collapsed_slice_dims, *named.operand_batching_dims}
    inner = [axis for axis in range(len(value.shape)) if axis not in gone]
    block = tuple(sizes[axis] for axis in inner)
    parts: list[Known] = [_offsets(block, [strides[axis] for axis in inner]).reshape((*[1] * len(rows), *block))]
    missed: Known | None = None
    for place, axis in enumerate(named.start_index_map):
        start, stop = [0] * len(indices.shape), list(indices.shape)
        start[-1], stop[-1] = place, place + 1
        first = builder.reshaped(_cut(builder, indices, start, stop), (*rows, *[1] * len(block)))
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
        filling = equation.params["fill_value"]
        default = {"float32": np.nan, "int32": np.iinfo(np.int32).min, "bool": True}[kind]
        filling = np.asarray(default if filling is None else filling, kind)
        found = builder.add("select", [missed, filling, found], whole, kind)
    blocks, others = iter(range(len(rows), len(whole))), iter(range(len(rows)))
    return [
        builder.transposed(
            found, tuple(next(blocks) if axis in named.offset_dims else next(others) for axis in range(len(shape)))
        )
    ]


def _dot_general(builder: Builder, equation: Any, given: list[Known]) -> list[Known]:
    """As a product of matrices: (batch, left, summed) by (batch, summed, right)."""
    left, right = given
    (left_summed, right_summed), (left_batch, right_batch) = equation.params["dimension_numbers"]
    left_free = [a for a in range(len(left.shape)) if a not in (*left_summed, *left_batch)]
    right_free = [a for a in range(len(right.shape)) if a not in (*right_summed, *right_batch)]
    (shape, kind), size = _out(equation), lambda value, axes: math.prod(value.shape[a] for a in axes)
    batch = (size(left, left_batch),) if left_batch else ()
    m, k, n = size(left, left_free), size(left, left_summed), size(right, right_free)
    left = builder.reshaped(builder.transposed(left, (*left_batch, *left_free, *left_summed)), (*batch, m, k))
    right = builder.reshaped(builder.transposed(right, (*right_batch, *right_summed, *right_free)), (*batch, k, n))
    return [builder.reshaped(builder.add("matmul", [left, right], (*batch, m, n), kind), shape)]


def _round(builder: Builder, equation: Any, given: list[Known]) -> list[Known]:
    if equation.params["rounding_method"] != RoundingMethod.TO_NEAREST_EVEN:
        raise NotImplementedError("rounding halves away from zero")
    return [builder.add("round", given, *_out(equation))]


def _cumsum(builder: Builder, equation: Any, given: list[Known]) -> list[Known]:
    if equation.params["reverse"]:
        raise NotImplementedError("a cumulative sum from the end")
    return [builder.add("cumsum", given, *_out(equation), axis=int(equation.params["axis"]))]


def _top_k(builder: Builder, equation: Any, given: list[Known]) -> list[Known]:
    found = [builder.new(*_out(equation, place)) for place in (0, 1)]
    builder.ops.append(
        ["top_k", [builder.name(given[0])], [value.name for value in found], {"k": equation.params["k"]}]
    )
    return list(found)


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


def _scan(builder: Builder, equation: Any, given: list[Known]) -> list[Known]:
    """Pass by pass: of one observation they are few."""
    named = equation.params
    if named["length"] > MOST_UNROLLED:
        raise NotImplementedError(f"a scan of {named['length']} passes")
    fixed, carried = _parts(named)
    consts, carry, over = given[:fixed], given[fixed:][:carried], given[fixed + carried :]
    rows: list[list[Known]] = []
    order = range(named["length"])
    for number in reversed(order) if named["reverse"] else order:
        now = [_row(builder, value, number) for value in over]
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
    """How many operands of a scan are constants, and how many are carried."""
    if "ft_in" in named:  # since JAX 0.11
        consts, carry, _ = named["ft_in"].unpack()
        return len(consts), len(carry)
    return named["num_consts"], named["num_carry"]


def _row(builder: Builder, value: Known, number: int) -> Known:
    start, stop = [number] + [0] * (len(value.shape) - 1), [number + 1, *value.shape[1:]]
    return builder.reshaped(_cut(builder, value, start, stop), tuple(value.shape[1:]))


def _cond(builder: Builder, equation: Any, given: list[Known]) -> list[Known]:
    """Every branch, and the results of the one that is asked for: nothing in a decision has an effect."""
    which, *operands = given
    branches = equation.params["branches"]
    if not isinstance(which, Value):
        chosen = branches[int(np.clip(int(which), 0, len(branches) - 1))]
        return builder.inlined(chosen.jaxpr, chosen.consts, operands)
    found = [builder.inlined(branch.jaxpr, branch.consts, operands) for branch in branches]
    shapes = [_out(equation, place) for place in range(len(equation.outvars))]
    return [
        _chosen(builder, which, [results[place] for results in found], *shape) for place, shape in enumerate(shapes)
    ]


RULES.update({name: _elementwise(name) for name in SAME})
RULES.update(dict.fromkeys(("copy", "copy_p", "optimization_barrier", "stop_gradient"), _passed))
RULES.update(dict.fromkeys(("reshape", "squeeze", "expand_dims"), _reshaped))
RULES.update({"max": _logical("max", "or"), "min": _logical("min", "and")})
RULES.update(
    {
        **{"reduce_sum": _reduction("sum"), "reduce_prod": _reduction("prod"), "reduce_max": _reduction("largest")},
        **{"reduce_min": _reduction("smallest"), "reduce_and": _reduction("all"), "reduce_or": _reduction("any")},
        **{"argmax": _argument("argmax"), "argmin": _argument("argmin"), "convert_element_type": _cast},
        **{"integer_pow": _integer_pow, "select_n": _select, "clamp": _clamp, "broadcast_in_dim": _broadcast},
        **{"transpose": _transpose, "concatenate": _concatenate, "stack": _stack, "slice": _slice, "split": _split},
        **{"pad": _pad, "rev": _rev, "dynamic_slice": _dynamic_slice, "gather": _gather, "dot_general": _dot_general},
        **{"round": _round, "cumsum": _cumsum, "top_k": _top_k, "while": _while, "scan": _scan, "cond": _cond},
    }
)
