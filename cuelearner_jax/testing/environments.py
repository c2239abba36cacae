"""Check the laws of an environment (`cuelearner_jax.environment.Environment`) on a roll-out of uniform actions."""

from __future__ import annotations

import re
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, PRNGKeyArray

from cuelearner_jax.environment import Aims, Environment, actions_of, offers, symmetries_of
from cuelearner_jax.testing.laws import TRACED, Laws, OnceTraced, change_floats, pytree, same_shapes
from cuelearner_jax.types import Step

COMPARED = 8  # steps of the roll-out that are taken again in one batch, and actions that features are asked about


class Trajectory(NamedTuple):
    """The steps of a roll-out; leading axis: steps."""

    obs: Array  # acted on
    actions: Array
    recalled: Array
    recalled_next: Array
    step: Step
    batched: Any  # the state and `Step` of the first steps, taken in one batch
    alone: Any  # the same, as the roll-out met them
    optional: dict[str, Any]  # results of the optional members


def check_environment(env: Any, steps: int = 64, key: PRNGKeyArray | None = None, tolerance: float = 1e-5) -> None:
    """Check that an environment keeps its laws. Raises AssertionError for the first law that is broken.

    Args:
        env: the environment to check; it should be small, since it is compiled once with a batch of a few steps.
        steps: steps of the roll-out; enough for an episode to end.
        key: random key of the roll-out (default: always the same).
        tolerance: relative and absolute, of numbers that are computed in two ways (a recalled observation, a batch).
    """
    laws = Laws(env, tolerance)
    pytree(laws, env, "the environment")
    _check_names(laws, env)
    _check_shapes(laws, env)
    key = jax.random.key(0) if key is None else key
    walked = OnceTraced(lambda env, key: _walk(env, key, steps))
    with laws.attempted("a compiled roll-out", TRACED):
        walk, again = (jax.device_get(walked(env, key)) for _ in range(2))
        walked(change_floats(env), key)
    laws.hold(Laws("", 0.0).same(walk, again), "the same key gives another roll-out: draw all numbers from the key")
    laws.hold(walked.traces == 1, "other values of its floats are traced anew: keep them out of static fields")
    _check_walk(laws, env, walk, steps)
    if "heuristic" in walk.optional:
        laws.actions(actions_of(env), walk.optional["heuristic"], "what `heuristic` gives")
    if "features" in walk.optional:
        _check_features(laws, *walk.optional["features"])
    if "aims" in walk.optional:
        _check_aims(laws, env, walk.optional["aims"])
    if "mirror" in walk.optional:
        _check_mirrors(laws, walk, **walk.optional["mirror"])


def _check_names(laws: Laws, env: Environment) -> None:
    """Check the slices of an observation."""
    names = [quantity.name for quantity in env.observation]
    for quantity in env.observation:
        sound = quantity.name and quantity.unit and quantity.size > 0
        laws.hold(sound, f"{quantity} lacks a name, a unit (of pure numbers '1') or a positive size")
    laws.hold(names and len(set(names)) == len(names), f"slices are called {names}: give each a name of its own")
    total = sum(quantity.size for quantity in env.observation)
    laws.hold(total == env.obs_size, f"quantities have {total} entries, obs_size is {env.obs_size}: derive `Described`")


def _check_shapes(laws: Laws, env: Environment) -> None:
    """Check shapes and types by tracing only."""
    space, key = actions_of(env), jax.random.key(0)
    shape = jax.eval_shape(lambda: space.sample(key, (3,))).shape
    laws.hold(shape == (3, space.size), f"its actions' `sample` gives shape {shape} for 3 actions of {space.size}")
    action = jax.ShapeDtypeStruct((space.size,), jnp.float32)
    with laws.attempted("tracing `reset` and `step`", TRACED):
        state, obs = jax.eval_shape(lambda env: env.reset(key), env)
        after, step = jax.eval_shape(lambda env, *given: env.step(key, *given), env, state, action)
        first, second = (_program(env, key) for _ in range(2))
    laws.hold(same_shapes(after, state), "`step` returns a state of other fields, shapes or types than `reset`")
    with laws.attempted("tracing `remember` and `recall`", "derive WholeObservations, or write both and `recall_next`"):
        memory = jax.eval_shape(lambda env, *given: env.remember(*given), env, state, obs)
        recalled = jax.eval_shape(lambda env, memory: env.recall(memory), env, memory)
        given = (memory, action, step.aftermath)
        following = jax.eval_shape(lambda env, *given: env.recall_next(*given), env, *given)
    observations = {"`reset`'s observation": obs, "Step.obs": step.obs, "Step.final_obs": step.final_obs}
    observations |= {"what `recall` gives": recalled, "what `recall_next` gives": following}
    flags = {"Step.terminated": step.terminated, "Step.truncated": step.truncated}
    scalars = {"Step.reward": step.reward} | {f"Step.metrics[{name!r}]": value for name, value in step.metrics.items()}
    scalars |= {f"Step.outcome[{name!r}]": value for name, value in step.outcome.items()}
    vectors = {"what `remember` keeps": memory, "Step.aftermath": step.aftermath}
    for values, shape, kind in (
        (observations, (env.obs_size,), "float32"),
        (vectors, None, "float32"),
        (scalars, (), "float32"),
        (flags, (), "bool"),
    ):
        for called, value in values.items():
            fits = value.dtype == kind and (value.ndim == 1 if shape is None else value.shape == shape)
            wanted = "with one axis" if shape is None else f"of shape {shape}"
            laws.hold(fits, f"{called} is {value.dtype} of shape {value.shape}: make it {kind} {wanted}")
    taken = sorted({"reward", "finished"} & {*step.metrics, *step.outcome} | {*step.metrics} & {*step.outcome})
    laws.hold(not taken, f"a metric or outcome is called {taken[:1]}, which results have already: give another name")
    laws.hold(first == second, "two traces give two programs: draw all random numbers from the key alone")


def _program(env: Environment, key: PRNGKeyArray) -> tuple[str, list[bytes]]:
    """Return the traced program of `reset` and `step`, as text and constants, without compiling."""

    def both(env: Any, key: PRNGKeyArray) -> Any:
        state, obs = env.reset(key)
        return env.step(key, state, actions_of(env).sample(key, ())), obs

    closed = jax.make_jaxpr(both)(env, key)
    text = re.sub(r"0x[0-9a-f]+", "", str(closed.jaxpr))  # memory addresses of functions
    numbers = [value for value in closed.consts if not jnp.issubdtype(value.dtype, jax.dtypes.prng_key)]
    return text, [np.asarray(value).tobytes() for value in numbers]


def _walk(env: Any, key: PRNGKeyArray, steps: int) -> Trajectory:
    """Compute everything that is checked of an environment, as one program."""
    k_reset, k_walk = jax.random.split(key)

    def one(carry: tuple, number: Array) -> tuple[tuple, tuple]:
        state, obs = carry
        k_act, k_step = jax.random.split(jax.random.fold_in(k_walk, number))
        action, memory = actions_of(env).sample(k_act, ()), env.remember(state, obs)
        after, step = env.step(k_step, state, action)
        recalled = env.recall(memory), env.recall_next(memory, action, step.aftermath)
        return (after, step.obs), (state, obs, action, k_step, *recalled, after, step)

    _, met = jax.lax.scan(one, env.reset(k_reset), jnp.arange(steps))
    states, obs, actions, keys, recalled, recalled_next, afters, taken = met
    few = lambda tree: jax.tree.map(lambda leaf: leaf[:COMPARED], tree)  # noqa: E731
    batched = jax.vmap(env.step)(few(keys), few(states), few(actions))
    optional = _optional(env, obs, actions)
    return Trajectory(obs, actions, recalled, recalled_next, taken, batched, few((afters, taken)), optional)


def _optional(env: Any, obs: Array, actions: Array) -> dict[str, Any]:
    """Return the optional members' results for a roll-out's observations and actions."""
    found: dict[str, Any] = {}
    if offers(env, "heuristic"):
        found["heuristic"] = jax.vmap(env.heuristic)(obs)
    if offers(env, "features"):
        few = actions[:COMPARED]
        singly = jax.tree.map(lambda *rows: jnp.stack(rows), *(tuple(env.features(obs[0], action)) for action in few))
        found["features"] = tuple(env.features(obs[0], few)), singly
    if offers(env, "aims"):
        found["aims"] = jax.vmap(env.aims)(obs)
    if offers(env, "mirror"):
        which, other = jnp.arange(symmetries_of(env)), jnp.roll(actions, 1, 0)
        each = jax.vmap(jax.vmap(env.mirror, (None, 0, 0)), (0, None, None))  # (symmetries, steps, ...)
        images = each(which, obs, actions)
        found["mirror"] = {
            "images": images,
            "other": each(which, obs, other)[1],
            "combined": each(which, obs, 2.0 * actions + other)[1],
            "twice": jax.vmap(lambda image: each(which, *image))(images),  # (first, second, steps, ...)
        }
    return found


def _check_walk(laws: Laws, env: Environment, walk: Trajectory, steps: int) -> None:
    """Check the laws of the steps."""
    step = walk.step
    laws.actions(actions_of(env), walk.actions, "what its actions' `sample` draws")
    values = {"obs": step.obs, "final_obs": step.final_obs, "reward": step.reward, **step.metrics, **step.outcome}
    for name, rows in values.items():
        wrong = np.flatnonzero(~np.isfinite(rows).reshape(steps, -1).all(-1))
        laws.hold(not len(wrong), f"{name} is not finite after step {wrong[:1]}: guard its division or root")
    both = step.terminated & step.truncated
    laws.hold(not both.any(), "a step is terminated and truncated: an end is one of them, `& ~terminated`")
    ended = step.terminated | step.truncated
    laws.hold(ended.any(), f"no episode ends within {steps} steps: give the check more steps, or episodes an end")
    laws.hold(
        any(not laws.same(step.obs[row], step.final_obs[row]) for row in np.flatnonzero(ended)),
        "Step.obs is Step.final_obs wherever an episode ends: reset there, and give the new episode's observation",
    )
    laws.hold(
        laws.same(step.obs[~ended], step.final_obs[~ended]),
        "Step.obs is not Step.final_obs where an episode goes on: they differ only by the automatic reset",
    )
    laws.hold(
        laws.same(walk.recalled, walk.obs),
        "recall(remember(state, obs)) is not obs: keep all that it is computed from, or derive WholeObservations",
    )
    laws.hold(
        laws.same(walk.recalled_next, step.final_obs),
        "recall_next(remember(state, obs), action, aftermath) is not Step.final_obs: it is before the automatic reset",
    )
    laws.hold(laws.same(walk.batched, walk.alone), "steps under vmap differ from the same steps alone")


def _check_features(laws: Laws, together: Any, each: Any) -> None:
    """Check that features of many actions are those of each, and that `own` does not depend on the action."""
    laws.hold(len(together) == len(each) == 2, "`features` are no `environment.Features`")
    (own, turned), (owns, singly) = together, each
    alike = np.ndim(own) == 1 and laws.same(np.broadcast_to(own, np.shape(owns)), owns)
    laws.hold(alike, "`features` hold values in `own` that depend on the action: move them to `turned`")
    laws.hold(
        np.shape(turned) == np.shape(singly) and np.ndim(turned) == 2 and laws.same(turned, singly),
        f"`features` of {len(singly)} actions are not those of each: let any leading axes of the actions through",
    )
    laws.hold(np.isfinite(own).all() and np.isfinite(turned).all(), "`features` are not finite everywhere")


def _check_aims(laws: Laws, env: Environment, aims: Any) -> None:
    """Check that aims are actions with features, as many in every situation (leading axis: steps)."""
    laws.hold(isinstance(aims, Aims), f"`aims` returns a {type(aims).__name__}: give `environment.Aims`")
    rows = np.shape(aims.possible)
    fits = len(rows) == 2 and np.shape(aims.actions)[:-1] == rows and np.shape(aims.features)[:-1] == rows
    fits = fits and np.asarray(aims.possible).dtype == bool
    laws.hold(fits, "`aims` have other lengths: give a row of actions, of features, and a bool, for every aim")
    laws.actions(actions_of(env), aims.actions, "an aim's action")
    laws.hold(np.isfinite(aims.features).all(), "an aim's features are not finite, where it is impossible included")
    laws.hold(np.any(aims.possible), "no aim was possible in any step: mark those that are")


def _check_mirrors(laws: Laws, walk: Trajectory, images: Any, other: Any, combined: Any, twice: Any) -> None:
    """Check that symmetries form a group of linear isometries with 0 as identity."""
    obs, vectors = images
    plain = walk.obs, walk.actions
    same = np.shape(obs)[1:] == np.shape(walk.obs) and np.shape(vectors)[1:] == np.shape(walk.actions)
    laws.hold(same, "`mirror` changes a shape: an image is an observation and a vector of the same sizes")
    laws.hold(laws.same((obs[0], vectors[0]), plain), "`mirror` 0 is not the identity: make it the first")
    lengths = np.linalg.norm(walk.actions, axis=-1)
    for number in range(len(obs)):
        called = f"`mirror` {number}"
        laws.hold(laws.same(np.linalg.norm(vectors[number], axis=-1), lengths), f"{called} changes a vector's length")
        linear = laws.same(combined[number], 2.0 * vectors[number] + other[number])
        laws.hold(linear, f"{called} of a sum of vectors is not the sum of their images: it must be linear")
        backs = ((twice[0][number, second], twice[1][number, second]) for second in range(len(obs)))
        undone = any(laws.same(back, plain) for back in backs)
        laws.hold(undone, f"no symmetry undoes {called}: add its inverse, or mend its observation")
