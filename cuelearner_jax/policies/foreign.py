"""Policies of other libraries as functions of a batch of observations: PyTorch, Stable-Baselines3, ONNX.

These libraries are not imported to recognise a policy: an object of a library exists only once the library was
imported. A file in ONNX is run by onnxruntime.
"""

from __future__ import annotations

import os
import sys
import threading
from collections.abc import Hashable
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from cuelearner_jax.environment import action_words
from cuelearner_jax.errors import UserError
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
REAL = {"tensor(float)": np.float32, "tensor(double)": np.float64, "tensor(float16)": np.float16}


class Foreign:
    """A function of a batch of observations (n, obs) that returns actions (n, action), in NumPy.

    Two functions of one object, or of one file, are equal: programs that call them are compiled once.
    """

    def __init__(self, given: Any, name: str, key: Hashable = None) -> None:
        self.given, self.__qualname__, self._key = given, name, (type(self), id(given) if key is None else key)

    def __call__(self, obs: Float[np.ndarray, "n obs"]) -> Any:
        """Return actions for observations."""
        raise NotImplementedError

    def check(self, space: Space) -> None:
        """Raise UserError where the policy is known to give other actions than those of a space."""

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Foreign) and self._key == other._key

    def __hash__(self) -> int:
        return hash(self._key)


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
    given = owner if _predicts(owner) and getattr(given, "__name__", "") == "predict" else given
    if _predicts(given) and not isinstance(given, type):
        return _Predicting(given, type(given).__qualname__)
    torch = sys.modules.get("torch")
    is_module = torch is not None and hasattr(torch, "nn") and isinstance(given, torch.nn.Module)
    return _Torch(given, type(given).__qualname__) if is_module else None


def _predicts(given: Any) -> bool:
    """Return whether an object is a model or policy of Stable-Baselines3."""
    return callable(getattr(given, "predict", None)) and hasattr(given, "observation_space")


def memory_error(whose: str) -> UserError:
    """Return the UserError for a policy that gives a state beside its actions."""
    return UserError(
        f"{whose} gives a state beside its actions, and policies are asked without a memory: give one that depends on "
        "the observation alone, or a function that returns actions alone"
    )


class _Torch(Foreign):
    """A module in evaluation mode, without gradients, on its own device; its modes are restored afterwards."""

    alone = threading.Lock()  # evaluation mode is a state of the module, so calls must not overlap

    def __call__(self, obs: Float[np.ndarray, "n obs"]) -> Any:
        """Return actions for observations."""
        torch: Any = sys.modules["torch"]
        floating = (own for own in self.given.parameters() if own.is_floating_point())
        weights = next(floating, torch.zeros((), dtype=torch.float32))
        act = getattr(self.given, "act_inference", self.given)  # rsl_rl's name for the deterministic action
        with self.alone:
            # Frozen modules have no mode, and exported ones refuse `eval`.
            modes = [(part, part.training) for part in self.given.modules() if hasattr(part, "training")]
            try:
                for part, _ in modes:
                    part.training = False
                with torch.no_grad():
                    found = act(torch.as_tensor(np.array(obs), device=weights.device, dtype=weights.dtype))
            finally:
                for part, mode in modes:
                    part.training = mode
        if isinstance(found, tuple | list) and found:
            if RECURRENT & {getattr(part, "original_name", type(part).__name__) for part in self.given.modules()}:
                raise memory_error(f"policy {self.__qualname__}")
            return self._plain(found[0])
        return self._plain(found)

    def _plain(self, found: Any) -> Any:
        tensor = sys.modules["torch"].Tensor
        return found.detach().cpu().float().numpy() if isinstance(found, tensor) else found


def _counts(space: Any) -> list[int]:
    """Return the numbers of values of a `Discrete` or `MultiDiscrete` space, which vectors hold one-hot; else none."""
    return np.ravel(getattr(space, "nvec", getattr(space, "n", ()))).tolist() if hasattr(space, "start") else []


class _Predicting(Foreign):
    """A model's deterministic `predict` of observations as its own space has them, normalised as in its training."""

    def __call__(self, obs: Float[np.ndarray, "n obs"]) -> Any:
        """Return actions for observations. Raises UserError for observations of another size, or a memory."""
        space = self.given.observation_space
        parts = getattr(space, "spaces", {"": space})  # a dictionary's, in the order of its keys
        counts = {name: _counts(part) for name, part in parts.items()}
        ends = np.cumsum([sum(counts[name]) or np.prod(part.shape, dtype=int) for name, part in parts.items()])
        if obs.shape[1] != ends[-1]:
            raise UserError(
                f"policy {self.__qualname__} takes observations of {ends[-1]} entries, these have {obs.shape[1]}: give "
                "the observations that it was trained on"
            )
        values: Any = {}
        for (name, part), rows in zip(parts.items(), np.split(np.array(obs), ends[:-1], axis=1), strict=True):
            if counts[name]:
                places = [one.argmax(1) for one in np.split(rows, np.cumsum(counts[name])[:-1], axis=1)]
                rows = np.stack(places, 1) + np.ravel(part.start)  # noqa: PLW2901
            values[name] = rows.reshape(len(rows), *part.shape).astype(part.dtype)
        if not hasattr(space, "spaces"):
            values = values[""]
        if (normalized := getattr(self.given, "get_vec_normalize_env", lambda: None)()) is not None:
            values = normalized.normalize_obs(values)
        action, state = self.given.predict(values, deterministic=True)
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


class _Onnx(Foreign):
    """A file in ONNX with one input of observations and one output of actions, run by onnxruntime on the CPU."""

    def __init__(self, path: Path) -> None:
        try:
            import onnxruntime
        except ImportError as error:
            raise UserError(f"{path} needs onnxruntime: pip install 'cuelearner-jax[onnx]'") from error
        if not path.is_file():
            raise UserError(f"there is no file {path}: give the path of a policy in ONNX")
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = options.inter_op_num_threads = 1
        options.log_severity_level = 3
        try:
            session = onnxruntime.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])
        except Exception as error:  # onnxruntime's own kinds
            why = " ".join(str(error).split())[:160]
            raise UserError(f"{path} cannot be run by onnxruntime ({why}): export the policy again") from error
        super().__init__(session, str(path), path.resolve())
        inputs, outputs = session.get_inputs(), [one.name for one in session.get_outputs()]
        if len(inputs) != 1 or inputs[0].type not in REAL or len(inputs[0].shape) != 2:
            told = ", ".join(f"{one.name} {one.type} {one.shape}" for one in inputs)
            raise UserError(f"{path} has the inputs {told}: give a policy with one input of real numbers, (n, obs)")
        self._outputs = [name for name in outputs if name in ("action", "actions")] or outputs
        if len(self._outputs) != 1:
            raise UserError(f"{path} has the outputs {', '.join(outputs)}: give a policy with one, or one named action")
        self._input = inputs[0]

    def __call__(self, obs: Float[np.ndarray, "n obs"]) -> Any:
        """Return actions for observations."""
        rows = np.ascontiguousarray(obs).astype(REAL[self._input.type])
        parts = np.split(rows, len(rows)) if self._input.shape[0] == 1 else [rows]
        return np.concatenate([self.given.run(self._outputs, {self._input.name: part})[0] for part in parts])
