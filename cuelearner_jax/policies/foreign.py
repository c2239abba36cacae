"""Policies of other libraries as functions of a batch of observations: PyTorch, Stable-Baselines3, ONNX.

These libraries are not imported to recognise a policy: an object of a library exists only once the library was
imported. A file in ONNX is run by onnxruntime.
"""

from __future__ import annotations

import os
import sys
import threading
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from cuelearner_jax.errors import UserError, format_value

ONNX = ".onnx"
ACTIONS = ("action", "actions")  # names of an output, where a file in ONNX has several
REAL = {"tensor(float)": np.float32, "tensor(double)": np.float64, "tensor(float16)": np.float16}


class Foreign:
    """A function of a batch of observations (n, obs) that returns actions (n, action), in NumPy."""

    def __init__(self, given: Any, reference: str) -> None:
        """`given`: the policy object; `reference`: its name in messages and folders."""
        self.given, self.reference, self.__qualname__ = given, reference, reference.rpartition(":")[2]

    def __call__(self, obs: Float[np.ndarray, "n obs"]) -> Any:
        """Return actions for observations."""
        raise NotImplementedError

    # The same object is the same policy: programs that call it are compiled once.
    def __eq__(self, other: object) -> bool:
        return type(self) is type(other) and self.given is other.given  # pyright: ignore[reportAttributeAccessIssue]

    def __hash__(self) -> int:
        return hash((type(self), id(self.given)))


def function_of(given: Any) -> Foreign | None:
    """Return another library's policy as a function; None if the object is none of these.

    Args:
        given: a `torch.nn.Module`; a model or policy of Stable-Baselines3, or its `predict`; the path of a file in
            ONNX.

    Raises:
        UserError: a file in ONNX that cannot be run, or has other inputs and outputs.
    """
    if isinstance(given, str | os.PathLike):
        return _Onnx(Path(given)) if str(given).endswith(ONNX) else None
    owner = getattr(given, "__self__", None)
    if _predicts(owner) and getattr(given, "__name__", "") == "predict":
        given = owner
    if _predicts(given) and not isinstance(given, type):
        return _Predicting(given)
    torch = sys.modules.get("torch")
    if torch is not None and hasattr(torch, "nn") and isinstance(given, torch.nn.Module):
        return _Torch(given)
    return None


def _predicts(given: Any) -> bool:
    """Return whether an object is a model or policy of Stable-Baselines3."""
    return callable(getattr(given, "predict", None)) and hasattr(given, "observation_space")


def _reference(given: Any) -> str:
    kind = type(given)
    return f"{kind.__module__}:{kind.__qualname__}"


class _Torch(Foreign):
    """A module in evaluation mode, without gradients, on its own device."""

    def __init__(self, given: Any) -> None:
        super().__init__(given, _reference(given))
        self._alone = threading.Lock()  # evaluation mode is a state of the module, so calls must not overlap

    def __call__(self, obs: Float[np.ndarray, "n obs"]) -> Any:
        """Return actions for observations; the module's modes are restored afterwards."""
        torch = sys.modules["torch"]
        weights = next((own for own in self.given.parameters() if own.is_floating_point()), None)
        where = {"device": weights.device, "dtype": weights.dtype} if weights is not None else {"dtype": torch.float32}
        with self._alone:
            modes = [(part, part.training) for part in self.given.modules()]
            self.given.eval()
            try:
                with torch.no_grad():
                    found = self.given(torch.as_tensor(np.array(obs), **where))
            finally:
                for part, mode in modes:
                    part.training = mode
        first: Any = found[0] if isinstance(found, tuple | list) and found else found
        return first.detach().to("cpu", torch.float32).numpy() if isinstance(first, torch.Tensor) else found


class _Predicting(Foreign):
    """A model's deterministic `predict`, with dictionaries where the model observes dictionaries."""

    def __init__(self, given: Any) -> None:
        super().__init__(given, _reference(given))

    def __call__(self, obs: Float[np.ndarray, "n obs"]) -> Any:
        """Return actions for observations."""
        return self.given.predict(self._arranged(np.array(obs)), deterministic=True)[0]

    def _arranged(self, rows: np.ndarray) -> Any:
        """Return rows as the model's observation space has them; flattened dictionaries in the order of their keys."""
        space = self.given.observation_space
        parts = getattr(space, "spaces", None)
        if isinstance(parts, dict):
            sizes = [int(np.prod(part.shape)) for part in parts.values()]
            self._check(rows, sum(sizes))
            cut = np.split(rows, np.cumsum(sizes)[:-1], axis=1)
            return {
                name: values.reshape(len(rows), *part.shape).astype(part.dtype)
                for (name, part), values in zip(parts.items(), cut, strict=True)
            }
        shape = getattr(space, "shape", None) or ()
        self._check(rows, int(np.prod(shape)))
        return rows.reshape(len(rows), *shape).astype(getattr(space, "dtype", np.float32))

    def _check(self, rows: np.ndarray, size: int) -> None:
        if rows.shape[1] != size:
            raise UserError(
                f"policy {self.__qualname__} takes observations of {size} entries, these have {rows.shape[1]}: give "
                "the observations that it was trained on"
            )


class _Onnx(Foreign):
    """A file in ONNX with one input of observations and one output of actions, run by onnxruntime on the CPU."""

    def __init__(self, path: Path) -> None:
        try:
            import onnxruntime
        except ImportError as error:
            raise UserError(f"{path} needs onnxruntime: pip install 'cuelearner-jax[onnx]'") from error
        if not path.is_file():
            raise UserError(f"there is no file {path}: give the path of a policy in ONNX")
        super().__init__(path.resolve(), str(path))
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = options.inter_op_num_threads = 1
        options.log_severity_level = 3
        try:
            self._session = onnxruntime.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])
        except Exception as error:  # onnxruntime's own kinds
            why = " ".join(str(error).split())[:160]
            raise UserError(f"{path} cannot be run by onnxruntime ({why}): export the policy again") from error
        inputs, outputs = self._session.get_inputs(), self._session.get_outputs()
        if len(inputs) != 1 or inputs[0].type not in REAL or len(inputs[0].shape) != 2:
            told = ", ".join(f"{one.name} {one.type} {one.shape}" for one in inputs)
            raise UserError(f"{path} has the inputs {told}: give a policy with one input of real numbers, (n, obs)")
        named = [one.name for one in outputs if one.name in ACTIONS] or [one.name for one in outputs]
        if len(named) != 1:
            raise UserError(f"{path} has the outputs {', '.join(named)}: give a policy with one, or one called action")
        self._name, self._kind, self._output = inputs[0].name, REAL[inputs[0].type], named[0]
        self._rows, self._size = inputs[0].shape

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Onnx) and self.given == other.given

    def __hash__(self) -> int:
        return hash(self.given)

    def __call__(self, obs: Float[np.ndarray, "n obs"]) -> Any:
        """Return actions for observations. Raises UserError for observations of another size."""
        if isinstance(self._size, int) and obs.shape[1] != self._size:
            raise UserError(
                f"{self.reference} takes observations of {self._size} entries, these have {obs.shape[1]}: give the "
                "observations that it was made for"
            )
        rows = np.ascontiguousarray(obs).astype(self._kind)
        fixed = self._rows if isinstance(self._rows, int) else 0  # a batch of another size is run row by row
        if fixed in (0, len(rows)):
            return self._run(rows)
        if fixed != 1:
            raise UserError(f"{self.reference} takes batches of {fixed} only: export it with batches of any size")
        return np.concatenate([self._run(rows[number : number + 1]) for number in range(len(rows))])

    def _run(self, rows: np.ndarray) -> np.ndarray:
        found = self._session.run([self._output], {self._name: rows})[0]
        if not isinstance(found, np.ndarray):
            raise UserError(
                f"{self.reference} gives {format_value(found)} in place of actions: export the policy again"
            )
        return found
