"""Our environments for brax's agents, and brax's environments for our loop. The only file that knows `brax.envs`.

`to_brax` and `wrap_for_training`: brax's PPO and SAC on any of our tasks. `from_brax`: a brax task in our loop.
Written for brax 0.14.2 (`brax/envs/base.py`, `brax/envs/wrappers/training.py`).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from brax import envs
from brax.envs.wrappers import training
from flax import struct
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from cuelearner_jax.environment import Environment, Quantity, WholeObservations, actions_of
from cuelearner_jax.errors import UserError
from cuelearner_jax.spaces.directions import check_directions, retract
from cuelearner_jax.types import EnvState, Step

RawKey = Any  # uint32 words, which is what brax passes: the wrappers read a batch's shape from them
State = Any  # brax.envs.State, whose methods of flax a type checker does not know
X_AXIS = (1.0, 0.0)


def supply_device_put_replicated() -> None:
    """Gives `jax` back the function `device_put_replicated`, gone since JAX 0.10, where it is missing.

    PPO, SAC and APG of brax 0.14.2 call it. `to_brax` does this by itself; before one of brax's agents trains on any
    other environment, do it yourself.
    """
    if not hasattr(jax, "device_put_replicated"):
        setattr(jax, "device_put_replicated", _device_put_replicated)  # noqa: B010 (the type checker knows no such name)


def _device_put_replicated(tree: Any, devices: Sequence[Any]) -> Any:
    """A copy of every leaf on every device, stacked along a new first axis, one entry a device: what `pmap` takes."""
    mesh = jax.sharding.Mesh(np.array(devices), ("device",))
    sharding = jax.sharding.NamedSharding(mesh, jax.sharding.PartitionSpec("device"))

    def replicate(leaf: Any) -> jax.Array:
        row = jnp.asarray(leaf)[None]
        shape = (len(devices), *row.shape[1:])
        return jax.make_array_from_single_device_arrays(shape, sharding, [jax.device_put(row, one) for one in devices])

    return jax.tree.map(replicate, tree)


class Episode(struct.PyTreeNode):
    """`State.pipeline_state` of `BraxView`: where our environment, which resets by itself, stands."""

    env: EnvState
    obs: Float[Array, " obs"]  # to act on next: after the automatic reset where the episode ended
    ended: Bool[Array, ""]  # `env` has begun an episode that nobody has been told of yet


class BraxView(envs.Env):
    """One of our environments as brax sees it, made by `to_brax`. Its parameters are constants of what is compiled."""

    def __init__(self, env: Environment):
        self.sys = env  # brax's domain randomization replaces the attribute of this name

    @property
    def observation_size(self) -> int:
        """Number of entries of an observation."""
        return self.sys.obs_size

    @property
    def action_size(self) -> int:
        """A vector of the plane, of which the direction counts."""
        return 2

    @property
    def backend(self) -> str:
        """None of brax's."""
        return "cuelearner"

    def reset(self, rng: RawKey) -> State:
        """Starts an episode."""
        k_start, k_next = jax.random.split(_typed(rng))
        state, obs = self.sys.reset(k_start)
        zero = jnp.zeros(())
        episode: Any = Episode(state, obs, jnp.array(False))  # brax declares the state of its own physics here
        shapes = jax.eval_shape(lambda: _measures(self.sys.step(k_start, state, jnp.array(X_AXIS))[1]))
        return envs.State(
            pipeline_state=episode,
            obs=obs,
            reward=zero,
            done=zero,
            metrics=jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), shapes),
            # Not in `pipeline_state`: brax's automatic reset would bring the same random numbers back every episode.
            info={"rng": jax.random.key_data(k_next), "truncation": zero},
        )

    def step(self, state: State, action: Float[Array, "2"]) -> State:
        """Executes the direction `retract(action)`. A finished episode stays as it is until a wrapper begins another.

        Returns:
            `obs` is our `Step.final_obs`, `done` is `terminated` and `info["truncation"]` is `truncated`, as 0 or 1.
        """
        before = state.pipeline_state
        key, k_next = jax.random.split(_typed(state.info["rng"]))
        following, step = self.sys.step(key, before.env, retract(action))
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
    """One of our environments as a `brax.envs.Env`: action in [-1, 1]^2, of which only the direction counts.

    Episodes that our environment truncates arrive at brax's agents as truncated, under brax's own wrappers too; but
    `AutoResetWrapper` begins every episode of a lane at the same cached first state, and brax's evaluator then calls
    the length of a truncated episode infinite. `wrap_for_training` does neither:
    `ppo.train(to_brax(env), wrap_env_fn=wrap_for_training, ...)`.

    `metrics` are `Step.metrics` and, where an episode ends, `Step.outcome` (elsewhere 0), so that brax's sum over an
    episode is the outcome. A brax `randomization_fn` gets our environment and returns a batch of it with its axes.

    Raises UserError for an environment whose actions are no directions.
    """
    check_directions(actions_of(env), "to_brax", "train on this environment with `cuelearner train`")
    supply_device_put_replicated()
    return BraxView(env)


def wrap_for_training(
    env: envs.Env, episode_length: int = 1000, action_repeat: int = 1, randomization_fn: Callable | None = None
) -> envs.Wrapper:
    """In place of `brax.envs.training.wrap`, for environments from `to_brax`: every episode has a new random start.

    Args:
        env: from `to_brax`.
        episode_length: episodes are truncated after this many steps, if not before by the environment itself.
        action_repeat: how often each action is executed.
        randomization_fn: our environment -> a batch of it and the axes to map over.
    """
    many = (
        training.VmapWrapper(env)
        if randomization_fn is None
        else training.DomainRandomizationVmapWrapper(env, randomization_fn)
    )
    return FreshEpisodes(training.EpisodeWrapper(many, episode_length, action_repeat))


class FreshEpisodes(envs.Wrapper):
    """What `AutoResetWrapper` does, but with our automatic reset in place of a cached first state."""

    def step(self, state: State, action: Float[Array, "envs 2"]) -> State:
        """Steps; where that ended an episode, the state is the next one's first and `done` says so."""
        info = {**state.info, "steps": jnp.where(state.done > 0, 0.0, state.info["steps"])}
        state = self.env.step(state.replace(done=jnp.zeros_like(state.done), info=info), action)
        episode = state.pipeline_state
        cut = (state.done > 0) & ~episode.ended  # by brax's limit: our environment knows nothing of it
        begun = (episode, episode.obs, state.info["rng"])
        # A reset of all is only worth its time if one needs it; the predicate is one for the whole batch.
        episode, first_obs, rng = jax.lax.cond(cut.any(), lambda: self._restarted(cut, begun), lambda: begun)
        info = {**state.info, "rng": rng, "steps": state.info["episode_metrics"]["length"]}
        return state.replace(
            pipeline_state=episode.replace(ended=jnp.zeros_like(episode.ended)),
            obs=jnp.where(state.done[:, None] > 0, first_obs, state.obs),
            info=info,
        )

    def _restarted(self, cut: Bool[Array, " envs"], begun: tuple) -> tuple:
        """New episodes where the old ones were cut."""
        fresh = self.env.reset(begun[2])
        started = (fresh.pipeline_state, fresh.obs, fresh.info["rng"])

        def choose(new: Array, old: Array) -> Array:
            return jnp.where(cut.reshape(-1, *(1,) * (new.ndim - 1)), new, old)

        return jax.tree.map(choose, started, begun)


def _typed(rng: RawKey) -> PRNGKeyArray:
    """Our kind of key."""
    return rng if jnp.issubdtype(rng.dtype, jax.dtypes.prng_key) else jax.random.wrap_key_data(rng)


def _measures(step: Step) -> dict[str, Array]:
    """What brax adds up over an episode: outcomes only count where it ends."""
    ended = step.terminated | step.truncated
    outcome = {name: jnp.where(ended, value, 0.0) for name, value in step.outcome.items()}
    return {name: jnp.asarray(value, jnp.float32) for name, value in {**step.metrics, **outcome}.items()}


class Running(struct.PyTreeNode):
    """State of a `BraxTask` between steps."""

    brax: State
    steps: Int[Array, ""]  # taken in this episode


class BraxTask(WholeObservations, struct.PyTreeNode):
    """A brax environment as one of ours (`cuelearner_jax.environment.Environment`), made by `from_brax`."""

    max_steps: Int[Array, ""]  # an episode is truncated after this many
    env: Any = struct.field(pytree_node=False)  # brax.envs.Env
    entries: int = struct.field(pytree_node=False)  # of an observation
    to_action: Callable[[Float[Array, "2"]], Float[Array, " n"]] = struct.field(pytree_node=False)
    heuristic: Callable[[Float[Array, " obs"]], Float[Array, "2"]] | None = struct.field(pytree_node=False)

    @property
    def observation(self) -> tuple[Quantity, ...]:
        """One slice: brax names none."""
        return (Quantity(type(self.env.unwrapped).__name__.lower(), self.entries, "as brax has them"),)

    def reset(self, key: PRNGKeyArray) -> tuple[Running, Float[Array, " obs"]]:
        """Starts an episode."""
        state = _as_arrays(self.env.reset(jax.random.key_data(key)))
        return Running(state, jnp.zeros((), jnp.int32)), state.obs

    def step(self, key: PRNGKeyArray, state: Running, action: Float[Array, "2"]) -> tuple[Running, Step]:
        """One step of brax's, then its reset if that was the end. `key` is the reset's: its steps know no key."""
        before = jax.tree.map(lambda leaf: leaf, state.brax)  # brax writes into the dictionaries that it is given
        after = Running(_as_arrays(self.env.step(before, self.to_action(action))), state.steps + 1)
        stopped = jnp.asarray(after.brax.info.get("truncation", 0)) > 0
        terminated = (after.brax.done > 0) & ~stopped
        truncated = (stopped | (after.steps >= self.max_steps)) & ~terminated
        fresh, fresh_obs = self.reset(key)
        final_obs, ended = after.brax.obs, terminated | truncated
        step = Step(
            obs=jnp.where(ended, fresh_obs, final_obs),
            final_obs=final_obs,
            aftermath=final_obs,
            reward=after.brax.reward.astype(jnp.float32),
            terminated=terminated,
            truncated=truncated,
            metrics={name: jnp.asarray(value, jnp.float32) for name, value in after.brax.metrics.items()},
            outcome={},
        )
        return jax.tree.map(partial(jnp.where, ended), fresh, after), step


def from_brax(
    env: envs.Env,
    to_action: Callable[[Float[Array, "2"]], Float[Array, " n"]] | None = None,
    max_steps: int = 1000,
    heuristic: Callable[[Float[Array, " obs"]], Float[Array, "2"]] | None = None,
) -> BraxTask:
    """A brax environment as one of ours. `env` becomes a constant of what is compiled, `max_steps` is traced.

    Args:
        env: bare, or in brax's `EpisodeWrapper`, whose truncations are then truncations here.
        to_action: direction (2,) -> brax action (n,) in [-1, 1]^n. Not needed for two actions (the direction itself, in
            the box [-1, 1]^2) and for one (the direction's x).
        max_steps: an episode is truncated after this many steps.
        heuristic: observation -> the obvious direction. A brax environment names none: without this the guidance
            "heuristic" is refused there.

    Raises:
        UserError: observations or actions do not fit.
    """
    name = type(env.unwrapped).__name__
    shapes = jax.eval_shape(env.reset, jax.random.key_data(jax.random.key(0)))
    if isinstance(shapes.obs, Mapping):
        raise UserError(f"{name}: observations are a dictionary ({', '.join(shapes.obs)}); an array (n,) is needed")
    if shapes.obs.ndim != 1:
        raise UserError(
            f"{name}: observations have shape {shapes.obs.shape}; one (n,) of a single environment is needed"
        )
    if "first_obs" in shapes.info:
        raise UserError(f"{name}: AutoResetWrapper hides the last observation of an episode: pass what it wraps")
    if to_action is None:
        to_action = _to_box(name, env.action_size)
    given = jax.eval_shape(to_action, jnp.array(X_AXIS)).shape
    if given != (env.action_size,):
        raise UserError(f"{name}: to_action returns shape {given}, but an action has shape {(env.action_size,)}")
    return BraxTask(
        max_steps=jnp.array(max_steps, jnp.int32),
        env=env,
        entries=shapes.obs.shape[0],
        to_action=to_action,
        heuristic=heuristic,
    )


def _to_box(name: str, size: int) -> Callable[[Float[Array, "2"]], Float[Array, " n"]]:
    """A direction in brax's box, where there is only one way."""
    if size == 1:
        return _x_alone
    if size == 2:
        return _itself
    raise UserError(
        f"{name}: an action has {size} entries: pass to_action, a function from a direction (2,) to ({size},)"
    )


def _as_arrays(state: State) -> State:
    """Some of brax's environments pay Python's numbers."""
    return jax.tree.map(jnp.asarray, state)


# Functions of the module, and not lambdas: two adapters of one environment then share what is compiled.
def _itself(action: Float[Array, "2"]) -> Float[Array, "2"]:
    return action


def _x_alone(action: Float[Array, "2"]) -> Float[Array, "1"]:
    return action[:1]
