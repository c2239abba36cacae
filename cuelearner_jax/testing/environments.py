"""Check the laws of an environment (`cuelearner_jax.environment.Environment`) on a roll-out of uniform actions."""

from __future__ import annotations

import re
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, PRNGKeyArray

from cuelearner_jax.environment import Aims, Environment, WholeObservations, actions_of, offers, symmetries_of
from cuelearner_jax.runs.training import ambiguous_names
from cuelearner_jax.testing.laws import Laws, shapes_of

COMPARED = 8  # steps of the roll-out that are taken again in one batch, and actions that features are asked about


def check_environment(env: Any, steps: int = 64, tolerance: float = 1e-5) -> None:
    """Check that an environment keeps its laws. Raises AssertionError for the first law that is broken.

    The environment should be small, since it is compiled once with a batch of a few steps, and an episode should end
    within `steps`. `tolerance` (relative and absolute) is of numbers that are computed in two ways.
    """
    laws = Laws(env, tolerance)
    names = [quantity.name for quantity in env.observation]
    sound = all(quantity.name and quantity.unit and quantity.size > 0 for quantity in env.observation)
    laws.hold(sound, "a slice of its observation lacks a name, a unit (of pure numbers '1') or a positive size")
    laws.hold(names and len(set(names)) == len(names), f"slices are called {names}: give each a name of its own")
    _check_shapes(laws, env)
    path = jax.device_get(jax.jit(lambda env, key: _walk(env, key, steps))(env, jax.random.key(0)))
    _check_steps(laws, env, path, steps)
    if offers(env, "heuristic"):
        laws.actions(actions_of(env), path["heuristic"], "what `heuristic` gives")
    if offers(env, "features"):
        _check_features(laws, *path["features"])
    if offers(env, "aims"):
        _check_aims(laws, env, path["aims"])
    if offers(env, "mirror"):
        _check_mirrors(laws, path)


def _check_shapes(laws: Laws, env: Environment) -> None:
    """Check shapes and types by tracing only."""
    key, action = jax.random.key(0), jax.ShapeDtypeStruct((actions_of(env).size,), jnp.float32)
    state, obs = jax.eval_shape(env.reset, key)
    after, step = jax.eval_shape(env.step, key, state, action)
    programs = [  # each of a new function: JAX would give the first one's program again
        jax.make_jaxpr(lambda action: (env.reset(key), env.step(key, env.reset(key)[0], action)))(action)
        for _ in range(2)
    ]
    laws.hold(shapes_of(after) == shapes_of(state), "`step` returns a state of other fields, shapes or types")
    memory = jax.eval_shape(env.remember, state, obs)
    following = jax.eval_shape(env.recall_next, memory, action, step.aftermath)
    count, is_whole = getattr(env, "privileged", 0), isinstance(env, WholeObservations)
    whole = not count or min(memory.size, step.aftermath.size) >= count + obs.size * is_whole
    laws.hold(whole, "`privileged` numbers are missing: append them to what `remember` returns and to `Step.aftermath`")
    observations = {"observation": obs, "Step.obs": step.obs, "Step.final_obs": step.final_obs}
    observations |= {"what `recall` gives": jax.eval_shape(env.recall, memory), "what `recall_next` gives": following}
    flags = {"Step.terminated": step.terminated, "Step.truncated": step.truncated}
    scalars = {"Step.reward": step.reward, **step.metrics, **step.outcome}
    size = sum(quantity.size for quantity in env.observation)
    for values, shape, kind in ((observations, (size,), "float32"), (scalars, (), "float32"), (flags, (), "bool")):
        for name, value in values.items():
            fits = value.dtype == kind and value.shape == shape
            laws.hold(fits, f"{name} is {value.dtype} of shape {value.shape}: make it {kind} of shape {shape}")
    names = ambiguous_names(step)
    laws.hold(not names, f"metrics or outcomes are called {names}, as other columns of results: give other names")
    one, other = (re.sub("0x[0-9a-f]+", "", str(program)) for program in programs)  # without memory addresses
    laws.hold(one == other, "two traces give two programs: draw all random numbers from the key alone")


def _walk(env: Any, key: PRNGKeyArray, steps: int) -> dict[str, Any]:
    """Compute everything that is checked of an environment, as one program; leading axis: steps."""
    k_reset, k_walk = jax.random.split(key)

    def one(carry: tuple, number: Array) -> tuple[tuple, tuple]:
        state, obs = carry
        k_act, k_step = jax.random.split(jax.random.fold_in(k_walk, number))
        action, memory = actions_of(env).sample(k_act, ()), env.remember(state, obs)
        after, step = env.step(k_step, state, action)
        recalled = env.recall(memory), env.recall_next(memory, action, step.aftermath)
        return (after, step.obs), (k_step, state, obs, action, recalled, after, step)

    _, (keys, states, obs, actions, recalled, afters, step) = jax.lax.scan(one, env.reset(k_reset), jnp.arange(steps))
    few = lambda tree: jax.tree.map(lambda leaf: leaf[:COMPARED], tree)  # noqa: E731
    path: dict[str, Any] = {"obs": obs, "actions": actions, "recalled": recalled, "step": step}
    path["batched"] = jax.vmap(env.step)(few(keys), few(states), few(actions)), few((afters, step))
    if offers(env, "heuristic"):
        path["heuristic"] = jax.vmap(env.heuristic)(obs)
    if offers(env, "features"):
        each = [tuple(env.features(obs[0], action)) for action in few(actions)]
        path["features"] = tuple(env.features(obs[0], few(actions))), jax.tree.map(lambda *rows: jnp.stack(rows), *each)
    if offers(env, "aims"):
        path["aims"] = jax.vmap(env.aims)(obs)
    if offers(env, "mirror"):
        which, other = jnp.arange(symmetries_of(env)), jnp.roll(actions, 1, 0)
        image = jax.vmap(jax.vmap(env.mirror, (None, 0, 0)), (0, None, None))  # (symmetries, steps, ...)
        path["images"] = image(which, obs, actions)
        sums = 2.0 * path["images"][1] + image(which, obs, other)[1]
        path["sums"] = image(which, obs, 2.0 * actions + other)[1], sums
        path["twice"] = jax.vmap(lambda both: image(which, *both))(path["images"])  # (first, second, steps, ...)
    return path


def _check_steps(laws: Laws, env: Environment, path: dict[str, Any], steps: int) -> None:
    step = path["step"]
    laws.actions(actions_of(env), path["actions"], "what its actions' `sample` draws")
    values = {"obs": step.obs, "final_obs": step.final_obs, "reward": step.reward, **step.metrics, **step.outcome}
    for name, rows in values.items():
        wrong = np.flatnonzero(~np.isfinite(rows).reshape(steps, -1).all(-1))
        laws.hold(not len(wrong), f"{name} is not finite after step {wrong[:1]}: guard its division or root")
    both, ended = step.terminated & step.truncated, step.terminated | step.truncated
    laws.hold(not both.any(), "a step is terminated and truncated: an end is one of them, `& ~terminated`")
    laws.hold(ended.any(), f"no episode ends within {steps} steps: give the check more steps, or episodes an end")
    is_reset = any(not laws.same(step.obs[row], step.final_obs[row]) for row in np.flatnonzero(ended))
    laws.hold(is_reset, "Step.obs is Step.final_obs wherever an episode ends: give the new episode's observation")
    same = laws.same(step.obs[~ended], step.final_obs[~ended])
    laws.hold(same, "Step.obs is not Step.final_obs where an episode goes on: they differ only by the automatic reset")
    same, same_next = (laws.same(*pair) for pair in zip(path["recalled"], (path["obs"], step.final_obs), strict=True))
    laws.hold(same, "recall(remember(state, obs)) is not obs: keep all of it, or derive WholeObservations")
    broken = "recall_next(remember(state, obs), action, aftermath) is not Step.final_obs, as before an automatic reset"
    laws.hold(same_next, broken)
    laws.hold(laws.same(*path["batched"]), "steps under vmap differ from the same steps alone")


def _check_features(laws: Laws, together: Any, each: Any) -> None:
    (own, turned), (owns, singly) = together, each
    alike = np.ndim(own) == 1 and laws.same(np.broadcast_to(own, np.shape(owns)), owns)
    laws.hold(alike, "`features` hold values in `own` that depend on the action: move them to `turned`")
    alike = np.ndim(turned) == 2 and laws.same(turned, singly)
    laws.hold(alike, "`features` of several actions are not those of each: let any leading axes of the actions through")


def _check_aims(laws: Laws, env: Environment, aims: Aims) -> None:
    rows = np.shape(aims.possible)
    fits = len(rows) == 2 and np.shape(aims.actions)[:-1] == rows and np.shape(aims.features)[:-1] == rows
    laws.hold(fits, "`aims` have other lengths: give a row of actions, of features, and a bool, for every aim")
    laws.actions(actions_of(env), aims.actions, "an aim's action")
    laws.hold(np.isfinite(aims.features).all(), "an aim's features are not finite, where it is impossible included")
    laws.hold(np.any(aims.possible), "no aim was possible in any step: mark those that are")


def _check_mirrors(laws: Laws, path: dict[str, Any]) -> None:
    (obs, vectors), plain, twice = path["images"], (path["obs"], path["actions"]), path["twice"]
    same = np.shape(obs)[1:] == np.shape(plain[0]) and np.shape(vectors)[1:] == np.shape(plain[1])
    laws.hold(same, "`mirror` changes a shape: an image is an observation and a vector of the same sizes")
    laws.hold(laws.same((obs[0], vectors[0]), plain), "`mirror` 0 is not the identity: make it the first")
    lengths = np.broadcast_to(np.linalg.norm(plain[1], axis=-1), vectors.shape[:2])
    laws.hold(laws.same(np.linalg.norm(vectors, axis=-1), lengths), "`mirror` changes a vector's length")
    laws.hold(laws.same(*path["sums"]), "`mirror` of a sum of vectors is not the sum of their images")
    for number in range(len(obs)):
        undone = any(laws.same(back, plain) for back in zip(twice[0][number], twice[1][number], strict=True))
        laws.hold(undone, f"no symmetry undoes `mirror` {number}: add its inverse, or mend its observation")
