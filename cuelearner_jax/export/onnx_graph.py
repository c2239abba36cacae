"""Write a decision's graph in ONNX: a scan over the rows of a batch, whose body is the graph of one observation.

Written operation by operation from the graph that NumPy runs. The converter jax2onnx 0.17 has no rule for a dense layer
under vmap, which ensembles and aims need.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from typing import Any

import numpy as np

from cuelearner_jax.errors import UserError
from cuelearner_jax.export.graph import Traced

OPSET, IR_VERSION = 18, 8  # of 2022, supported by runtimes of several years
INPUTS, OUTPUTS = ("obs", "base_action"), ("action", "base_obs")  # the second ones of a correction alone


def serialize(traced: Traced, inputs: list[int], outputs: list[int]) -> bytes:
    """Return the bytes of a model, with inputs and outputs of these sizes by `INPUTS` and `OUTPUTS`."""
    try:
        from onnx import TensorProto, checker, helper, numpy_helper
    except ImportError:
        raise UserError("--format onnx needs the extra: pip install 'cuelearner-jax[onnx]'") from None
    writer = _Writer(helper, TensorProto, traced.kinds)
    (result,) = traced.graph.outputs
    nodes = writer.nodes(traced.graph.ops, {"obs": "row"}, "")
    nodes.append(helper.make_node("Identity", [writer.names.get(result, result)], ["decided"]))
    info, kind = helper.make_tensor_value_info, TensorProto.FLOAT
    row, decided = info("row", kind, [sum(inputs)]), info("decided", kind, [sum(outputs)])
    body = helper.make_graph(nodes, "one_observation", [row], [decided])
    batch = [info(name, kind, ["n", size]) for name, size in zip(INPUTS, inputs, strict=False)]
    results = [info(name, kind, ["n", size]) for name, size in zip(OUTPUTS, outputs, strict=False)]
    nodes = [
        helper.make_node("Concat", INPUTS[: len(inputs)], ["rows"], axis=1),
        helper.make_node("Scan", ["rows"], ["decisions"], body=body, num_scan_inputs=1),
        helper.make_node("Split", ["decisions", writer.whole(outputs)], OUTPUTS[: len(outputs)], axis=1),
    ]
    constants = {**traced.constants, **writer.constants}
    stored = [numpy_helper.from_array(np.asarray(array, order="C"), name) for name, array in constants.items()]
    graph = helper.make_graph(nodes, "decision", batch, results, stored)
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", OPSET)], producer_name="cuelearner")
    model.ir_version = IR_VERSION
    checker.check_model(model)
    return model.SerializeToString()


class _Writer:
    """Converts operations to nodes. Names are unique in the whole model, since inner graphs see outer names."""

    def __init__(self, helper: Any, types: Any, kinds: dict[str, str]) -> None:
        self.helper, self._kinds = helper, kinds
        self.kind = ""  # of the present operation's first input
        self.kinds = {"float32": types.FLOAT, "int32": types.INT32, "bool": types.BOOL}
        self.counter = types.INT64
        self.constants: dict[str, np.ndarray] = {}
        self.names: dict[str, str] = {}  # the graph's names of values -> this model's, where they differ
        self._nodes: list[Any] = []
        self._numbers = itertools.count()

    def nodes(self, ops: list[list[Any]], names: dict[str, str], suffix: str) -> list[Any]:
        """Return the nodes of operations; `names` renames inputs, and `suffix` is appended to outputs."""
        outer, self._nodes = self._nodes, []
        self.names.update(names)
        for op, inputs, outputs, attributes in ops:
            operands: Any = [self.names.get(name, name) for name in inputs]
            self.names.update({name: name + suffix for name in outputs})
            results = [self.names[name] for name in outputs]
            self.kind = self._kinds[inputs[0]]
            if op == "while":
                self._loop(operands, results, **attributes)
            else:
                self._append("Identity", [NODES[op](self, *operands, **attributes)], results[0])
        nodes, self._nodes = self._nodes, outer
        return nodes

    def node(self, kind: str, *inputs: str, **attributes: Any) -> str:
        """Add a node; return the name of its output."""
        name = f"n{next(self._numbers)}"
        self._append(kind, list(inputs), name, **attributes)
        return name

    def _append(self, kind: str, inputs: list[str], output: str, **attributes: Any) -> None:
        self._nodes.append(self.helper.make_node(kind, inputs, [output], **attributes))

    def constant(self, array: np.ndarray) -> str:
        """Return the name of a constant array."""
        for name, other in self.constants.items():
            if other.dtype == array.dtype and np.array_equal(other, array):
                return name
        name = f"k{len(self.constants)}"
        self.constants[name] = array
        return name

    def whole(self, numbers: Any) -> str:
        """Return the name of a constant row of integers."""
        return self.constant(np.array(numbers, np.int64).reshape(-1))

    def number(self, value: float) -> str:
        """Return the name of a constant number."""
        return self.constant(np.array(value, np.float32))

    def cast(self, value: str, kind: str) -> str:
        return self.node("Cast", value, to=self.kinds[kind])

    def _loop(
        self, operands: list[str], results: list[str], carried: list[str], kinds: Any, test: Any, body: Any
    ) -> None:
        """Convert a loop: ONNX reads the condition at the end of a pass, this graph at its beginning."""
        self._nodes += self.nodes(test["ops"], dict(zip(carried, operands, strict=True)), f"_t{next(self._numbers)}")
        condition = self.names[test["outputs"][0]]
        mark = f"_b{next(self._numbers)}"
        inside = [name + mark for name in carried]
        nodes = self.nodes(body["ops"], dict(zip(carried, inside, strict=True)), mark)
        after = []
        for number, name in enumerate(body["outputs"]):  # ONNX requires a graph's outputs to be nodes of its own
            after.append(f"{self.names.get(name, name)}_{number}{mark}")
            nodes.append(self.helper.make_node("Identity", [self.names.get(name, name)], [after[-1]]))
        mark = f"_e{next(self._numbers)}"
        nodes += self.nodes(test["ops"], dict(zip(carried, after, strict=True)), mark)
        goes_on = f"goes_on{mark}"
        nodes.append(self.helper.make_node("Identity", [self.names[test["outputs"][0]]], [goes_on]))
        info = self.helper.make_tensor_value_info
        takes = [info(f"pass{mark}", self.counter, []), info(f"go{mark}", self.kinds["bool"], [])]
        takes += [info(name, self.kinds[kind], shape) for name, (kind, shape) in zip(inside, kinds, strict=True)]
        gives = [info(goes_on, self.kinds["bool"], [])]
        gives += [info(name, self.kinds[kind], shape) for name, (kind, shape) in zip(after, kinds, strict=True)]
        graph = self.helper.make_graph(nodes, f"body{mark}", takes, gives)
        self._nodes.append(self.helper.make_node("Loop", ["", condition, *operands], results, body=graph))


def _plain(kind: str, **fixed: Any) -> Callable[..., str]:
    return lambda w, *inputs: w.node(kind, *inputs, **fixed)


def _sum(w: _Writer, x: str, axes: list[int]) -> str:
    """Sum; integers with 64 bits, as onnxruntime does not let those of 32 bits wrap."""
    if w.kind != "int32":
        return w.node("ReduceSum", x, w.whole(axes), keepdims=0)
    return w.cast(w.node("ReduceSum", w.node("Cast", x, to=w.counter), w.whole(axes), keepdims=0), "int32")


def _extreme(kind: str) -> Callable[..., str]:
    """Reduce to the largest or smallest entry, or to NaN if one is NaN, which ONNX leaves open."""

    def extreme(w: _Writer, x: str, axes: list[int]) -> str:
        extreme_value = w.node(kind, x, w.whole(axes), keepdims=0)
        if w.kind != "float32":
            return extreme_value
        return w.node("Where", _of_bools("ReduceMax")(w, w.node("IsNaN", x), axes), w.number(math.nan), extreme_value)

    return extreme


def _of_bools(kind: str) -> Callable[..., str]:
    return lambda w, x, axes: w.cast(w.node(kind, w.cast(x, "int32"), w.whole(axes), keepdims=0), "bool")


def _argument(kind: str) -> Callable[..., str]:
    """Find the place of the largest or smallest entry, or of the first NaN."""

    def argument(w: _Writer, x: str, axis: int) -> str:
        place = w.node(kind, x, axis=axis, keepdims=0)
        if w.kind == "float32":
            odd = w.node("IsNaN", x)
            first = w.node("ArgMax", w.cast(odd, "int32"), axis=axis, keepdims=0)
            place = w.node("Where", _of_bools("ReduceMax")(w, odd, [axis]), first, place)
        return w.cast(place, "int32")

    return argument


def _log1p(w: _Writer, x: str) -> str:
    """Compute log(1 + x), of small numbers by atanh, which keeps their digits."""
    ratio = w.node("Div", x, w.node("Add", x, w.number(2.0)))
    small = w.node("Less", w.node("Abs", x), w.number(0.5))
    near = w.node("Mul", w.node("Atanh", w.node("Where", small, ratio, w.number(0.0))), w.number(2.0))
    return w.node("Where", small, near, w.node("Log", w.node("Add", x, w.number(1.0))))


def _expm1(w: _Writer, x: str) -> str:
    """Compute exp(x) - 1 as tanh(x / 2) (exp(x) + 1), which keeps the digits of small numbers."""
    half = w.node("Tanh", w.node("Mul", x, w.number(0.5)))
    return w.node("Mul", half, w.node("Add", w.node("Exp", x), w.number(1.0)))


def _atan2(w: _Writer, y: str, x: str) -> str:
    """Compute atan2 from atan, which ONNX has; exact to a few units in the last place."""
    zero = w.number(0.0)
    both = w.node("And", w.node("IsInf", x), w.node("IsInf", y))  # where only signs count
    x, y = (w.node("Where", both, w.node("Sign", one), one) for one in (x, y))
    negative, down = (  # the reciprocal tells -0 from 0
        w.node("Or", w.node("Less", one, zero), w.node("Less", w.node("Reciprocal", one), zero)) for one in (x, y)
    )
    steep = w.node("Equal", x, zero)
    slope = w.node("Atan", w.node("Div", y, w.node("Where", steep, w.number(1.0), x)))
    half = w.node("Where", down, w.number(-math.pi), w.number(math.pi))
    turned = w.node("Where", negative, w.node("Add", slope, half), slope)
    level = w.node("Where", negative, half, y)
    straight = w.node("Where", w.node("Equal", y, zero), level, w.node("Mul", w.node("Sign", y), w.number(math.pi / 2)))
    return w.node("Where", steep, straight, turned)


# Operations that ONNX has too, by both names.
ALIKE = {name.lower(): name for name in ("Neg", "Abs", "Sign", "Floor", "Ceil", "Round", "Exp", "Log", "Sin", "Cos")}
ALIKE |= {name.lower(): name for name in ("Tan", "Tanh", "Atan", "Sqrt", "Not", "Add", "Sub", "Mul", "Div", "Pow")}
ALIKE |= {name.lower(): name for name in ("Max", "Min", "And", "Or", "Xor", "MatMul")}
ALIKE |= {"eq": "Equal", "lt": "Less", "le": "LessOrEqual", "gt": "Greater", "ge": "GreaterOrEqual", "select": "Where"}

# By the names of `runner.OPERATIONS`: (writer, input names, attributes) -> output name.
NODES: dict[str, Callable[..., str]] = {
    **{name: _plain(kind) for name, kind in ALIKE.items()},
    "log1p": _log1p,
    "expm1": _expm1,
    "rsqrt": lambda w, x: w.node("Reciprocal", w.node("Sqrt", x)),
    "square": lambda w, x: w.node("Mul", x, x),
    # the Sigmoid of onnxruntime is 0 from -18 on
    "logistic": lambda w, x: w.node("Reciprocal", w.node("Add", w.node("Exp", w.node("Neg", x)), w.number(1.0))),
    "is_finite": lambda w, x: w.node("Not", w.node("Or", w.node("IsInf", x), w.node("IsNaN", x))),
    "rem": _plain("Mod", fmod=1),
    "atan2": _atan2,
    "ne": lambda w, x, y: w.node("Not", w.node("Equal", x, y)),
    "cast": lambda w, x, dtype: w.cast(x, dtype),
    "reshape": lambda w, x, shape: w.node("Reshape", x, w.whole(shape)),
    "transpose": lambda w, x, axes: w.node("Transpose", x, perm=axes),
    "broadcast": lambda w, x, shape: w.node("Expand", x, w.whole(shape)),
    "concatenate": lambda w, *parts, axis: w.node("Concat", *parts, axis=axis),
    "slice": lambda w, x, start, stop, step: w.node("Slice", x, *map(w.whole, (start, stop, range(len(start)), step))),
    "pad": lambda w, x, value, low, high: w.node("Pad", x, w.whole([*low, *high]), value),
    "take": lambda w, x, places: w.node("Gather", x, places, axis=0),
    "sum": _sum,
    "largest": _extreme("ReduceMax"),
    "smallest": _extreme("ReduceMin"),
    "all": _of_bools("ReduceMin"),
    "any": _of_bools("ReduceMax"),
    "argmax": _argument("ArgMax"),
    "argmin": _argument("ArgMin"),
}
