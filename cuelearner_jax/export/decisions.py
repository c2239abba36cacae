"""A policy's decision about one observation, and golden cases to verify it."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from cuelearner_jax import user_code
from cuelearner_jax.environment import Environment
from cuelearner_jax.errors import UserError
from cuelearner_jax.export import rules  # noqa: F401  # registers the rules of `trace`
from cuelearner_jax.export.graph import Traced, trace
from cuelearner_jax.export.runner import compile_ops, units
from cuelearner_jax.policies import Policy, describe, layers, policy_name

TOLERANCE = 1e-5  # largest allowed difference of an entry on another machine, in `runner.units`
NUDGE = 1e-6  # relative change of an observation's entry, as large as rounding may cause
NUDGES, CASES, MIXED = 4, 64, 5
ROUNDING = 1e-6  # relative error of an operation, larger than any library's
SUMS = {"matmul", "sum"}  # whose error is that of their largest part
INEXACT = SUMS | {*("add", "sub", "mul", "div", "rem", "pow", "square", "sqrt", "rsqrt", "exp", "expm1", "log")}
INEXACT |= {"log1p", "sin", "cos", "tan", "tanh", "atan", "atan2", "logistic"}
WALKERS, STEPS = 32, 4  # environments and steps that observations for golden cases come from
CALLBACKS = {"pure_callback", "io_callback", "python_callback"}


def decision_of(policy: Policy) -> Callable[[PRNGKeyArray, Array], Array]:
    """Return a policy's decision as a function (key, observation (obs,)) -> action (action,)."""
    if any(layer.get("asks") for layer in layers(describe(policy))):
        raise UserError("this policy asks a teacher, who needs the true state: export a policy without a teacher")
    return lambda key, obs: policy.act(key, None, obs[None])[0]


def row_by_row(policy: Policy) -> Callable[[Float[Array, "n obs"]], Float[Array, "n action"]]:
    """Return a function that decides about each row of a batch independently of the other rows."""
    return partial(jax.lax.map, partial(decision_of(policy), jax.random.key(0)))


def observations(env: Environment, policy: Policy, count: int = WALKERS * STEPS) -> Float[np.ndarray, "n obs"]:
    """Return observations that a policy meets in a world: episode starts, and what follows from its own actions."""

    def step(walk: tuple[Any, Array], key: PRNGKeyArray) -> tuple[tuple[Any, Array], Array]:
        state, obs = walk
        state, after = jax.vmap(env.step)(jax.random.split(key, WALKERS), state, policy.act(key, state, obs))
        return (state, after.obs), obs

    @jax.jit
    def walked(key: PRNGKeyArray) -> Array:
        k_reset, k_run = jax.random.split(key)
        start = jax.vmap(env.reset)(jax.random.split(k_reset, WALKERS))
        return jax.lax.scan(step, start, jax.random.split(k_run, -(-count // WALKERS)))[1]

    return np.concatenate(walked(jax.random.key(count)))[:count]


def trace_policy(policy: Policy, obs_size: int) -> Traced:
    """Trace a policy's decision as a graph."""
    traced = trace(decision_of(policy), obs_size)
    if CALLBACKS & set(traced.missing):
        raise UserError(
            "this policy calls a Python function, which cannot be exported: give a base of JAX functions, or export "
            "the correction alone (--only-correction, cl.export_correction)"
        )
    if traced.random:
        raise UserError("this policy acts at random, which cannot be exported: export a deterministic policy")
    return traced


class Golden(NamedTuple):
    """Golden cases: observations with the expected actions."""

    obs: Float[np.ndarray, "cases obs"]
    actions: Float[np.ndarray, "cases output"]  # computed by JAX; of a correction also observations for its base
    candidates: int  # number of observations that they were chosen from
    steady: int  # number of these observations whose decision is insensitive to rounding
    extreme: int  # number of golden cases, the last ones, that no episode led to


def extreme_observations(obs: Float[np.ndarray, "n obs"]) -> Float[np.ndarray, "extreme obs"]:
    """Return observations at the bounds of those drawn and far outside: zero, tiny, large, negative, and mixed."""
    low, high = obs.min(0), obs.max(0)
    far = (np.full_like(low, number) for number in (1e10, -1e10, 0.0, 1e-30, -1e-30))
    rows = np.stack([*far, low, high, -low, -high, 100 * low, 100 * high])
    mixed = np.random.default_rng(1).integers(len(rows), size=(MIXED, len(low)))
    return np.concatenate([rows, np.take_along_axis(rows, mixed, 0)])


def is_steady(traced: Traced, obs: Float[np.ndarray, " obs"], space: dict[str, Any]) -> bool:
    """Return whether a graph's decision stays when every inexact operation errs as by rounding.

    Entries far outside swallow all others, so that values tie for JAX, which nudged observations do not show.
    """
    steps, random = [(compile_ops([op]), *op[:3:2]) for op in traced.graph.ops], np.random.default_rng(2)
    (result,), actions = traced.graph.outputs, []
    for size in (0.0, *[ROUNDING] * NUDGES):
        values = {**traced.constants, "obs": obs}
        for run, name, outputs in steps:
            run(values)
            value = values[outputs[0]]
            if name in INEXACT and value.dtype == np.float32:
                error = size * random.uniform(-1, 1, value.shape) * (np.abs(value).max() if name in SUMS else value)
                values[outputs[0]] = np.asarray(value + error, np.float32)
        actions.append(values[result])
    return bool((np.ptp(actions, axis=0) / units(actions[0], space)).max() <= TOLERANCE)


def golden_cases(
    policy: Policy, candidates: Float[np.ndarray, "n obs"], traced: Traced, space: dict[str, Any], most: int = CASES
) -> Golden:
    """Return the first observations whose decision does not change under perturbations as small as rounding.

    `space`: that of actions, as the contract describes it.
    An argmax jumps where two values tie, and another machine may choose the other one, so such cases verify nothing.
    Up to a quarter of the cases are extreme observations, where a policy may give no action; none if its graph is
    incomplete.
    """
    candidates = np.asarray(candidates, np.float32)
    obs = np.concatenate([candidates, extreme_observations(candidates)[: 0 if traced.missing else most // 4]])
    decide = jax.jit(row_by_row(policy))
    actions = np.asarray(decide(jnp.asarray(obs)))
    user_code.check_actions(actions[: len(candidates)], policy_name(policy))
    random = np.random.default_rng(0)
    apart = np.zeros(len(obs))
    for _ in range(NUDGES):
        nudge = NUDGE * random.uniform(-1, 1, obs.shape) * np.maximum(np.abs(obs), 1.0)
        nudged = np.asarray(decide(jnp.asarray(obs + nudge, jnp.float32)))
        apart = np.maximum(apart, (np.abs(nudged - actions) / units(actions, space)).max(-1))
    steady = apart <= TOLERANCE  # never where an action is not finite
    with np.errstate(all="ignore"):
        for place in range(len(candidates), len(obs)):  # zero is no direction
            steady[place] &= actions[place].any() and is_steady(traced, obs[place], space)
    count, extreme = int(steady[: len(candidates)].sum()), int(steady[len(candidates) :].sum())
    if not count:
        why = f"all {len(candidates)} decisions change with the last digits of their observation"
        raise UserError(f"{why}, so none can serve as a golden case")
    places = np.flatnonzero(steady)
    places = np.concatenate([places[:count][: most - extreme], places[count:]])
    return Golden(obs[places], actions[places], len(candidates), count, extreme)
