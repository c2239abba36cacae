"""Runs a decision that `cuelearner export` wrote; a copy of this file lies beside every decision as `decide.py`.

    from decide import Decision
    decide = Decision("folder")        # verifies every file against the contract
    action = decide(observation)       # (obs,) -> a unit vector (2,); or (n, obs) -> (n, 2)

It needs Python and NumPy, nothing of cuelearner or JAX; decisions in ONNX also need onnxruntime, those in StableHLO
need JAX. Every row of a batch is decided by itself.
"""

from __future__ import annotations

import hashlib
import json
import math
import operator
import threading
import zipfile
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

CONTRACT, GOLDEN = "contract.json", "golden.npz"
VERSION = 1  # of contracts and graphs
DIGEST = "digest"  # the name under which a contract holds the digest of its other values
VECTORS = ("observation", "action")
MOST = 1 << 20  # entries of an observation or an action, and golden cases
LARGEST_CONTRACT, LARGEST_FILE = 1 << 26, 1 << 30  # bytes, unpacked
LARGEST_ARRAY = 1 << 28  # entries that an operation makes of fewer
LOOSEST = 1e-2  # tolerance that still says that two actions are one

Values = dict[str, np.ndarray]
Run = Callable[[Values], None]


class ContractError(ValueError):
    """A folder that holds no sound decision, or an observation that is not what its contract says. One line."""


class Decision:
    """An exported decision.

    `contract` is what contract.json says: slices of the observation with sizes and units, the action's frame and sign.
    """

    def __init__(self, folder: str | Path) -> None:
        """Reads a folder. Raises ContractError if a file is missing, damaged or changed, or cannot be run here."""
        self.folder = Path(folder)
        self.contract = read_contract(self.folder)
        self._decide = self._sound(lambda: RUNNERS[self.contract["artefact"]["format"]](self.folder, self.contract))

    @property
    def unlisted(self) -> list[str]:
        """Names of what lies in the folder and is not in the contract: nobody vouches for that."""
        known = (CONTRACT, "__pycache__", *self.contract["files"])
        return sorted(path.name for path in self.folder.iterdir() if path.name not in known)

    def __call__(self, obs: Any) -> np.ndarray:
        """The action for an observation (obs,), or for each of a batch (n, obs): unit vectors (2,) or (n, 2).

        Raises ContractError for an observation of another size, or one that is not finite in single precision; for a
        decision that is no direction.
        """
        rows, size = _numbers(obs), self.contract["observation"]["size"]
        batch = rows[None] if rows.ndim == 1 else rows
        if batch.ndim != 2 or batch.shape[1] != size:
            raise ContractError(f"observations have shape {rows.shape}: the contract says ({size},) or (n, {size})")
        if not np.isfinite(batch).all():
            raise ContractError("an observation holds numbers that are not finite, or beyond single precision")
        if not len(batch):
            return np.zeros((0, self.contract["action"]["size"]), np.float32)
        actions = self._sound(lambda: self._decide(np.ascontiguousarray(batch)))
        wanted = (len(batch), self.contract["action"]["size"])
        if actions.shape != wanted or actions.dtype.kind != "f" or not np.isfinite(actions).all():
            raise ContractError(f"{self.folder} decides on no finite numbers of shape {wanted}: export the policy anew")
        if not actions.any(axis=-1).all():
            raise ContractError(f"{self.folder} decides on zero, which is no direction: export the policy anew")
        return actions[0] if rows.ndim == 1 else actions

    def _sound(self, work: Callable[[], Any]) -> Any:
        """What some work on the artefact gives; of one that makes no sense whatever is raised is told in one line."""
        try:
            return work()
        except ContractError:
            raise
        except Exception as error:
            told = f"{type(error).__name__}: {' '.join(str(error).split())}"[:160]
            raise ContractError(
                f"{self.folder} holds a decision that makes no sense here ({told}): export the policy anew"
            ) from None

    def angle(self, obs: Any) -> np.ndarray:
        """The same as angles [rad], counterclockwise positive, 0 along x: () or (n,)."""
        actions = self(obs)
        return np.asarray(np.arctan2(actions[..., 1], actions[..., 0]))

    def check(self) -> float:
        """Decides the golden cases anew. Returns the largest difference of an entry from what is recorded.

        Raises ContractError if that is more than the contract allows.
        """
        obs, actions = self._sound(self._golden)
        difference = float(np.abs(self(obs) - actions).max())
        allowed = self.contract["golden"]["tolerance"]
        if not difference <= allowed:
            raise ContractError(
                f"{self.folder} decides otherwise here than where it was exported: golden cases differ by "
                f"{difference:.2g}, more than {allowed:g}; export it anew"
            )
        return difference

    def _golden(self) -> tuple[np.ndarray, np.ndarray]:
        """Observations (cases, obs) and actions (cases, action). Raises ValueError unless they are as many as told."""
        _check_unpacked(self.folder / GOLDEN)
        with np.load(self.folder / GOLDEN, allow_pickle=False) as golden:
            obs, actions = golden["obs"], golden["actions"]
        cases, sizes = self.contract["golden"]["cases"], (self.contract[part]["size"] for part in VECTORS)
        if [array.shape for array in (obs, actions)] != [(cases, size) for size in sizes]:
            raise ValueError(f"the shapes of the golden cases are {obs.shape} and {actions.shape}")
        if not all(array.dtype.kind == "f" and np.isfinite(array).all() for array in (obs, actions)):
            raise ValueError("golden cases are not finite")
        return obs, actions


def _check_unpacked(path: Path) -> None:
    """Raises ValueError for arrays that are packed more densely than any decision's."""
    with zipfile.ZipFile(path) as packed:
        if sum(part.file_size for part in packed.infolist()) > LARGEST_FILE:
            raise ValueError(f"{path.name} declares more than {LARGEST_FILE:,} bytes")


def _numbers(obs: Any) -> np.ndarray:
    """Observations in single precision, infinite where that does not hold them."""
    try:
        rows = np.asarray(obs)
    except (TypeError, ValueError):  # rows of different lengths
        rows = np.empty(0, object)
    if rows.dtype.kind not in "fiu":
        raise ContractError(f"observations are of type {rows.dtype}: give real numbers")
    with np.errstate(over="ignore"):
        return rows.astype(np.float32)


def digest(values: dict[str, Any]) -> str:
    """Of JSON values, whatever their order."""
    return hashlib.sha256(json.dumps(values, sort_keys=True).encode()).hexdigest()


def read_contract(folder: Path) -> dict[str, Any]:
    """The contract of a folder whose files are all as they were written.

    Raises ContractError for the first that is not.
    """
    path = folder / CONTRACT
    try:
        small = path.stat().st_size <= LARGEST_CONTRACT
        contract = json.loads(path.read_text(encoding="utf-8") if small else "")
        told = contract.pop(DIGEST)
        sound = told == digest(contract)
    except OSError as error:
        raise ContractError(f"{path} cannot be read ({error.strerror}): give a folder of cuelearner export") from None
    except (ValueError, KeyError, AttributeError, TypeError, RecursionError):
        sound, contract = False, {}
    if not sound:
        raise ContractError(f"{path} is damaged or was changed: export the policy anew")
    version = contract.get("version")
    if type(version) is int and version > VERSION:
        raise ContractError(f"{path} was written by a newer cuelearner: use the decide.py beside it, or update")
    try:
        _check(contract)
    except (ValueError, KeyError, AttributeError, TypeError) as error:
        told = f"no {error}" if isinstance(error, KeyError) else f"{error}"
        raise ContractError(f"{path} makes no sense ({told[:160]}): export the policy anew") from None
    for name, recorded in contract["files"].items():
        try:
            if (folder / name).stat().st_size > LARGEST_FILE:
                raise ContractError(f"{folder / name} is larger than any decision: export the policy anew")
            found = hashlib.sha256((folder / name).read_bytes()).hexdigest()
        except OSError as error:
            raise ContractError(f"{folder / name} cannot be read ({error.strerror}): export the policy anew") from None
        if found != recorded:
            raise ContractError(f"{folder / name} is not the file that was exported: export the policy anew")
    return contract


def _check(contract: dict[str, Any]) -> None:
    """Raises ValueError, KeyError, TypeError or AttributeError for a contract that no export writes."""
    files, artefact, golden = contract["files"], contract["artefact"], contract["golden"]
    _hold("version", type(contract["version"]) is int and contract["version"] > 0)
    for name in (*files, artefact["file"]):
        _hold("files", name in files and name not in (".", "..", CONTRACT) and not set(name) & set("/\\\0"))
    _hold("golden", GOLDEN in files and type(golden["tolerance"]) is float and 0 < golden["tolerance"] <= LOOSEST)
    _hold("artefact", artefact["format"] in RUNNERS and type(artefact.get("jax", "")) is str)
    sizes = golden["cases"], *(contract[part]["size"] for part in VECTORS)
    _hold("size", all(type(size) is int and 1 <= size <= MOST for size in sizes))
    end = 0
    for part in contract["observation"]["slices"]:
        _hold("slices", type(part["name"]) is type(part["unit"]) is str and type(part["size"]) is int)
        _hold("slices", part["size"] > 0 and (part["from"], part["to"]) == (end, end + part["size"]))
        end = part["to"]
    _hold("slices", end == contract["observation"]["size"])


def _hold(what: str, sound: bool) -> None:
    if not sound:
        raise ValueError(f"its {what}")


Batch = Callable[[np.ndarray], np.ndarray]  # observations (n, obs) -> actions (n, action)


def _of_numpy(folder: Path, contract: dict[str, Any]) -> Batch:
    _check_unpacked(folder / contract["artefact"]["file"])
    with np.load(folder / contract["artefact"]["file"], allow_pickle=False) as stored:
        graph = json.loads(stored["graph"].tobytes())
        constants = {name: stored[name] for name in stored.files if name != "graph"}
    (given,), (result,) = graph["inputs"], graph["outputs"]
    run, alone = compiled(graph["ops"], {result}), threading.Lock()

    def decide(batch: np.ndarray) -> np.ndarray:
        actions = np.empty((len(batch), contract["action"]["size"]), np.float32)
        with alone, np.errstate(all="ignore"):  # operations write where they wrote before; JAX warns of nothing either
            for number, row in enumerate(batch):
                values = {**constants, given: row}
                run(values)
                actions[number] = values[result]
        return actions

    return decide


def _of_onnx(folder: Path, contract: dict[str, Any]) -> Batch:
    try:
        import onnxruntime
    except ImportError:
        raise ContractError("a decision in ONNX needs onnxruntime: pip install onnxruntime") from None
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1  # a robot has other work for its cores
    options.log_severity_level = 3
    try:
        path = str(folder / contract["artefact"]["file"])
        session = onnxruntime.InferenceSession(path, options, providers=["CPUExecutionProvider"])
    except Exception as error:
        told = " ".join(str(error).split())[:200]
        version = onnxruntime.__version__
        raise ContractError(f"onnxruntime {version} cannot run this decision ({told}): use another") from None
    return lambda batch: np.asarray(session.run(None, {"obs": batch})[0])


def _of_stablehlo(folder: Path, contract: dict[str, Any]) -> Batch:
    try:
        import jax
        from jax import export
    except ImportError:
        raise ContractError("a decision in StableHLO needs JAX: pip install jax flatbuffers, or export NumPy") from None
    stored = (folder / contract["artefact"]["file"]).read_bytes()
    try:
        exported = export.deserialize(bytearray(stored))
        if b"callback" in exported.mlir_module_serialized:  # no export has one: it leads out of the program
            raise ContractError(f"{folder} holds a decision that calls Python functions: export the policy anew")
        call = jax.jit(exported.call)
        call(np.zeros((1, contract["observation"]["size"]), np.float32)).block_until_ready()
    except ContractError:
        raise
    except Exception:
        made = contract["artefact"]["jax"]
        raise ContractError(
            f"this decision was exported with JAX {made}, and JAX {jax.__version__} on {jax.default_backend()} cannot "
            f"call it: use JAX {made}, or export the policy anew with this one"
        ) from None
    return lambda batch: np.asarray(call(batch))


RUNNERS: dict[str, Callable[[Path, dict[str, Any]], Batch]] = {
    "numpy": _of_numpy,
    "onnx": _of_onnx,
    "stablehlo": _of_stablehlo,
}


def compiled(ops: list[list[Any]], kept: set[str] | None = None) -> Run:
    """A graph's operations as one function, which adds their results to the values it is given.

    Args:
        ops: each [name, inputs, outputs, attributes]; see `OPERATIONS`, `SETTLED`, `_loop` and `_highest`.
        kept: what is looked at afterwards; given, large results are written where they were in the call before.
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
    """Bias, rectifier and the product that follows, where nothing else looks at what is between, as one operation."""
    looks = Counter([*_looked_at(ops), *kept])
    made = {output: op for op in ops for output in op[2]}

    def before(name: str, wanted: str) -> list[list[Any]] | None:
        """The operation that gives a value, last, and the reshapes that follow it."""
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
    """Writes into one array, call after call: new memory for large ones takes longer than the arithmetic."""
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
    """Repeats `body` on the carried values (of these kinds and shapes) as long as `test` of them holds."""
    look, work = compiled(test["ops"]), compiled(body["ops"])

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
    """The k largest along the last axis, of equal ones the first, and where they are."""

    def run(values: Values) -> None:
        x = values[given]
        order = np.argsort(-x, axis=-1, kind="stable")[..., :k].astype(np.int32)
        values[largest], values[places] = np.take_along_axis(x, order, -1), order

    return run


def _rounded(x: np.ndarray) -> np.ndarray:
    """To the nearest number that bfloat16 has, ties to even; kept in single precision."""
    bits = np.atleast_1d(x).view(np.uint32)
    up = ((bits >> np.uint32(16)) & np.uint32(1)) + np.uint32(0x7FFF)
    return ((bits + up) & np.uint32(0xFFFF0000)).view(np.float32).reshape(x.shape)


def _layer(
    one: np.ndarray, other: np.ndarray, floor: np.ndarray, weights: np.ndarray, out: np.ndarray | None = None
) -> np.ndarray:
    """max(one + other, floor) @ weights. Units of a large layer that no row turns on are left out: a third of them."""
    row, rows = (one, other) if one.size < other.size else (other, one)
    width = weights.shape[0]
    fits = row.shape[-1:] == rows.shape[-1:] == (width,) and row.size == width and weights.ndim == 2
    if not fits or rows.size < LARGE * width or floor.size != 1 or floor.item() != 0:
        x = np.maximum(one + other, floor).reshape(*weights.shape[:-2], -1, weights.shape[-2])
        return np.matmul(x, weights, out=out)
    rows, row = rows.reshape(-1, width), row.reshape(width)
    on = np.flatnonzero(rows.max(axis=0) + row > 0)
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
    """Rounded toward zero where both are whole."""
    return np.asarray(np.trunc(np.true_divide(x, y)), x.dtype) if x.dtype.kind in "iu" else np.divide(x, y)


ONE = np.float32(1)
LARGE = 32  # rows

# Of arrays in single precision, int32 or bool; all shapes are fixed. Elementwise ones take equal or broadcast shapes.
OPERATIONS: dict[str, Callable[..., Any]] = {
    "neg": np.negative,
    "abs": np.abs,
    "sign": np.sign,
    "floor": np.floor,
    "ceil": np.ceil,
    "round": np.rint,  # halves to the even one
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
    "take": np.take,  # of x as one row
    "matmul": np.matmul,
}

# Those that can write where they are told. A "layer" stands in no file: `_joined` makes it.
INTO = {name: OPERATIONS[name] for name in ("add", "sub", "mul", "max", "min", "matmul")} | {"layer": _layer}

# Those that have attributes, as what gives their function of the arrays: of small arrays, to settle what is to be done
# is most of the work.
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
