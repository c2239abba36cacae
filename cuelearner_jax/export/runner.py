"""Runs a decision that `cuelearner export` wrote; lies beside every decision as `decide.py`, with `operations` in it.

    from decide import Decision
    decide = Decision("folder")        # verifies every file against the contract
    action = decide(observation)       # (obs,) -> (action,); or (n, obs) -> (n, action)
    action = decide(observation, base_action)       # of a correction alone, which runs beside its base

It needs Python and NumPy, nothing of cuelearner or JAX; decisions in ONNX also need onnxruntime, those in StableHLO
need JAX. Every row of a batch is decided by itself.
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

from cuelearner_jax.export.operations import ContractError, compiled

CONTRACT, GOLDEN = "contract.json", "golden.npz"
VERSION = 1  # of contracts and graphs
DIGEST = "digest"  # the name under which a contract holds the digest of its other values
VECTORS = ("observation", "action")
MOST = 1 << 20  # entries of an observation or an action, and golden cases
LARGEST_CONTRACT, LARGEST_FILE = 1 << 26, 1 << 30  # bytes, unpacked
LOOSEST = 1e-2  # tolerance that still says that two actions are one


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

    def __call__(self, obs: Any, base_action: Any = None) -> np.ndarray:
        """The action for an observation (obs,), or for each of a batch (n, obs): (action,) or (n, action).

        `base_action`, as many rows: of a correction alone, what the base would do there. Raises ContractError for an
        observation of another size, or one that is not finite in single precision; for a decision that is no action.
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
            raise ContractError(f"{self.folder} decides on no finite numbers of shape {wanted}: export the policy anew")
        if "angle" in self.contract["action"] and not actions.any(axis=-1).all():
            raise ContractError(f"{self.folder} decides on zero, which is no direction: export the policy anew")
        return actions[0] if rows.ndim == 1 else actions

    @property
    def _base(self) -> int:
        """Entries of a base's action, of a correction alone; else 0."""
        return self.contract.get("base", {}).get("size", 0)

    def _beside(self, rows: np.ndarray, base_action: Any) -> np.ndarray:
        """Observations and base actions side by side. Raises ContractError unless there are as many of both."""
        own = self.contract["observation"]["size"] - self._base
        if base_action is None:
            raise ContractError(
                f"{self.folder} holds a correction alone: give the base's action, decide(obs, base_action)"
            )
        base = _numbers(base_action)
        if rows.ndim not in (1, 2) or rows.shape[-1:] != (own,) or base.shape != (*rows.shape[:-1], self._base):
            raise ContractError(
                f"observations have shape {rows.shape} and base actions {base.shape}: the contract says ({own},) and "
                f"({self._base},), or as many rows of both"
            )
        return np.concatenate([rows, base], -1)

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
        """Directions as angles [rad], counterclockwise positive, 0 along x: () or (n,).

        Raises ContractError for a decision whose actions are no directions.
        """
        if "angle" not in self.contract["action"]:
            raise ContractError(f"{self.folder} decides on actions without an angle: call it, and read its contract")
        actions = self(obs)
        return np.asarray(np.arctan2(actions[..., 1], actions[..., 0]))

    def check(self) -> float:
        """Decides the golden cases anew. Returns the largest difference of an entry from what is recorded.

        Raises ContractError if that is more than the contract allows.
        """
        obs, actions = self._sound(self._golden)
        seen = (obs[:, : -self._base], obs[:, -self._base :]) if self._base else (obs,)
        difference = float(np.abs(self(*seen) - actions).max())
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
    if "base" in contract:
        size = contract["base"]["size"]
        _hold("base", type(size) is int and size == contract["action"]["size"] and size < end)
        _hold("base", contract["observation"]["slices"][-1]["size"] == size)


def _hold(what: str, sound: bool) -> None:
    if not sound:
        raise ValueError(f"its {what}")


Batch = Callable[[np.ndarray], np.ndarray]  # observations (n, obs) -> actions (n, action)


def _cut(batch: np.ndarray, base: int) -> list[np.ndarray]:
    """What is seen as the inputs of a decision: of a correction alone the base's action is one of its own."""
    parts = [batch[:, :-base], batch[:, -base:]] if base else [batch]
    return [np.ascontiguousarray(part) for part in parts]


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
    names, base = [one.name for one in session.get_inputs()], contract.get("base", {}).get("size", 0)
    if names != ["obs", *(["base_action"] if base else [])]:
        raise ContractError(
            f"{path} has the inputs {', '.join(names)}, which its contract does not say: export it anew"
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
        if b"callback" in exported.mlir_module_serialized:  # no export has one: it leads out of the program
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
