"""Check the laws of an environment (`cuelearner_jax.environment.Environment`) on a roll-out of uniform actions."""

from __future__ import annotations

import re
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, PRNGKeyArray

from cuelearner_jax.environment import Aims, Environment, Quantity, actions_of, offers, symmetries_of
from cuelearner_jax.testing.laws import Laws, OnceTraced, change_floats, pytree
from cuelearner_jax.types import Step

COMPARED = 8  # steps of the roll-out that are taken again in one batch, and actions that features are asked about
OWN_COLUMNS = {"reward", "finished"}  # reserved columns of results: no metric or outcome may have these names


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
    """Check that an environment keeps its laws.

    Args:
        env: the environment to check; it should be small, since it is compiled once with a batch of a few steps.
        steps: steps of the roll-out; enough for an episode to end.
        key: random key of the roll-out (default: always the same).
        tolerance: relative and absolute, of numbers that are computed in two ways (a recalled observation, a batch).

    Raises:
        AssertionError: the first law that is broken.
    """
    laws = Laws(env, tolerance)
    pytree(laws, env, "the environment")
    _check_names(laws, env)
    _check_shapes(laws, env)
    key = jax.random.key(0) if key is None else key
    walked = OnceTraced(lambda env, key: _walk(env, key, steps))
    mend = "what depends on traced values must be jax.numpy, with jnp.where and lax.cond in place of if"
    with laws.attempted("a compiled roll-out", mend):
        walk = jax.device_get(walked(env, key))
        again = jax.device_get(walked(env, key))
        walked(change_floats(env), key)
    exact = Laws(laws.subject, 0.0)
    laws.hold(exact.same(walk, again), "the same key gives another roll-out: draw all random numbers from the key")
    laws.hold(
        walked.traces == 1,
        "other values of its floats are traced anew: keep values that are computed from them out of static fields",
    )
    _check_walk(laws, env, walk, steps)
    _check_optional(laws, env, walk)


def _check_names(laws: Laws, env: Environment) -> None:
    """Check the slices of an observation."""
    laws.hold(len(env.observation) > 0, "`observation` names nothing: give a Quantity for each slice")
    for quantity in env.observation:
        laws.hold(isinstance(quantity, Quantity), f"`observation` holds {quantity!r}: give a Quantity for each slice")
        laws.hold(quantity.name and quantity.unit, f"{quantity} lacks a name or a unit: pure numbers have the unit '1'")
        laws.hold(quantity.size > 0, f"quantity {quantity.name!r} has {quantity.size} entries: give a positive size")
    names = [quantity.name for quantity in env.observation]
    laws.hold(len(set(names)) == len(names), f"two quantities have one name among {names}: give each its own")
    total = sum(quantity.size for quantity in env.observation)
    laws.hold(total == env.obs_size, f"quantities have {total} entries, obs_size is {env.obs_size}: derive `Described`")


def _check_shapes(laws: Laws, env: Environment) -> None:
    """Check shapes and types by tracing only."""
    space, key = actions_of(env), jax.random.key(0)
    shape = jax.eval_shape(lambda: space.sample(key, (3,))).shape
    laws.hold(shape == (3, space.size), f"its actions' `sample` gives shape {shape} for 3 actions of {space.size}")
    mend = "what depends on traced values must be jax.numpy, with jnp.where and lax.cond in place of if"
    with laws.attempted("tracing `reset`", mend):
        state, obs = jax.eval_shape(lambda env: env.reset(key), env)
    _vector(laws, obs, "the observation of `reset`", env.obs_size)
    action = jax.ShapeDtypeStruct((space.size,), jnp.float32)
    with laws.attempted("tracing `step`", mend):
        after, step = jax.eval_shape(lambda env, *given: env.step(key, *given), env, state, action)
    laws.hold(
        jax.tree.structure(after) == jax.tree.structure(state)
        and [(leaf.shape, leaf.dtype) for leaf in jax.tree.leaves(after)]
        == [(leaf.shape, leaf.dtype) for leaf in jax.tree.leaves(state)],
        "`step` returns a state of other fields, shapes or types than `reset`: keep them, as a scan must",
    )
    _check_step_shapes(laws, env, step)
    with laws.attempted("tracing `remember` and `recall`", "derive WholeObservations, or write both and `recall_next`"):
        memory = jax.eval_shape(lambda env, *given: env.remember(*given), env, state, obs)
        _vector(laws, memory, "what `remember` keeps")
        _vector(
            laws,
            jax.eval_shape(lambda env, memory: env.recall(memory), env, memory),
            "what `recall` gives",
            env.obs_size,
        )
        given = (memory, action, step.aftermath)
        following = jax.eval_shape(lambda env, *given: env.recall_next(*given), env, *given)
        _vector(laws, following, "what `recall_next` gives", env.obs_size)
    with laws.attempted("tracing `reset` and `step`", mend):
        first, second = (_program(env, key) for _ in range(2))
    laws.hold(
        first == second,
        "two traces give two programs: draw random numbers from the key alone, NumPy's and Python's are constants",
    )


def _check_step_shapes(laws: Laws, env: Environment, step: Step) -> None:
    _vector(laws, step.obs, "Step.obs", env.obs_size)
    _vector(laws, step.final_obs, "Step.final_obs", env.obs_size)
    _vector(laws, step.aftermath, "Step.aftermath")
    scalars = {"reward": step.reward} | {f"metrics[{name!r}]": value for name, value in step.metrics.items()}
    scalars |= {f"outcome[{name!r}]": value for name, value in step.outcome.items()}
    flags = {"terminated": step.terminated, "truncated": step.truncated}
    for name, value in {**scalars, **flags}.items():
        kind = "bool" if name in flags else "float32"
        fits = value.shape == () and value.dtype == kind
        laws.hold(fits, f"Step.{name} is {value.dtype} of shape {value.shape}: make it one {kind} (.astype)")
    taken = sorted(OWN_COLUMNS & {*step.metrics, *step.outcome} | {*step.metrics} & {*step.outcome})
    laws.hold(not taken, f"a metric or outcome is called {taken[:1]}, which results have already: give another name")


def _vector(laws: Laws, value: Any, called: str, size: int | None = None) -> None:
    fits = len(value.shape) == 1 and (size is None or value.shape == (size,))
    wanted = "one axis" if size is None else f"shape ({size},), as `observation` says"
    laws.hold(fits, f"{called} has shape {value.shape}: it must have {wanted}")
    laws.hold(value.dtype == jnp.float32, f"{called} is {value.dtype}: make it float32")


def _program(env: Environment, key: PRNGKeyArray) -> tuple[str, list[bytes]]:
    """Return the traced program of `reset` and `step`, as text and constants, without compiling."""

    def both(env: Any, key: PRNGKeyArray) -> Any:
        state, obs = env.reset(key)
        return env.step(key, state, actions_of(env).sample(key, ())), obs

    closed = jax.make_jaxpr(both)(env, key)
    text = re.sub(r"0x[0-9a-f]+", "", str(closed.jaxpr))  # memory addresses of functions
    return text, [np.asarray(value).tobytes() for value in closed.consts if not _is_key(value)]


def _is_key(value: Any) -> bool:
    return jnp.issubdtype(value.dtype, jax.dtypes.prng_key)


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
    optional = _asked(env, obs, actions)
    return Trajectory(obs, actions, recalled, recalled_next, taken, batched, few((afters, taken)), optional)


def _asked(env: Any, obs: Array, actions: Array) -> dict[str, Any]:
    """Return the optional members' results for a roll-out's observations and actions."""
    found: dict[str, Any] = {}
    if offers(env, "heuristic"):
        found["heuristic"] = jax.vmap(env.heuristic)(obs)
    if offers(env, "features"):
        few = actions[:COMPARED]
        each = [env.features(obs[0], action) for action in few]
        singly = jax.tree.map(lambda *rows: jnp.stack(rows), *map(tuple, each))
        found["features"] = tuple(env.features(obs[0], few)), singly
    if offers(env, "aims"):
        found["aims"] = jax.vmap(env.aims)(obs)
    if offers(env, "mirror"):
        which = jnp.arange(symmetries_of(env))
        rows = jax.vmap(env.mirror, (None, 0, 0))
        each = jax.vmap(rows, (0, None, None))  # (symmetries, steps, ...)
        other = jnp.roll(actions, 1, 0)
        images = each(which, obs, actions)
        found["mirror"] = {
            "images": images,
            "other": each(which, obs, other)[1],
            "combined": each(which, obs, 2.0 * actions + other)[1],
            # (first, second, steps, ...)
            "twice": jax.vmap(lambda image: each(which, *image))(images),
        }
    return found


def _check_walk(laws: Laws, env: Environment, walk: Trajectory, steps: int) -> None:
    """Check the laws of the steps."""
    step = walk.step
    laws.actions(actions_of(env), walk.actions, "what its actions' `sample` draws")
    told = {"obs": step.obs, "final_obs": step.final_obs, "reward": step.reward, **step.metrics, **step.outcome}
    for name, values in told.items():
        laws.hold(
            np.isfinite(values).all(),
            f"{name} is not finite after step {_first(~np.isfinite(values))}: guard its division or root",
        )
    both = step.terminated & step.truncated
    laws.hold(
        not both.any(), f"step {_first(both)} is terminated and truncated: an end is one of them, `& ~terminated`"
    )
    ended = step.terminated | step.truncated
    laws.hold(ended.any(), f"no episode ends within {steps} steps: give the check more steps, or episodes an end")
    laws.hold(
        any(not laws.same(step.obs[row], step.final_obs[row]) for row in np.flatnonzero(ended)),
        "Step.obs is Step.final_obs wherever an episode ends: reset there, and give the new episode's observation",
    )
    going = ~ended
    laws.hold(
        laws.same(step.obs[going], step.final_obs[going]),
        "Step.obs is not Step.final_obs where an episode goes on: they differ only by the automatic reset",
    )
    laws.hold(
        laws.same(walk.recalled, walk.obs),
        "recall(remember(state, obs)) is not obs: keep all that it is computed from (where an episode has just begun "
        "too), or derive WholeObservations",
    )
    laws.hold(
        laws.same(walk.recalled_next, step.final_obs),
        "recall_next(remember(state, obs), action, aftermath) is not Step.final_obs: it is before the automatic reset",
    )
    laws.hold(
        laws.same(walk.batched, walk.alone),
        "steps under vmap differ from the same steps alone: one situation must not look at its neighbours",
    )


def _check_optional(laws: Laws, env: Environment, walk: Trajectory) -> None:
    """Check the laws of the optional members."""
    if "heuristic" in walk.optional:
        laws.actions(actions_of(env), walk.optional["heuristic"], "what `heuristic` gives")
    if "features" in walk.optional:
        _check_features(laws, *walk.optional["features"])
    if "aims" in walk.optional:
        _check_aims(laws, env, walk.optional["aims"])
    if "mirror" in walk.optional:
        _check_mirrors(laws, walk, **walk.optional["mirror"])


def _check_features(laws: Laws, together: Any, each: Any) -> None:
    """Check that features of many actions are those of each, and that `own` does not depend on the action."""
    laws.hold(
        len(together) == len(each) == 2,
        "`features` are no `environment.Features`: give the part that does not depend on the action, and the rest",
    )
    (own, turned), (owns, singly) = together, each
    laws.hold(
        np.ndim(own) == 1 and laws.same(np.broadcast_to(own, np.shape(owns)), owns),
        "`features` hold values in `own` that depend on the action: move them to `turned`",
    )
    fits = np.shape(turned) == np.shape(singly) and np.ndim(turned) == 2
    laws.hold(
        fits and laws.same(turned, singly),
        f"`features` of {len(singly)} actions (`turned` of shape {np.shape(turned)}) are not those of each (together "
        f"{np.shape(singly)}): let any leading axes of the actions through",
    )
    finite = np.isfinite(own).all() and np.isfinite(turned).all()
    laws.hold(finite, "`features` are not finite everywhere")


def _check_aims(laws: Laws, env: Environment, aims: Any) -> None:
    """Check that aims are actions with features, as many in every situation (leading axis: steps)."""
    laws.hold(isinstance(aims, Aims), f"`aims` returns a {type(aims).__name__}: give `environment.Aims`")
    rows = np.shape(aims.possible)
    fits = len(rows) == 2 and np.shape(aims.actions)[:-1] == rows and np.shape(aims.features)[:-1] == rows
    laws.hold(
        fits and np.asarray(aims.possible).dtype == bool,
        f"`aims` are actions {np.shape(aims.actions)[1:]}, features {np.shape(aims.features)[1:]} and `possible` "
        f"{rows[1:]}: give a row of each, and a bool, for every aim",
    )
    laws.actions(actions_of(env), aims.actions, "an aim's action")
    laws.hold(np.isfinite(aims.features).all(), "an aim's features are not finite, where it is impossible included")
    laws.hold(np.any(aims.possible), "no aim was possible in any step: mark those that are")


def _check_mirrors(laws: Laws, walk: Trajectory, images: Any, other: Any, combined: Any, twice: Any) -> None:
    """Check that symmetries form a group of linear isometries with 0 as identity."""
    obs, vectors = images
    same = np.shape(obs)[1:] == np.shape(walk.obs) and np.shape(vectors)[1:] == np.shape(walk.actions)
    laws.hold(same, "`mirror` changes a shape: an image is an observation and a vector of the same sizes")
    laws.hold(
        laws.same((obs[0], vectors[0]), (walk.obs, walk.actions)), "`mirror` 0 is not the identity: make it the first"
    )
    for number in range(len(obs)):
        lengths = np.linalg.norm(vectors[number], axis=-1)
        laws.hold(
            laws.same(lengths, np.linalg.norm(walk.actions, axis=-1)),
            f"`mirror` {number} changes a vector's length: it must be a reflection, a rotation or both",
        )
        laws.hold(
            laws.same(combined[number], 2.0 * vectors[number] + other[number]),
            f"`mirror` {number} of a sum of vectors is not the sum of their images: it must be linear, for residuals",
        )
        back = any(
            laws.same((twice[0][number, second], twice[1][number, second]), (walk.obs, walk.actions))
            for second in range(len(obs))
        )
        laws.hold(back, f"no symmetry undoes `mirror` {number}: add its inverse, or mend its observation")


def _first(rows: Array | np.ndarray) -> int:
    """Return the first row in which something is true."""
    return int(np.argmax(np.asarray(rows).reshape(len(rows), -1).any(-1)))
