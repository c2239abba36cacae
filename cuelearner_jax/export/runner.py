"""Run a decision written by `cuelearner export`; this file lies beside every decision as `decide.py`.

    from decide import Decision
    decide = Decision("folder")        # verifies every file against the contract
    action = decide(observation)       # (obs,) -> (action,); or (n, obs) -> (n, action)
    action = decide(observation, base_action)       # for a correction alone, which runs beside its base

It needs Python and NumPy, neither cuelearner nor JAX. Decisions in ONNX also need onnxruntime, and those in StableHLO
need JAX. Every row of a batch is processed by itself.
"""

from __future__ import annotations

import hashlib
import json
import threading
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from cuelearner_jax.export.operations import ContractError, compile_ops

CONTRACT, GOLDEN = "contract.json", "golden.npz"
VERSION = 1  # of contracts and graphs
DIGEST = "digest"  # the key of a contract's digest of its other values
VECTORS = ("observation", "action")
MOST = 1 << 20  # most entries of an observation or an action, and most golden cases
LARGEST_CONTRACT, LARGEST_FILE = 1 << 26, 1 << 30  # bytes, uncompressed
LOOSEST = 1e-2  # largest tolerance at which two actions still count as equal


class Decision:
    """An exported decision.

    `contract` is the content of contract.json: slices of the observation with sizes and units, the action's frame and
    sign.
    """

    def __init__(self, folder: str | Path) -> None:
        """Read a folder. Raises ContractError if a file is missing, damaged or changed, or cannot be run here."""
        self.folder = Path(folder)
        self.contract = read_contract(self.folder)
        self._decide = self._sound(lambda: RUNNERS[self.contract["artefact"]["format"]](self.folder, self.contract))

    @property
    def unlisted(self) -> list[str]:
        """Names of files in the folder that the contract does not list, and so does not verify."""
        known = (CONTRACT, "__pycache__", *self.contract["files"])
        return sorted(path.name for path in self.folder.iterdir() if path.name not in known)

    def __call__(self, obs: Any, base_action: Any = None) -> np.ndarray:
        """Return the action for an observation (obs,), or for each of a batch (n, obs): (action,) or (n, action).

        `base_action`, for a correction alone: the base's action for each observation. Raises ContractError for an
        observation of another size or not finite in single precision, and for a decision that gives no valid action.
        """
        rows, size = _numbers(obs), self.contract["observation"]["size"]
        if self._base:
            rows = self._beside(rows, base_action)
        elif base_action is not None:
            raise ContractError(f"{self.folder} holds a whole policy: leave out the base action")
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
            raise ContractError(f"{self.folder} does not give finite numbers of shape {wanted}: export the policy anew")
        if "angle" in self.contract["action"] and not actions.any(axis=-1).all():
            raise ContractError(f"{self.folder} gives zero, which is not a direction: export the policy anew")
        return actions[0] if rows.ndim == 1 else actions

    @property
    def _base(self) -> int:
        """Number of entries of the base's action for a correction alone; otherwise 0."""
        return self.contract.get("base", {}).get("size", 0)

    def _beside(self, rows: np.ndarray, base_action: Any) -> np.ndarray:
        """Concatenate observations and base actions. Raises ContractError unless their rows match."""
        own = self.contract["observation"]["size"] - self._base
        if base_action is None:
            raise ContractError(
                f"{self.folder} holds a correction alone: give the base's action, decide(obs, base_action)"
            )
        base = _numbers(base_action)
        if rows.ndim not in (1, 2) or rows.shape[-1:] != (own,) or base.shape != (*rows.shape[:-1], self._base):
            raise ContractError(
                f"observations have shape {rows.shape} and base actions {base.shape}: the contract says ({own},) and "
                f"({self._base},), or equally many rows of both"
            )
        return np.concatenate([rows, base], -1)

    def _sound(self, work: Callable[[], Any]) -> Any:
        """Return the result of some work on the artefact; any error becomes a one-line ContractError."""
        try:
            return work()
        except ContractError:
            raise
        except Exception as error:
            told = f"{type(error).__name__}: {' '.join(str(error).split())}"[:160]
            raise ContractError(
                f"{self.folder} holds a decision that cannot be run here ({told}): export the policy anew"
            ) from None

    def angle(self, obs: Any) -> np.ndarray:
        """Return directions as angles [rad], counterclockwise positive, 0 along x: () or (n,).

        Raises ContractError for a decision whose actions are not directions.
        """
        if "angle" not in self.contract["action"]:
            raise ContractError(
                f"{self.folder} gives actions that are not directions: call it instead, and read its contract"
            )
        actions = self(obs)
        return np.asarray(np.arctan2(actions[..., 1], actions[..., 0]))

    def check(self) -> float:
        """Recompute the golden cases; return the largest difference of an entry from the recorded actions.

        Raises ContractError if the difference is larger than the contract allows.
        """
        obs, actions = self._sound(self._golden)
        seen = (obs[:, : -self._base], obs[:, -self._base :]) if self._base else (obs,)
        difference = float(np.abs(self(*seen) - actions).max())
        allowed = self.contract["golden"]["tolerance"]
        if not difference <= allowed:
            raise ContractError(
                f"{self.folder} gives other actions here than where it was exported: golden cases differ by "
                f"{difference:.2g}, more than {allowed:g}; export it anew, or with --format stablehlo"
            )
        return difference

    def _golden(self) -> tuple[np.ndarray, np.ndarray]:
        """Return observations (cases, obs) and actions (cases, action). Raises ValueError unless their shapes fit."""
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
    """Raise ValueError for arrays compressed more densely than any decision's."""
    with zipfile.ZipFile(path) as packed:
        if sum(part.file_size for part in packed.infolist()) > LARGEST_FILE:
            raise ValueError(f"{path.name} declares more than {LARGEST_FILE:,} bytes")


def _numbers(obs: Any) -> np.ndarray:
    """Return observations in single precision, infinite where out of its range."""
    try:
        rows = np.asarray(obs)
    except (TypeError, ValueError):  # rows of different lengths
        rows = np.empty(0, object)
    if rows.dtype.kind not in "fiu":
        raise ContractError(f"observations are of type {rows.dtype}: give real numbers")
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
        raise ContractError(f"{path} is invalid ({told[:160]}): export the policy anew") from None
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
    """Raise ValueError, KeyError, TypeError or AttributeError for an invalid contract."""
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
    if "base" in contract:
        size = contract["base"]["size"]
        _hold("base", type(size) is int and size == contract["action"]["size"] and size < end)
        _hold("base", contract["observation"]["slices"][-1]["size"] == size)


def _hold(what: str, sound: bool) -> None:
    if not sound:
        raise ValueError(f"its {what}")


Batch = Callable[[np.ndarray], np.ndarray]  # observations (n, obs) -> actions (n, action)


def _cut(batch: np.ndarray, base: int) -> list[np.ndarray]:
    """Split the input into a decision's inputs; for a correction alone the base's action is a separate one."""
    parts = [batch[:, :-base], batch[:, -base:]] if base else [batch]
    return [np.ascontiguousarray(part) for part in parts]


def _of_numpy(folder: Path, contract: dict[str, Any]) -> Batch:
    _check_unpacked(folder / contract["artefact"]["file"])
    with np.load(folder / contract["artefact"]["file"], allow_pickle=False) as stored:
        graph = json.loads(stored["graph"].tobytes())
        constants = {name: stored[name] for name in stored.files if name != "graph"}
    (given,), (result,) = graph["inputs"], graph["outputs"]
    run, alone = compile_ops(graph["ops"], {result}), threading.Lock()

    def decide(batch: np.ndarray) -> np.ndarray:
        actions = np.empty((len(batch), contract["action"]["size"]), np.float32)
        # operations reuse their memory; JAX does not warn of floating-point errors either
        with alone, np.errstate(all="ignore"):
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
    options.intra_op_num_threads = options.inter_op_num_threads = 1  # a robot's cores have other work
    options.log_severity_level = 3
    try:
        path = str(folder / contract["artefact"]["file"])
        session = onnxruntime.InferenceSession(path, options, providers=["CPUExecutionProvider"])
    except Exception as error:
        told = " ".join(str(error).split())[:200]
        version = onnxruntime.__version__
        raise ContractError(f"onnxruntime {version} cannot run this decision ({told}): use another") from None
    names, base = [one.name for one in session.get_inputs()], contract.get("base", {}).get("size", 0)
    if names != ["obs", *(["base_action"] if base else [])]:
        raise ContractError(
            f"{path} has the inputs {', '.join(names)}, which its contract does not list: export it anew"
        )
    return lambda batch: np.asarray(session.run(None, dict(zip(names, _cut(batch, base), strict=True)))[0])


def _of_stablehlo(folder: Path, contract: dict[str, Any]) -> Batch:
    try:
        import jax
        from jax import export
    except ImportError:
        raise ContractError("a decision in StableHLO needs JAX: pip install jax flatbuffers, or export NumPy") from None
    stored = (folder / contract["artefact"]["file"]).read_bytes()
    try:
        exported = export.deserialize(bytearray(stored))
        # no export contains callbacks, which lead out of the program
        if b"callback" in exported.mlir_module_serialized:
            raise ContractError(f"{folder} holds a decision that calls Python functions: export the policy anew")
        call = jax.jit(exported.call)
        base = contract.get("base", {}).get("size", 0)
        call(*_cut(np.zeros((1, contract["observation"]["size"]), np.float32), base)).block_until_ready()
    except ContractError:
        raise
    except Exception:
        made = contract["artefact"]["jax"]
        raise ContractError(
            f"this decision was exported with JAX {made}, and JAX {jax.__version__} on {jax.default_backend()} cannot "
            f"call it: use JAX {made}, or export the policy anew with this one"
        ) from None
    return lambda batch: np.asarray(call(*_cut(batch, base)))


RUNNERS: dict[str, Callable[[Path, dict[str, Any]], Batch]] = {
    "numpy": _of_numpy,
    "onnx": _of_onnx,
    "stablehlo": _of_stablehlo,
}
