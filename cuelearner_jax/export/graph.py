"""Trace a function of one observation into a graph of few basic operations, which NumPy and ONNX can run.

JAX traces the function. Calls are inlined, whatever does not depend on the observation is computed once, and the rest
becomes the operations of `runner.OPERATIONS`. All shapes are fixed, since the input is one observation; a batch is
processed row by row.
"""

from __future__ import annotations

import itertools
import json
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.extend import core

from cuelearner_jax.devices import written_out


def kind_of(dtype: Any) -> str:
    """Return the name of a number type. Raises NotImplementedError for a type that no graph holds."""
    if str(dtype) not in ("float32", "int32", "bool"):
        raise NotImplementedError(f"numbers of type {dtype}")
    return str(dtype)


class Value(NamedTuple):
    """The output of an operation, known only when the graph runs."""

    name: str
    shape: tuple[int, ...]
    kind: str  # float32, int32 or bool; of a missing operation's output also another type


Operand = Value | np.ndarray | jax.Array  # a run-time value, or a constant


class Graph(NamedTuple):
    """Operations in executable order: [name, inputs, outputs, attributes]."""

    inputs: list[str]
    outputs: list[str]
    ops: list[list[Any]]


class Traced(NamedTuple):
    """A traced function."""

    graph: Graph
    constants: dict[str, np.ndarray]
    missing: tuple[str, ...]  # required JAX operations without a rule, or what their rule does not support
    random: bool  # whether the function depends on the key
    kinds: dict[str, str]  # of values and constants, by name


Rule = Callable[["Builder", Any, list[Any]], list[Operand]]  # (builder, equation, its inputs) -> its outputs
RULES: dict[str, Rule] = {}


def trace(function: Callable[[Any, Any], Any], obs_size: int) -> Traced:
    """Trace a function (key, observation (obs_size,)) -> action (action,) as a graph of the observation."""
    key, obs = jax.random.key(0), jax.ShapeDtypeStruct((obs_size,), jnp.float32)
    with written_out():
        closed = jax.make_jaxpr(function)(key, obs)
    builder = Builder()
    random, observation = Value("key", (), "key"), Value("obs", (obs_size,), "float32")
    (result,) = builder.inlined(closed.jaxpr, closed.consts, [random, observation])
    ops, needed = _needed(builder.ops, {builder.name(result)})
    constants = {name: array for name, array in builder.constants.items() if name in needed}
    missing = sorted({what for name, what in builder.missing.items() if name in needed})
    graph = Graph(["obs"], [builder.name(result)], ops)
    return Traced(graph, constants, tuple(missing), "key" in needed, {"obs": "float32", **builder.kinds})


def _needed(ops: list[list[Any]], results: set[str]) -> tuple[list[list[Any]], set[str]]:
    """Return the operations needed for `results`, and all names that they read."""
    needed, results = [], set(results)
    for op in reversed(ops):
        name, inputs, outputs, attributes = op
        if not results & set(outputs):
            continue
        needed.append(op)
        results |= set(inputs)
        for part in ("test", "body") if name == "while" else ():
            inner = attributes[part]
            inner["ops"], names = _needed(inner["ops"], set(inner["outputs"]))
            results |= names
    return needed[::-1], results


class Builder:
    """Collects the operations of a graph."""

    def __init__(self) -> None:
        self.ops: list[list[Any]] = []
        self.constants: dict[str, np.ndarray] = {}
        self.kinds: dict[str, str] = {}
        self.missing: dict[str, str] = {}  # what no rule supports, by the names of its outputs
        self._earlier: dict[str, Value] = {}  # results by operation and inputs
        self._constant_names: dict[int, tuple[Any, str]] = {}  # by identity; keeping the array reserves its identity
        self._numbers = itertools.count()

    def inlined(self, jaxpr: Any, consts: Any, inputs: list[Operand]) -> list[Operand]:
        """Add the operations of a jaxpr on its inputs; return its outputs."""
        values: dict[Any, Operand] = dict(zip(jaxpr.constvars, consts, strict=True))
        values.update(zip(jaxpr.invars, inputs, strict=True))

        def value_of(atom: Any) -> Operand:
            if isinstance(atom, core.Literal):
                return np.asarray(atom.val, atom.aval.dtype)  # pyright: ignore[reportAttributeAccessIssue]
            return values[atom]

        for equation in jaxpr.eqns:
            inputs = [value_of(atom) for atom in equation.invars]
            values.update(zip(equation.outvars, self._outputs(equation, inputs, jaxpr.debug_info), strict=True))
        return [value_of(atom) for atom in jaxpr.outvars]

    def _outputs(self, equation: Any, inputs: list[Operand], origin: Any) -> list[Operand]:
        name = equation.primitive.name
        if not any(isinstance(value, Value) for value in inputs):
            return _evaluate(equation, inputs, origin)
        if (inner := _inner_jaxpr(equation)) is not None:
            return self.inlined(inner.jaxpr, inner.consts, inputs)
        if name not in RULES:
            return self._missing(name, equation, inputs)
        try:
            for value in inputs:
                if isinstance(value, Value):
                    kind_of(value.kind)
            return RULES[name](self, equation, inputs)
        except NotImplementedError as error:
            return self._missing(str(error), equation, inputs)

    def _missing(self, what: str, equation: Any, inputs: list[Operand]) -> list[Operand]:
        """Add a placeholder for what no rule supports, which may turn out not to be needed."""
        outputs = [self.new(var.aval.shape, str(var.aval.dtype)) for var in equation.outvars]
        names = [value.name for value in outputs]
        self.missing.update(dict.fromkeys(names, what))
        self.ops.append(["missing", [value.name for value in inputs if isinstance(value, Value)], names, {}])
        return list(outputs)

    def new(self, shape: tuple[int, ...], kind: str) -> Value:
        """Return a value with a new name."""
        value = Value(f"v{next(self._numbers)}", tuple(shape), kind)
        self.kinds[value.name] = kind
        return value

    def add(self, op: str, inputs: list[Operand], shape: tuple[int, ...], kind: str, /, **attributes: Any) -> Value:
        """Add an operation with one output, or reuse an equal earlier one."""
        names = [self.name(value) for value in inputs]
        key = json.dumps([op, names, attributes])
        if key not in self._earlier:
            output = self._earlier[key] = self.new(shape, kind)
            self.ops.append([op, names, [output.name], attributes])
        return self._earlier[key]

    def name(self, value: Operand) -> str:
        """Return the name of a value; a known value becomes a constant."""
        if isinstance(value, Value):
            return value.name
        if id(value) not in self._constant_names:
            kind, name = kind_of(value.dtype), f"c{len(self._constant_names)}"
            self.constants[name], self.kinds[name] = np.asarray(value).astype(kind), kind
            self._constant_names[id(value)] = (value, name)
        return self._constant_names[id(value)][1]

    def reshaped(self, value: Operand, shape: tuple[int, ...]) -> Operand:
        """Reshape a value."""
        if tuple(value.shape) == tuple(shape):
            return value
        if not isinstance(value, Value):
            return jnp.reshape(value, shape)
        return self.add("reshape", [value], shape, value.kind, shape=list(map(int, shape)))

    def transposed(self, value: Operand, axes: tuple[int, ...]) -> Operand:
        """Permute a value's axes."""
        if tuple(axes) == tuple(range(len(axes))):
            return value
        if not isinstance(value, Value):
            return jnp.transpose(value, axes)
        turned, axes = tuple(value.shape[a] for a in axes), tuple(map(int, axes))
        return self.add("transpose", [value], turned, value.kind, axes=list(axes))

    def branch(self, jaxpr: Any, consts: list[Operand], carried: list[Value]) -> Graph:
        """Return a jaxpr of carried values as a graph of its own, which may read all outer values."""
        outer, self.ops = self.ops, []
        before = dict(self._earlier)
        results = self.inlined(jaxpr.jaxpr, jaxpr.consts, [*consts, *carried])
        operations, self.ops = self.ops, outer
        self._earlier = before  # operations inside are not available outside
        names = [value.name for value in carried]
        changing = set(names)
        inside = []  # what every pass must repeat; loop-invariant operations move before the loop
        for op in operations:
            name, inputs, outputs, _ = op
            if name == "while" or changing & set(inputs):
                inside.append(op)
                changing |= set(outputs)
            else:
                self.ops.append(op)
        return Graph(names, [self.name(result) for result in results], inside)


def _evaluate(equation: Any, inputs: list[Any], origin: Any) -> list[Any]:
    """Evaluate one equation with known inputs; `origin` is JAX's debug information."""
    values: dict[Any, Any] = {}
    for atom, value in zip(equation.invars, inputs, strict=True):
        if not isinstance(atom, core.Literal):
            values.setdefault(atom, value)
    alone = core.Jaxpr((), [*values], equation.outvars, [equation], debug_info=origin)
    return core.jaxpr_as_fun(core.ClosedJaxpr(alone, ()))(*values.values())


def _inner_jaxpr(equation: Any) -> Any:
    """Return the jaxpr that an equation merely calls, or None."""
    if equation.primitive.name in ("while", "cond", "scan"):
        return None
    for name in ("jaxpr", "call_jaxpr", "fun_jaxpr"):
        if (inner := equation.params.get(name)) is not None:
            return inner if hasattr(inner, "consts") else core.ClosedJaxpr(inner, ())
    return None
