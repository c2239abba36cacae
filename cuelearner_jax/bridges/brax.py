"""Simulators with brax's interface, MuJoCo Playground's included, as environments for our loop (`from_brax`).

Such a simulator has `reset(rng) -> State` and `step(state, action) -> State`; a State has `obs`, `reward`, `done`,
`metrics` and `info`. This file imports neither library; it was written for brax 0.14.2.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Float, Int, PRNGKeyArray

from cuelearner_jax.environment import UNKNOWN_UNIT, Described, Quantity
from cuelearner_jax.errors import UserError
from cuelearner_jax.spaces import Box, Cue, Space, box
from cuelearner_jax.types import Action, Observation, Step

PRIVILEGED = "privileged_state"  # Playground's entry of an observation for critics
Heuristic = Callable[[Observation], Action]


class SimulatorState(struct.PyTreeNode):
    """State of a `JaxEnvironment` between steps."""

    state: Any  # the simulator's state
    steps: Int[Array, ""]  # taken in this episode
    total: Float[Array, ""]  # rewards of this episode


class JaxEnvironment(Described, struct.PyTreeNode):
    """A simulator as one of our environments (`cuelearner_jax.environment.Environment`).

    The simulator is a constant of what is compiled, `max_steps` is traced. The other fields, all that policies look
    at, do not need the simulator.
    """

    max_steps: Int[Array, ""]  # an episode is truncated after this many
    # makes the simulator; equal makers share compiled programs
    simulator: Callable[[], Any] = struct.field(pytree_node=False)
    observation: tuple[Quantity, ...] = struct.field(pytree_node=False)
    actions: Space = struct.field(pytree_node=False)
    heuristic: Heuristic | None = struct.field(pytree_node=False, default=None)
    privileged: int = struct.field(pytree_node=False, default=0)

    def reset(self, key: PRNGKeyArray) -> tuple[SimulatorState, Observation]:
        """Start an episode."""
        state = jax.tree.map(jnp.asarray, self.simulator().reset(jax.random.key_data(key)))
        return SimulatorState(state, jnp.zeros((), jnp.int32), jnp.zeros(())), flat(state.obs)

    def step(self, key: PRNGKeyArray, state: SimulatorState, action: Action) -> tuple[SimulatorState, Step]:
        """Step the simulator, then reset it if that was the end. `key` is the reset's: simulators' steps take none."""
        before = jax.tree.map(lambda leaf: leaf, state.state)  # simulators write into their input dictionaries
        result = jax.tree.map(jnp.asarray, self.simulator().step(before, action))
        reward = result.reward.astype(jnp.float32)
        after = SimulatorState(result, state.steps + 1, state.total + reward)
        stopped = jnp.asarray(after.state.info.get("truncation", 0)) > 0
        terminated = (after.state.done > 0) & ~stopped
        truncated = (stopped | (after.steps >= self.max_steps)) & ~terminated
        fresh, fresh_obs = self.reset(key)
        final_obs, ended = flat(after.state.obs), terminated | truncated
        obs, outcome = jnp.where(ended, fresh_obs, final_obs), {"return": after.total}
        metrics = {name: jnp.asarray(value, jnp.float32) for name, value in after.state.metrics.items()}
        step = Step(obs, final_obs, self.remember(after, final_obs), reward, terminated, truncated, metrics, outcome)
        return jax.tree.map(partial(jnp.where, ended), fresh, after), step

    def remember(self, state: SimulatorState, obs: Observation) -> Float[Array, " memory"]:
        """Return the observation, and what critics alone see."""
        return jnp.concatenate([obs, flat(state.state.obs[PRIVILEGED])]) if self.privileged else obs

    def recall(self, memory: Float[Array, " memory"]) -> Observation:
        """Return the observation."""
        return memory[: self.obs_size]

    def recall_next(self, memory: Array, action: Action, aftermath: Float[Array, " memory"]) -> Observation:
        """Return the next observation."""
        return aftermath[: self.obs_size]


class FixedSimulator(NamedTuple):
    """A maker that returns the caller's simulator; two makers of one simulator are equal."""

    simulator: Any

    def __call__(self) -> Any:
        return self.simulator


class Interface(NamedTuple):
    """The names and sizes of a simulator's observations and actions, as policies need them."""

    observation: tuple[Quantity, ...]
    entries: tuple[str, ...]  # names of an action's entries
    privileged: int = 0  # numbers that critics alone see

    def box(self, cues: Sequence[Cue] = ()) -> Box:
        """Return the space [-1, 1]^n of the actions, with a cue an entry: `cues`, or the entry's name."""
        size = len(self.entries)
        return Box((-1.0,) * size, (1.0,) * size, tuple(cues) or box.plain_cues(self.entries))


def layout_of(simulator: Any, name: str) -> Interface:
    """Return the layout of a simulator without compiling. `name`: the simulator's, for messages."""
    shapes = jax.eval_shape(simulator.reset, jax.random.key_data(jax.random.key(0)))
    if shapes.reward.shape:
        raise UserError(f"{name}: it is a batch of shape {shapes.reward.shape}: give a single environment")
    if "first_obs" in shapes.info:
        raise UserError(f"{name}: AutoResetWrapper hides the last observation of an episode: pass what it wraps")
    leaves = jax.tree_util.tree_leaves_with_path(_without_privileged(shapes.obs))
    slices = [("/".join(str(part.key) for part in path) or name.lower(), leaf.shape) for path, leaf in leaves]
    for part, shape in slices:
        if len(shape) > 1 or part.startswith("pixels"):
            raise UserError(f"{name}: the observation {part!r} is an image {shape}: give numbers (n,), as its state")
    observation = tuple(Quantity(part, math.prod(shape), UNKNOWN_UNIT) for part, shape in slices)
    entries, whole = _entries_of(simulator, int(simulator.action_size)), jax.tree.leaves(shapes.obs)
    privileged = sum(math.prod(leaf.shape) for leaf in whole) - sum(part.size for part in observation)
    return Interface(observation, entries, privileged)


def flat(obs: Array | Mapping[str, Any]) -> Observation:
    """Return an observation as one vector; the slices of a dictionary stand in the order of their names."""
    leaves = [jnp.ravel(leaf).astype(jnp.float32) for leaf in jax.tree.leaves(_without_privileged(obs))]
    return leaves[0] if len(leaves) == 1 else jnp.concatenate(leaves)


def _without_privileged(obs: Any) -> Any:
    """Return an observation without what critics alone see, since a real robot lacks it."""
    return {name: part for name, part in obs.items() if name != PRIVILEGED} if isinstance(obs, Mapping) else obs


def model_of(simulator: Any) -> Any:
    """Return a simulator's MuJoCo model (`mujoco.MjModel`); None if there is none."""
    return getattr(simulator, "mj_model", None) or getattr(getattr(simulator, "sys", None), "mj_model", None)


def _entries_of(simulator: Any, size: int) -> tuple[str, ...]:
    """Return a name for each entry of an action: of the MuJoCo model's actuator or its joint, else its number."""
    model, names = model_of(simulator), []
    if model is not None and model.nu == size:
        joints = [int(model.actuator_trnid[index, 0]) for index in range(size)]
        names = [model.actuator(i).name or (model.joint(joints[i]).name if joints[i] >= 0 else "") for i in range(size)]
    if names and all(names) and len(set(names)) == size:
        return tuple(names)
    return tuple(f"entry {number}" for number in range(1, size + 1))


def from_brax(
    env: Any, max_steps: int = 1000, heuristic: Heuristic | None = None, *, cues: Sequence[Cue] = ()
) -> JaxEnvironment:
    """Return an environment of brax or MuJoCo Playground as one of ours, with its whole box [-1, 1]^n of actions.

    `env` becomes a constant of what is compiled, `max_steps` is traced. Observations in a dictionary become one vector,
    with a slice for each entry of the dictionary, in the order of their names. Critics alone see `privileged_state`.

    Args:
        env: bare, or in brax's `EpisodeWrapper`, whose truncations are then truncations here.
        max_steps: an episode is truncated after this many steps.
        heuristic: observation -> the obvious action. Without this the guidance "heuristic" is refused.
        cues: one an entry of the box (default: the entry's name in the model, else its number, "more" and "less").
    """
    layout, steps = layout_of(env, type(getattr(env, "unwrapped", env)).__name__), jnp.array(max_steps, jnp.int32)
    observation, actions = layout.observation, layout.box(cues)
    return JaxEnvironment(steps, FixedSimulator(env), observation, actions, heuristic, layout.privileged)
