"""Run a decision written by `cuelearner export`; this file lies beside every decision as `decide.py`.

    from decide import Decision
    decide = Decision("folder")        # verifies every file against the contract
    action = decide(observation)       # (obs,) -> (action,); or (n, obs) -> (n, action)
    action = decide(observation, base_action)       # for a correction alone, which runs beside its base
    action = decide(observation, *map(base, decide.base_observations(observation)))     # for any correction alone

It needs Python and NumPy, neither cuelearner nor JAX. Decisions in ONNX also need onnxruntime, and those in StableHLO
need JAX. Every row of a batch is processed by itself.
"""

from __future__ import annotations

import hashlib
import json
import operator
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

CONTRACT, GOLDEN = "contract.json", "golden.npz"
VERSION = 2  # of contracts and graphs
DIGEST = "digest"  # the key of a contract's digest of its other values

Values = dict[str, np.ndarray]
Run = Callable[[Values], None]


class ContractError(ValueError):
    """Raised for an invalid decision folder, or an observation that violates the contract. One line."""


class Decision:
    """An exported decision.

    `contract` is the content of contract.json: slices of the observation with sizes and units, the action's frame and
    sign.
    """

    def __init__(self, folder: str | Path) -> None:
        """Read a folder. Raises ContractError if a file is missing, damaged or changed, or cannot be run here."""
        self.folder = Path(folder)
        self.contract = read_contract(self.folder)
        base = self.contract.get("base", {})  # of a correction alone
        self._base, self._questions = base.get("size", 0), base.get("questions", 0)
        self._calls = self._questions or int("size" in base)  # without questions the base sees what is met
        self._size = self.contract["observation"]["size"] - self._base * self._calls
        artefact = self.contract["artefact"]
        self._decide = RUNNERS[artefact["format"]](self.folder / artefact["file"], self.contract)

    def __call__(self, obs: Any, *base_actions: Any) -> np.ndarray:
        """Return the action for an observation (obs,), or for each of a batch (n, obs): (action,) or (n, action).

        `base_actions`, for a correction alone: the base's action for each of `base_observations(obs)`. Raises
        ContractError for an observation of another size or not finite in single precision, and for a decision that
        gives no valid action.
        """
        if len(base_actions) != self._calls:
            alone = "correction alone: give the base's action about each of decide.base_observations(obs)"
            raise ContractError(
                f"{self.folder} holds a {alone if self._calls else 'whole policy: leave out base_action'}"
            )
        actions = self._outputs(obs, *base_actions)[..., : self.contract["action"]["size"]]
        if not np.isfinite(actions).all() or ("angle" in self.contract["action"] and not actions.any(axis=-1).all()):
            raise ContractError(f"{self.folder} gives numbers that are not finite, or zero, which is no direction")
        return actions

    def base_observations(self, obs: Any) -> list[np.ndarray]:
        """Return the observations to ask the base about, each of the shape of `obs`.

        `decide(obs, *map(base, decide.base_observations(obs)))` runs any decision: a correction that changes nothing of
        what the base sees returns `obs` itself, a whole policy nothing. Raises ContractError as calls do.
        """
        if not self._questions:
            self._checked(obs)
            return [np.asarray(obs)] * self._calls
        anything = np.zeros((*np.shape(obs)[:-1], self._base))  # what is asked does not depend on the base
        outputs = self._outputs(obs, *[anything] * self._calls)
        return np.split(outputs[..., self.contract["action"]["size"] :], self._questions, -1)

    def _outputs(self, obs: Any, *base_actions: Any) -> np.ndarray:
        parts = self._checked(obs, *base_actions)
        if not parts[0].size:
            return np.zeros((0, self.contract["action"]["size"] + self._questions * self._size), np.float32)
        rows = parts[0].ndim > 1
        batch = [np.ascontiguousarray(part if rows else part[None]) for part in parts]
        outputs = self._decide(*batch[:1], *([np.concatenate(batch[1:], -1)] if self._calls else []))
        return outputs if rows else outputs[0]

    def _checked(self, *arrays: Any) -> list[np.ndarray]:
        """Return an observation, or a batch, and base actions in single precision. Raises ContractError."""
        parts = [_numbers(part) for part in arrays]
        rows, sizes = parts[0].shape[:-1], (self._size, *[self._base] * self._calls)
        for part, size in zip(parts, sizes, strict=False):
            if len(rows) > 1 or part.shape != (*rows, size):
                advice = f"give ({size},), or equally many (n, {size})"
                raise ContractError(f"observations or base actions have shape {part.shape}: {advice}")
        if not all(np.isfinite(part).all() for part in parts):
            raise ContractError("an observation holds numbers that are not finite, or beyond single precision")
        return parts

    def check(self) -> float:
        """Recompute the golden cases; return the largest difference of an entry in its `units`.

        Raises ContractError if the difference is larger than the contract allows.
        """
        with np.load(self.folder / GOLDEN, allow_pickle=False) as golden:
            obs, actions = golden["obs"], golden["actions"]
        own, *bases = np.split(obs, [self._size + self._base * number for number in range(self._calls)], 1)
        result = np.concatenate([self(own, *bases), *(self.base_observations(own) if self._questions else [])], -1)
        difference = float((np.abs(result - actions) / units(actions, self.contract["action"]["space"])).max())
        allowed = self.contract["golden"]["tolerance"]
        if not difference <= allowed:
            raise ContractError(
                f"{self.folder} gives other actions here than where it was exported: golden cases differ by "
                f"{difference:.2g}, more than {allowed:g}; export it anew, or with --format stablehlo"
            )
        return difference


def units(actions: np.ndarray, space: dict[str, Any]) -> np.ndarray:
    """Return what differences of entries count in: an action's range in a box, else 1, or an entry that is larger."""
    sizes = np.maximum(np.abs(actions), 1)
    ranges = np.subtract(space["high"], space["low"]) if space.get("name") == "box" else ()
    sizes[..., : len(ranges)] = ranges
    return sizes


def _numbers(obs: Any) -> np.ndarray:
    """Return observations in single precision, infinite where out of its range."""
    rows = np.asarray(obs)
    if rows.dtype.kind not in "fiu" or not rows.ndim:
        raise ContractError(f"observations are of type {rows.dtype} and shape {rows.shape}: give rows of real numbers")
    with np.errstate(over="ignore"):
        return rows.astype(np.float32)


def digest(values: dict[str, Any]) -> str:
    """Return the SHA-256 of JSON values, independent of their order."""
    return hashlib.sha256(json.dumps(values, sort_keys=True).encode()).hexdigest()


def read_contract(folder: Path) -> dict[str, Any]:
    """Return the contract of a folder after verifying all files against their digests.

    Raises ContractError for the first file that was changed.
    """
    path = folder / CONTRACT
    try:
        contract = json.loads(path.read_text(encoding="utf-8"))
        sound = contract.pop(DIGEST) == digest(contract)
        digests = {name: hashlib.sha256((folder / name).read_bytes()).hexdigest() for name in contract["files"]}
    except OSError as error:
        raise ContractError(f"{error.filename} cannot be read ({error.strerror}): export the policy anew") from None
    except (ValueError, KeyError, AttributeError, TypeError):
        sound, contract, digests = False, {}, {}
    if not sound:
        raise ContractError(f"{path} is damaged or was changed: export the policy anew")
    if contract["version"] > VERSION:
        raise ContractError(f"{path} was written by a newer cuelearner: use the decide.py beside it, or update")
    for name, recorded in contract["files"].items():
        if digests[name] != recorded:
            raise ContractError(f"{folder / name} is not the file that was exported: export the policy anew")
    return contract


Batch = Callable[..., np.ndarray]  # observations (n, obs), and the base's actions -> actions (n, action)


def _of_numpy(path: Path, contract: dict[str, Any]) -> Batch:
    with np.load(path, allow_pickle=False) as stored:
        graph = json.loads(stored["graph"].tobytes())
        constants = {name: stored[name] for name in stored.files if name != "graph"}
    (source,), (result,) = graph["inputs"], graph["outputs"]
    run = compile_ops(graph["ops"])

    def decide(*batch: np.ndarray) -> np.ndarray:
        outputs = []
        with np.errstate(all="ignore"):  # JAX does not warn of floating-point errors either
            for row in np.concatenate(batch, -1):
                values = {**constants, source: row}
                run(values)
                outputs.append(values[result])
        return np.stack(outputs)

    return decide


def _of_onnx(path: Path, contract: dict[str, Any]) -> Batch:
    try:
        import onnxruntime
    except ImportError:
        raise ContractError("a decision in ONNX needs onnxruntime: pip install onnxruntime") from None
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1  # a robot's cores have other work
    options.log_severity_level = 3
    session = onnxruntime.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])
    names = [one.name for one in session.get_inputs()]
    return lambda *batch: np.hstack(session.run(None, dict(zip(names, batch, strict=True))))  # pyright: ignore


def _of_stablehlo(path: Path, contract: dict[str, Any]) -> Batch:
    try:
        import jax
        from jax import export
    except ImportError:
        raise ContractError("a decision in StableHLO needs JAX: pip install jax flatbuffers, or export NumPy") from None
    if b"callback" in (contents := path.read_bytes()):  # leads out of the program; no export contains one
        raise ContractError(f"{path} calls Python functions: export the policy anew")
    try:
        exported = export.deserialize(bytearray(contents))
        call = jax.jit(exported.call)
        call(*(np.zeros((1, each.shape[1]), np.float32) for each in exported.in_avals))
    except Exception:
        version = contract["artefact"]["jax"]
        raise ContractError(
            f"this decision was exported with JAX {version}, and JAX {jax.__version__} on {jax.default_backend()} "
            f"cannot call it: use JAX {version}, or export the policy anew with this one"
        ) from None
    return lambda *batch: np.asarray(call(*batch))


RUNNERS = {"numpy": _of_numpy, "onnx": _of_onnx, "stablehlo": _of_stablehlo}


# --- decisions of NumPy: the operations of a graph ---


def compile_ops(ops: list[list[Any]]) -> Run:
    """Return a graph's operations as one function, which adds their results to the values it is given.

    `ops`: each [name, inputs, outputs, attributes]; see `OPERATIONS`, `SETTLED` and `_loop`.
    """
    steps: list[tuple[Callable[..., Any], list[str], str | None]] = []
    for name, inputs, outputs, attributes in ops:
        if name == "while":
            steps.append((_loop(inputs, outputs, **attributes), [], None))
        else:
            steps.append((SETTLED[name](**attributes) if name in SETTLED else OPERATIONS[name], inputs, outputs[0]))

    def run(values: Values) -> None:
        for function, inputs, output in steps:
            if output is None:
                function(values)
            else:
                values[output] = function(*[values[name] for name in inputs])

    return run


def _loop(inputs: list[str], outputs: list[str], carried: list[str], kinds: Any, test: Any, body: Any) -> Run:
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


def _argument(function: Callable[..., Any]) -> Callable[..., Any]:
    return lambda axis: lambda x: np.asarray(function(x, axis=axis), np.int32)


def _reduction(function: np.ufunc) -> Callable[..., Any]:
    return lambda axes: lambda x, axis=tuple(axes): function.reduce(x, axis, x.dtype)


def _quotient(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Divide; integers round toward zero."""
    return np.asarray(np.trunc(np.true_divide(x, y)), x.dtype) if x.dtype.kind in "iu" else np.divide(x, y)


ONE = np.float32(1)

# For float32, int32 or bool arrays of fixed shapes. Elementwise ones take equal or broadcastable shapes.
OPERATIONS: dict[str, Callable[..., Any]] = {
    **{name: getattr(np, name) for name in ("abs", "sign", "floor", "ceil", "exp", "log", "log1p", "expm1", "sin")},
    **{name: getattr(np, name) for name in ("cos", "tan", "tanh", "sqrt", "square", "add", "take", "matmul")},
    **{"neg": np.negative, "round": np.rint, "atan": np.arctan, "atan2": np.arctan2, "is_finite": np.isfinite},
    **{"sub": np.subtract, "mul": np.multiply, "rem": np.fmod, "pow": np.power, "max": np.maximum, "min": np.minimum},
    **{"and": np.logical_and, "or": np.logical_or, "xor": np.logical_xor, "not": np.logical_not},
    **{"eq": np.equal, "ne": np.not_equal, "lt": np.less, "le": np.less_equal, "gt": np.greater},
    **{"ge": np.greater_equal, "select": np.where, "div": _quotient},
    "rsqrt": lambda x: ONE / np.sqrt(x),
    "logistic": lambda x: ONE / (ONE + np.exp(-x)),
}

# Operations with attributes, as functions that return the function of the arrays. For small arrays, preparing an
# operation is most of the work.
SETTLED: dict[str, Callable[..., Callable[..., Any]]] = {
    "cast": lambda dtype: operator.methodcaller("astype", dtype),
    "reshape": lambda shape: operator.methodcaller("reshape", tuple(shape)),
    "transpose": lambda axes: operator.methodcaller("transpose", tuple(axes)),
    "broadcast": lambda shape: lambda x: np.broadcast_to(x, shape),
    "concatenate": lambda axis: lambda *parts: np.concatenate(parts, axis),
    "slice": lambda start, stop, step: operator.itemgetter(tuple(map(slice, start, stop, step))),
    "pad": lambda low, high: lambda x, value: np.pad(x, list(zip(low, high, strict=True)), constant_values=value),
    **{"sum": _reduction(np.add), "largest": _reduction(np.maximum)},
    **{"smallest": _reduction(np.minimum), "all": _reduction(np.logical_and), "any": _reduction(np.logical_or)},
    **{"argmax": _argument(np.argmax), "argmin": _argument(np.argmin)},
}
