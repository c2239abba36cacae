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

from cuelearner_jax.environment import action_words
from cuelearner_jax.errors import UserError, format_value
from cuelearner_jax.spaces import Space

ONNX = ".onnx"
# Files that only their library reads, running code in them if they hold some: how a module of the user's loads one.
LOADERS = {
    ".zip": "from stable_baselines3 import PPO; POLICY = PPO.load({!r})  # or another class",
    ".pt": "import torch; POLICY = torch.jit.load({!r})",
    ".pth": "import torch; POLICY = torch.jit.load({!r})",
}
FILES = (ONNX, *LOADERS)
RECURRENT = {"RNN", "GRU", "LSTM", "RNNCell", "GRUCell", "LSTMCell"}  # parts of PyTorch with a memory
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

    def check(self, space: Space) -> None:
        """Raise UserError where the policy is known to give other actions than those of a space."""

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
        UserError: a file in ONNX that cannot be run, or has other inputs and outputs; a file of `LOADERS`.
    """
    if isinstance(given, str | os.PathLike):
        path = Path(given)
        if path.suffix in LOADERS:
            line = LOADERS[path.suffix].format(str(given))
            raise UserError(
                f"reading {given} may run code in it, so a module of yours reads it: write `{line}` into "
                "my_policy.py, and give my_policy:POLICY (module:NAME; in Python, the loaded policy)"
            )
        return _Onnx(path) if path.suffix == ONNX else None
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
        act = getattr(self.given, "act_inference", self.given)  # rsl_rl's name for the deterministic action
        with self._alone:
            # Frozen modules have no mode, and exported ones refuse `eval`.
            modes = [(part, part.training) for part in self.given.modules() if hasattr(part, "training")]
            try:
                for part, _ in modes:
                    part.training = False
                with torch.no_grad():
                    found = act(torch.as_tensor(np.array(obs), **where))
            finally:
                for part, mode in modes:
                    part.training = mode
        if isinstance(found, tuple | list) and found:
            kinds = {getattr(part, "original_name", type(part).__name__) for part in self.given.modules()}
            if kinds & RECURRENT:
                raise memory_error(f"policy {self.__qualname__}")
            found = found[0]
        is_tensor = isinstance(found, torch.Tensor)
        return found.detach().to("cpu", torch.float32).numpy() if is_tensor else found  # pyright: ignore[reportAttributeAccessIssue]


class _Predicting(Foreign):
    """A model's deterministic `predict` of observations as its own space has them, normalised as in its training."""

    def __init__(self, given: Any) -> None:
        super().__init__(given, _reference(given))

    def __call__(self, obs: Float[np.ndarray, "n obs"]) -> Any:
        """Return actions for observations. Raises UserError for observations of another size, or a memory."""
        space = self.given.observation_space
        parts = getattr(space, "spaces", {"": space})  # a dictionary's, in the order of its keys
        ends = np.cumsum([_width(part) for part in parts.values()])
        if obs.shape[1] != ends[-1]:
            raise UserError(
                f"policy {self.__qualname__} takes observations of {ends[-1]} entries, these have {obs.shape[1]}: give "
                "the observations that it was trained on"
            )
        cut = np.split(np.array(obs), ends[:-1], axis=1)
        values = {name: _values(part, rows) for (name, part), rows in zip(parts.items(), cut, strict=True)}
        seen: Any = values if hasattr(space, "spaces") else values[""]
        if (normalized := getattr(self.given, "get_vec_normalize_env", lambda: None)()) is not None:
            seen = normalized.normalize_obs(seen)
        action, state = self.given.predict(seen, deterministic=True)
        if state is not None:
            raise memory_error(f"policy {self.__qualname__}")
        return action

    def check(self, space: Space) -> None:
        """Raise UserError where the model's actions have other bounds, or other choices, than the space."""
        own, wanted = action_words(getattr(self.given, "action_space", None)), action_words(space)
        if own and wanted and own != wanted:
            raise UserError(
                f"policy {self.__qualname__} gives actions {own}, this world takes actions {wanted}: give a world with "
                "the policy's actions, or a function that converts them"
            )


def memory_error(whose: str) -> UserError:
    """Return the UserError for a policy that gives a state beside its actions."""
    return UserError(
        f"{whose} gives a state beside its actions, and policies are asked without a memory: give one that depends on "
        "the observation alone, or a function that returns actions alone"
    )


def _counts(space: Any) -> list[int]:
    """Return the numbers of values of a `Discrete` or `MultiDiscrete` space, which vectors hold one-hot; else none."""
    return np.ravel(space.nvec if hasattr(space, "nvec") else space.n if hasattr(space, "start") else ()).tolist()


def _width(space: Any) -> int:
    """Return the number of entries of a space's values in a vector of observations."""
    return int(sum(_counts(space)) or np.prod(space.shape))


def _values(space: Any, rows: Float[np.ndarray, "n entries"]) -> np.ndarray:
    """Return the values of a space that its entries in observations hold."""
    if counts := _counts(space):
        parts = np.split(rows, np.cumsum(counts)[:-1], axis=1)
        rows = np.stack([part.argmax(1) for part in parts], 1) + np.ravel(getattr(space, "start", 0))
    return rows.reshape(len(rows), *space.shape).astype(space.dtype)


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
        if isinstance(self._rows, int) and self._rows != 1:
            raise UserError(f"{path} takes batches of {self._rows} only: export it with batches of any size")

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
        if self._rows != 1:
            return self._run(rows)
        return np.concatenate([self._run(rows[number : number + 1]) for number in range(len(rows))])

    def _run(self, rows: np.ndarray) -> np.ndarray:
        found = self._session.run([self._output], {self._name: rows})[0]
        if not isinstance(found, np.ndarray):
            raise UserError(
                f"{self.reference} gives {format_value(found)} in place of actions: export the policy again"
            )
        return found
