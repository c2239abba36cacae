"""Policies of the user's own: functions, modules of PyTorch, models of Stable-Baselines3, files in ONNX.

`policy_of` is the one door. No library is imported to recognise its objects: these exist only once it was imported.
"""

from __future__ import annotations

import hashlib
import inspect
import os
import sys
import threading
from collections.abc import Callable
from functools import lru_cache, partial
from glob import escape
from pathlib import Path
from typing import Any, cast

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax.core import Tracer
from jaxtyping import Array, Float, PRNGKeyArray

from cuelearner_jax import user_code
from cuelearner_jax.environment import action_words
from cuelearner_jax.errors import UserError, format_value, user_code_error
from cuelearner_jax.policies.policy import PolicyNode, code_name, policy_name
from cuelearner_jax.spaces import DIRECTIONS, Box, Choices, Space
from cuelearner_jax.types import EnvState, Teacher

TRIED = 32  # observations in the largest batch with which a function is tried
# Largest differences of equal actions, as shares of an entry's range: asked again, and in two batches, whose sums are
# rounded in another order (two bits of bfloat16).
REPEATED, BATCHED = 1e-4, 0.005
ONNX = ".onnx"
FILES = (ONNX, ".zip", ".pt", ".pth")  # the others are read by their library alone, running code in them
RECURRENT = {"RNN", "GRU", "LSTM", "RNNCell", "GRUCell", "LSTMCell"}  # parts of PyTorch with a memory
REAL = {"tensor(float)": np.float32, "tensor(double)": np.float64, "tensor(float16)": np.float16}
MEMORY = (
    "gives a state beside its actions, and policies are asked without a memory: give one that depends on the "
    "observation alone, or a function that returns actions alone"
)


class Opaque(PolicyNode):
    """Any function of a batch of observations: of JAX arrays, or, `on_host`, of NumPy arrays in plain Python.

    The returned actions (n, action) are retracted to the space: unit vectors, or within bounds. A function on the host
    is called back from compiled programs (`jax.pure_callback`): it must give the same for the same observations.
    """

    function: Callable[[Any], Any] = struct.field(pytree_node=False)
    on_host: bool = struct.field(pytree_node=False, default=False)
    actions: Space = struct.field(pytree_node=False, default=DIRECTIONS)

    def act(self, key: PRNGKeyArray, states: EnvState, obs: Float[Array, "n obs"]) -> Float[Array, "n action"]:
        """Return the function's actions. Raises UserError if they have another shape."""
        if not self.on_host:
            return _valid(self.actions, self._checked(self.function(obs), obs.shape[0], jnp.asarray))
        # Tried while tracing, so that a fault is reported before anything is compiled.
        with jax.ensure_compile_time_eval():  # the function may compute with JAX itself
            _try(cast(Any, self), obs.shape[-1])
        if isinstance(obs, Tracer):
            shape = jax.ShapeDtypeStruct((obs.shape[0], self.actions.size), jnp.float32)
            return _valid(self.actions, jax.pure_callback(self._called_back, shape, obs, vmap_method="expand_dims"))
        # called here: one that computes with JAX would wait for the program that waits for it
        return _valid(self.actions, jnp.asarray(self._called(np.asarray(obs))))

    def _called_back(self, obs: Any) -> np.ndarray:
        """Return the function's actions; NaN once it has failed, which `user_code` reports after the program."""
        nothing = np.full((*obs.shape[:-1], self.actions.size), np.nan, np.float32)
        if user_code.is_waiting():
            return nothing
        try:
            actions = self._called(np.asarray(obs))
            usable = self.actions.usable(actions, np)
            if not usable.all():
                count = f"{(~usable).sum()} of {usable.size}"
                raise UserError(
                    f"{policy_name(self)} gave zero or not finite numbers in place of actions, in {count} situations"
                )
            return actions
        except BaseException as error:  # one that left the compiled program would be an error of XLA's
            user_code.leave(error)
            return nothing

    def _called(self, rows: np.ndarray) -> np.ndarray:
        """Call the function with a batch of any leading axes. Raises UserError for any exception of the function."""
        flat = rows.reshape(-1, rows.shape[-1])
        actions = self._checked(_call_user(self.function, flat), len(flat), np.asarray)
        return actions.reshape(*rows.shape[:-1], self.actions.size)

    def _checked(self, result: Any, rows: int, as_array: Callable[..., Any]) -> Any:
        """Return the function's result as an array of real numbers.

        Of a pair of actions and None (models of Stable-Baselines3), or a dictionary (of brax), the actions are taken.
        Whole numbers in a space of choices are numbers of choices.
        """
        name, shape = policy_name(self), (rows, self.actions.size)
        if isinstance(result, tuple) and len(result) == 2 and (result[1] is None or np.ndim(result[0]) == 2):
            if not isinstance(result[1], dict | None):
                raise UserError(f"{name} {MEMORY}")
            result = result[0]
        try:
            actions = as_array(result)
        except Exception as error:  # PyTorch's own kinds too
            why = " ".join(str(error).split())[:200]
            raise UserError(f"{name} returned {format_value(result)} ({why}): return an array {shape}") from error
        is_whole = jnp.issubdtype(actions.dtype, jnp.integer)
        if not is_whole and not jnp.issubdtype(actions.dtype, jnp.floating):
            raise UserError(f"{name} returned {actions.dtype} numbers: return real ones, of shape {shape}")
        if isinstance(self.actions, Choices) and actions.shape == (rows,) and is_whole:
            inside, one_hot = (actions >= 0) & (actions < shape[1]), actions[:, None] == np.arange(shape[1])
            if isinstance(inside, np.ndarray) and not inside.all():
                raise UserError(
                    f"{name} chose {actions[~inside][0]}: give the number of a choice, 0 to {shape[1] - 1}, whatever "
                    "number the environment starts from"
                )
            return jnp.where(inside[:, None], one_hot, jnp.nan) if as_array is jnp.asarray else np.float32(one_hot)
        if actions.shape != shape:
            raise UserError(f"{name} returned actions of shape {actions.shape} for {rows} observations: return {shape}")
        with np.errstate(over="ignore"):
            return actions.astype(np.float32)


@lru_cache(maxsize=64)  # once for each function
def _try(policy: Opaque, size: int) -> None:
    """Raise UserError for a function that does not repeat its actions, or whose actions depend on the batch.

    Two observations are asked about in turn, each alone, and then among others: `TRIED` in all.
    """
    rows, space = np.random.default_rng(0).random((TRIED, size), np.float32), policy.actions
    alone, again = (np.concatenate([policy._called(rows[:1]), policy._called(rows[1:2])]) for _ in range(2))
    batch, repeated = (policy._called(rows) for _ in range(2))
    entries = np.subtract(space.high, space.low) if isinstance(space, Box) else 1.0
    for actions, others, most, when in (
        (alone, again, REPEATED, "when it is asked again"),
        (batch, repeated, REPEATED, "when it is asked again"),
        (alone, batch[:2], BATCHED, f"in a batch of {TRIED}"),
    ):
        if (np.abs(np.asarray(space.retract(actions)) - np.asarray(space.retract(others))) > most * entries).any():
            advice = "give a policy without memory and sampling, as model.predict(obs, deterministic=True)"
            why = f"the same observation gets another action {when}"
            raise UserError(f"{policy_name(policy)} does not repeat itself: {why}; {advice}")


@partial(jax.jit, static_argnums=0)
def _valid(actions: Space, vectors: Array) -> Array:
    return actions.retract(actions.only_actions(vectors))


def _call_user(function: Callable[..., Any], *arguments: Any) -> Any:
    try:
        return function(*arguments)
    except UserError:
        raise
    except (Exception, SystemExit) as error:
        raise user_code_error(f"policy {code_name(function)}", error) from error


def policy_of(source: Any, space: Space | None = None) -> Any:
    """Return anything that acts as a policy.

    Args:
        source: a policy; a class or function that gives one when it is called with nothing; a function of a batch of
            observations: one that `jax.jit` made is compiled with what calls it, any other gets NumPy arrays; a
            `torch.nn.Module`; a model or policy of Stable-Baselines3, or its `predict`; or the path of a file in ONNX.
        space: the space of the actions of a function (None: not known yet).
    """
    policy = _foreign(source)
    if not _acts(policy) and _required(policy) == []:
        policy = _foreign(_call_user(policy))
    if isinstance(policy, type) or not (_acts(policy) or callable(policy)):
        raise UserError(
            f"{format_value(policy)} is no policy: give a function of observations (n, obs), a module of PyTorch, a "
            "model of Stable-Baselines3 or a file in ONNX, or load one"
        )
    if not _acts(policy):
        if len(more := _required(policy) or ()) > 1:
            raise UserError(
                f"policy {code_name(policy)} takes {', '.join(more)}: give a function of observations alone, for "
                f"instance jax.jit(lambda obs: policy(obs, {', '.join(more[1:])})[0])"
            )
        try:
            hash(policy)
        except TypeError:  # a dataclass, say
            policy = Foreign(policy, lambda one, obs: one(obs))
        policy = Opaque(policy, on_host=not isinstance(policy, jax.stages.Wrapped))
    elif jax.tree_util.all_leaves([policy]):
        kind = type(policy).__name__
        raise UserError(f"a {kind} has `act` but is no pytree: make it a flax.struct.PyTreeNode, or give a function")
    if space is None or not isinstance(policy, Opaque):
        return policy
    model = getattr(policy.function, "model", None)
    own, other = action_words(getattr(model, "action_space", None)), action_words(space)
    if own and other and own != other:
        advice = "give a world with the policy's actions, or a function that converts them"
        raise UserError(f"{policy_name(policy)} gives actions {own}, this world takes actions {other}: {advice}")
    return policy.replace(actions=space)


def _acts(code: Any) -> bool:
    return hasattr(code, "act") and not isinstance(code, type)


def _required(function: Any) -> list[str] | None:
    """Return the names of the arguments that an object cannot be called without; None: not known, or any number."""
    try:
        parameters = inspect.signature(function).parameters.values()
    except (TypeError, ValueError):  # not callable, or compiled code
        return None
    if any(one.kind in (one.VAR_POSITIONAL, one.VAR_KEYWORD) for one in parameters):
        return None
    return [one.name for one in parameters if one.default is one.empty]


class Teaching(struct.PyTreeNode):
    """A policy as a teacher (`types.Teacher`), which shows what the policy does."""

    policy: Any

    def best_action(self, state: EnvState, obs: Float[Array, " obs"]) -> Float[Array, " action"]:
        """Return the policy's action; a random policy always draws the same."""
        return self.policy.act(jax.random.key(0), jax.tree.map(lambda leaf: leaf[None], state), obs[None])[0]


def teaching(source: Any, space: Space) -> Teacher:
    """Return a teacher as given, or the teacher that shows what a given policy does (`policy_of`)."""
    if callable(getattr(source, "best_action", None)) and not isinstance(source, type | Teaching):
        return source
    return Teaching(policy_of(source.policy if isinstance(source, Teaching) else source, space))


# --- policies of other libraries -------------------------------------------------------------------------------------


class Foreign:
    """Another library's policy as a function of a batch of observations (n, obs) that returns actions, in NumPy.

    Two functions of one object, or of one file's contents, are equal: programs that call them are compiled once.
    """

    def __init__(self, model: Any, act: Callable[[Any, Any], Any], path: Path | None = None, digest: str = "") -> None:
        self.model, self._act, self._key = model, act, (path, digest) if path else id(model)
        self.__qualname__ = str(path or type(model).__qualname__)

    def __call__(self, obs: Float[np.ndarray, "n obs"]) -> Any:
        return self._act(self.model, obs)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Foreign) and self._key == other._key

    def __hash__(self) -> int:
        return hash(self._key)


def _foreign(source: Any) -> Any:
    """Return another library's policy as a function, and anything else as it is."""
    if isinstance(source, str | os.PathLike):
        path = Path(source)
        if path.suffix != ONNX and path.suffix in FILES:
            raise UserError(
                f"reading {source} may run code in it: write a module that loads it, as POLICY = PPO.load(...) or "
                "torch.jit.load(...), and give my_policy:POLICY (module:NAME; in Python, the loaded policy)"
            )
        return _onnx(path) if path.suffix == ONNX else source
    predicts = lambda one: callable(getattr(one, "predict", None)) and hasattr(one, "observation_space")  # noqa: E731
    owner = getattr(source, "__self__", None)
    source = owner if predicts(owner) and getattr(source, "__name__", "") == "predict" else source
    if predicts(source) and not isinstance(source, type):
        return Foreign(source, _predicted)
    torch = sys.modules.get("torch")
    is_module = torch is not None and hasattr(torch, "nn") and isinstance(source, torch.nn.Module)
    return Foreign(source, _forwarded) if is_module else source


_alone = threading.Lock()  # evaluation mode is a state of a module, so calls must not overlap


def _forwarded(module: Any, obs: np.ndarray) -> Any:
    """Call a module of PyTorch in evaluation mode, without gradients, on its own device; restore its modes."""
    torch: Any = sys.modules["torch"]
    floating = (own for own in module.parameters() if own.is_floating_point())
    weights = next(floating, torch.zeros((), dtype=torch.float32))
    act = getattr(module, "act_inference", module)  # rsl_rl's name for the deterministic action
    with _alone:
        # Frozen modules have no mode, and exported ones refuse `eval`.
        modes = [(part, part.training) for part in module.modules() if hasattr(part, "training")]
        try:
            for part, _ in modes:
                part.training = False
            with torch.no_grad():
                actions = act(torch.as_tensor(np.array(obs), device=weights.device, dtype=weights.dtype))
        finally:
            for part, mode in modes:
                part.training = mode
    if isinstance(actions, tuple | list) and actions:
        if RECURRENT & {getattr(part, "original_name", type(part).__name__) for part in module.modules()}:
            raise UserError(f"policy {type(module).__qualname__} {MEMORY}")
        actions = actions[0]
    return actions.detach().cpu().float().numpy() if isinstance(actions, torch.Tensor) else actions  # pyright: ignore


def _predicted(model: Any, obs: np.ndarray) -> Any:
    """Call a model of Stable-Baselines3 with observations of its own space, normalised as in its training."""
    name, space = f"policy {type(model).__qualname__}", model.observation_space
    parts = getattr(space, "spaces", {"": space})  # a dictionary's, in the order of its keys
    # the numbers of values of a `Discrete` or `MultiDiscrete` space, which vectors hold one-hot
    discrete = lambda part: np.ravel(getattr(part, "nvec", getattr(part, "n", ()))).tolist()  # noqa: E731
    counts = {key: discrete(part) if hasattr(part, "start") else [] for key, part in parts.items()}
    ends = np.cumsum([sum(counts[key]) or np.prod(part.shape, dtype=int) for key, part in parts.items()])
    if obs.shape[1] != ends[-1]:
        advice = "give the observations that it was trained on"
        raise UserError(f"{name} takes observations of {ends[-1]} entries, these have {obs.shape[1]}: {advice}")
    values: Any = {}
    for (key, part), rows in zip(parts.items(), np.split(np.array(obs), ends[:-1], axis=1), strict=True):
        if counts[key]:
            places = [one.argmax(1) for one in np.split(rows, np.cumsum(counts[key])[:-1], axis=1)]
            rows = np.stack(places, 1) + np.ravel(part.start)  # noqa: PLW2901
        values[key] = rows.reshape(len(rows), *part.shape).astype(part.dtype)
    if not hasattr(space, "spaces"):
        values = values[""]
    if (normalized := getattr(model, "get_vec_normalize_env", lambda: None)()) is not None:
        values = normalized.normalize_obs(values)
    action, state = model.predict(values, deterministic=True)
    if state is not None:
        raise UserError(f"{name} {MEMORY}")
    return action


def _onnx(path: Path) -> Foreign:
    """Return a file in ONNX with one input of observations and one output of actions, run on the CPU."""
    try:
        import onnxruntime
    except ImportError as error:
        raise UserError(f"{path} needs onnxruntime: pip install 'cuelearner-jax[onnx]'") from error
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    options.log_severity_level = 3
    try:
        session = onnxruntime.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])
    except Exception as error:  # onnxruntime's own kinds
        why = " ".join(str(error).split())[:160]
        raise UserError(f"{path} cannot be run by onnxruntime ({why}): export the policy again") from error
    inputs, outputs = session.get_inputs(), [one.name for one in session.get_outputs()]
    if len(inputs) != 1 or inputs[0].type not in REAL or len(inputs[0].shape) != 2:
        shapes = ", ".join(f"{one.name} {one.type} {one.shape}" for one in inputs)
        raise UserError(f"{path} has the inputs {shapes}: give a policy with one input of real numbers, (n, obs)")
    names = [name for name in outputs if name in ("action", "actions")] or outputs
    if len(names) != 1:
        raise UserError(f"{path} has the outputs {', '.join(outputs)}: give a policy with one, or one named action")

    def act(session: Any, obs: np.ndarray) -> np.ndarray:
        rows = np.ascontiguousarray(obs).astype(REAL[inputs[0].type])
        parts = np.split(rows, len(rows)) if inputs[0].shape[0] == 1 else [rows]
        return np.concatenate([session.run(names, {inputs[0].name: part})[0] for part in parts])

    files = sorted(path.parent.glob(f"{escape(path.name)}*"))  # weights may lie in a file of their own beside it
    digest = hashlib.sha256(b"".join(file.read_bytes() for file in files if file.is_file())).hexdigest()
    return Foreign(session, act, path.resolve(), digest)
