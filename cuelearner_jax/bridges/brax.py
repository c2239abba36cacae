"""Run brax's agents on our environments, and brax's environments in our loop. The only module that imports `brax.envs`.

`to_brax` and `wrap_for_training`: brax's PPO and SAC on our tasks. `from_brax`: a brax environment in our loop.
Written for brax 0.14.2 (`brax/envs/base.py`, `brax/envs/wrappers/training.py`).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from brax import envs
from brax.envs.wrappers import training
from flax import struct
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from cuelearner_jax.bridges.jax_environment import from_simulator
from cuelearner_jax.environment import Environment, actions_of
from cuelearner_jax.errors import UserError
from cuelearner_jax.spaces import DIRECTIONS, Box
from cuelearner_jax.types import EnvState, Step

RawKey = Any  # uint32 words, which is what brax passes: the wrappers read a batch's shape from them
State = Any  # brax.envs.State, whose methods of flax a type checker does not know

from_brax = from_simulator


def supply_device_put_replicated() -> None:
    """Restore `jax.device_put_replicated`, which JAX 0.10 removed, where it is missing.

    PPO, SAC and APG of brax 0.14.2 call it. `to_brax` does this by itself; before one of brax's agents trains on any
    other environment, do it yourself.
    """
    if not hasattr(jax, "device_put_replicated"):
        setattr(jax, "device_put_replicated", _device_put_replicated)  # noqa: B010 (the type checker knows no such name)


def _device_put_replicated(tree: Any, devices: Sequence[Any]) -> Any:
    """Copy every leaf to every device, stacked along a new first axis, one entry a device, as `pmap` takes it."""
    mesh = jax.sharding.Mesh(np.array(devices), ("device",))
    sharding = jax.sharding.NamedSharding(mesh, jax.sharding.PartitionSpec("device"))

    def replicate(leaf: Any) -> jax.Array:
        row = jnp.asarray(leaf)[None]
        shape = (len(devices), *row.shape[1:])
        return jax.make_array_from_single_device_arrays(shape, sharding, [jax.device_put(row, one) for one in devices])

    return jax.tree.map(replicate, tree)


class Episode(struct.PyTreeNode):
    """The state of our environment, which resets automatically, within `State.pipeline_state` of `BraxView`."""

    env: EnvState
    obs: Float[Array, " obs"]  # the next observation: after the automatic reset where the episode ended
    ended: Bool[Array, ""]  # True once `env` began a new episode that brax has not seen yet


class BraxView(envs.Env):
    """One of our environments as a brax environment, made by `to_brax`. Its parameters are compiled as constants."""

    backend = "cuelearner"  # pyright: ignore[reportAssignmentType]

    def __init__(self, env: Environment):
        self.sys = env  # brax's domain randomization replaces the attribute of this name

    @property
    def observation_size(self) -> int:
        """Number of entries of an observation."""
        return self.sys.obs_size

    @property
    def action_size(self) -> int:
        """Number of entries of an action."""
        return actions_of(self.sys).size

    def reset(self, rng: RawKey) -> State:
        """Start an episode."""
        k_start, k_next = jax.random.split(_typed(rng))
        state, obs = self.sys.reset(k_start)
        zero = jnp.zeros(())
        episode: Any = Episode(state, obs, jnp.array(False))  # brax declares the state of its own physics here
        shapes = jax.eval_shape(lambda: _measures(self.sys.step(k_start, state, jnp.zeros(self.action_size))[1]))
        metrics = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), shapes)
        # Not in `pipeline_state`: brax's automatic reset would bring the same random numbers back every episode.
        info = {"rng": jax.random.key_data(k_next), "truncation": zero}
        return envs.State(pipeline_state=episode, obs=obs, reward=zero, done=zero, metrics=metrics, info=info)

    def step(self, state: State, action: Float[Array, " n"]) -> State:
        """Execute the action that `action` stands for, see `to_brax`.

        A finished episode stays as it is until a wrapper begins another.

        Returns:
            `obs` is our `Step.final_obs`, `done` is `terminated` and `info["truncation"]` is `truncated`, as 0 or 1.
        """
        before, space = state.pipeline_state, actions_of(self.sys)
        if isinstance(space, Box):
            low, high = jnp.array(space.low), jnp.array(space.high)
            action = low + (high - low) * (action + 1) / 2
        key, k_next = jax.random.split(_typed(state.info["rng"]))
        following, step = self.sys.step(key, before.env, space.retract(action))
        # With an action repeat brax goes on past the end: what came out of the episode must still be there afterwards.
        hold = partial(jax.tree.map, partial(jnp.where, before.ended))
        measures = _measures(step)
        info = dict(state.info)
        info["rng"] = jax.random.key_data(k_next)
        info["truncation"] = hold(state.info["truncation"], step.truncated.astype(jnp.float32))
        if "steps" in info:
            # `EpisodeWrapper` overwrites "truncation", by this counter alone. An episode that our time limit ends must
            # look as if the wrapper's had been reached: agents would take the end for a termination, or not see it.
            info["steps"] = jnp.where(info["truncation"] > 0, jnp.inf, info["steps"])
        return state.replace(
            pipeline_state=hold(before, Episode(following, step.obs, step.terminated | step.truncated)),
            obs=hold(state.obs, step.final_obs),
            reward=hold(jnp.zeros(()), step.reward),
            done=hold(state.done, step.terminated.astype(jnp.float32)),
            metrics={**state.metrics, **hold(jax.tree.map(jnp.zeros_like, measures), measures)},
            info=info,
        )


def to_brax(env: Environment) -> BraxView:
    """Return one of our environments as a `brax.envs.Env`, whose actions are in [-1, 1]^n.

    Of directions in the plane n is 2, and only the direction counts. Of a box n is its size: -1 is each entry's lower
    bound, 1 its upper bound, and what lies beyond is brought back. Raises UserError for other spaces of actions.

    Give brax's agents `wrap_env_fn=wrap_for_training`: their own `AutoResetWrapper` begins every episode of a lane at
    the same cached first state, and reports an infinite length for a truncated episode.

    `metrics` are `Step.metrics` and, where an episode ends, `Step.outcome` (elsewhere 0), so that brax's sum over an
    episode is the outcome. A brax `randomization_fn` gets our environment and returns a batch of it with its axes.
    """
    space = actions_of(env)
    if space != DIRECTIONS and not isinstance(space, Box):
        raise UserError(
            f"to_brax works for directions and boxes, not for actions that are {space.name}: train on this environment "
            "with `cuelearner train`"
        )
    supply_device_put_replicated()
    return BraxView(env)


def wrap_for_training(
    env: envs.Env, episode_length: int = 1000, action_repeat: int = 1, randomization_fn: Callable | None = None
) -> envs.Wrapper:
    """Wrap an environment from `to_brax` so that every episode has a new random start.

    Args:
        env: an environment from `to_brax`.
        episode_length: episodes are truncated after this many steps, if not before by the environment itself.
        action_repeat: how often each action is executed.
        randomization_fn: our environment -> a batch of it and the axes to map over.
    """
    many = training.VmapWrapper(env)
    if randomization_fn is not None:
        many = training.DomainRandomizationVmapWrapper(env, randomization_fn)
    return FreshEpisodes(training.EpisodeWrapper(many, episode_length, action_repeat))


class FreshEpisodes(envs.Wrapper):
    """A replacement for `AutoResetWrapper` that begins new random episodes instead of a cached first state."""

    def step(self, state: State, action: Float[Array, "envs n"]) -> State:
        """Step; where an episode ended, return the next episode's first state, with `done` set."""
        info = {**state.info, "steps": jnp.where(state.done > 0, 0.0, state.info["steps"])}
        state = self.env.step(state.replace(done=jnp.zeros_like(state.done), info=info), action)
        episode = state.pipeline_state
        cut = (state.done > 0) & ~episode.ended  # cut by brax's step limit, which our environment does not know
        begun = (episode, episode.obs, state.info["rng"])

        def restarted() -> Any:
            fresh = self.env.reset(begun[2])
            choose = lambda new, old: jnp.where(cut.reshape(-1, *(1,) * (new.ndim - 1)), new, old)  # noqa: E731
            return jax.tree.map(choose, (fresh.pipeline_state, fresh.obs, fresh.info["rng"]), begun)

        # All environments are reset together, and only if one needs it: the predicate is one for the whole batch.
        episode, first_obs, rng = jax.lax.cond(cut.any(), restarted, lambda: begun)
        return state.replace(
            pipeline_state=episode.replace(ended=jnp.zeros_like(episode.ended)),
            obs=jnp.where(state.done[:, None] > 0, first_obs, state.obs),
            info={**state.info, "rng": rng, "steps": state.info["episode_metrics"]["length"]},
        )


def _typed(rng: RawKey) -> PRNGKeyArray:
    """Return a typed key."""
    return rng if jnp.issubdtype(rng.dtype, jax.dtypes.prng_key) else jax.random.wrap_key_data(rng)


def _measures(step: Step) -> dict[str, Array]:
    """Return the measures that brax sums over an episode; outcomes count only where it ends."""
    ended = step.terminated | step.truncated
    outcome = {name: jnp.where(ended, value, 0.0) for name, value in step.outcome.items()}
    return {name: jnp.asarray(value, jnp.float32) for name, value in {**step.metrics, **outcome}.items()}
