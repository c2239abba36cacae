"""An agent of one's own in one file: soft Q-learning, whose network has one output for each of a set of actions.

Run in the folder above this one, with any task:

    cuelearner sweep examples.reach:TASK --agent examples.soft_agent:Config --agent.temperature 0.05 --out runs/soft

Source: Haarnoja, Tang, Abbeel, Levine, "Reinforcement learning with deep energy-based policies", ICML 2017.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Any, ClassVar

import flax.linen as nn
import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array

from cuelearner_jax.agents.ddqn import optimizer
from cuelearner_jax.agents.replay import Memory
from cuelearner_jax.config import POSITIVE, SHARE, Bounds, Frame, Layers, Scalars, Sizes, part
from cuelearner_jax.environment import Spaces
from cuelearner_jax.errors import UserError
from cuelearner_jax.types import Params


@part
class Config:
    """Options of soft Q-learning: `--agent.temperature 0.05`. Another float compiles nothing."""

    NAME: ClassVar[str] = "soft"
    ABOUT: ClassVar[str] = "soft Q-learning over a set of actions"

    layers: Layers = (64, 64)
    """Hidden layers of the network of action values."""
    actions: Annotated[int, POSITIVE] = 36
    """Actions to choose from, evenly spaced."""
    temperature: Annotated[float, Bounds(0, above=True)] = 0.1
    """Difference of value at which a learning agent takes one action e times as often as another."""
    batch_size: Annotated[int, POSITIVE] = 64
    """Transitions in a gradient step."""
    replay_capacity: Annotated[int, POSITIVE] = 20_000
    """Transitions kept (a multiple of num_envs)."""
    learning_rate: Annotated[float, Bounds(0)] = 0.003
    """Step size of Adam."""
    polyak: Annotated[float, SHARE] = 0.05
    """Rate at which the target network follows."""

    def make(self, frame: Frame, spaces: Spaces, bootstraps: bool = False) -> SoftQ:
        """Return the agent for an environment's spaces. Raises UserError for observations seen from the action."""
        if frame != "raw":
            raise UserError(f"sizes.frame is {frame!r}, but agent 'soft' sees no actions: give --sizes.frame raw")
        return SoftQ(self, frame, spaces, bootstraps)

    def check(self, sizes: Sizes, bootstraps: bool) -> None:
        """Accept all options that are within their bounds."""


@dataclass(frozen=True)
class SoftQ:
    """The agent's functions, as `cuelearner_jax.agents.protocol` describes them."""

    options: Config
    frame: Frame
    spaces: Spaces
    bootstraps: bool

    @property
    def choices(self) -> Array:
        """The actions (choices, action) to choose from."""
        return self.spaces.actions.spread(self.options.actions)

    @property
    def network(self) -> nn.Sequential:
        """The network: observations (..., obs) -> values (..., choices)."""
        hidden = [layer for width in self.options.layers for layer in (nn.Dense(width), nn.relu)]
        return nn.Sequential([*hidden, nn.Dense(len(self.choices))])

    def init(self, key: Array) -> tuple[Params, Any]:
        """Return random parameters; beside them the target network, their copy, and the state of Adam."""
        params = self.network.init(key, jnp.zeros(self.spaces.obs_size))
        return params, (jax.tree.map(jnp.copy, params), optimizer("adam", 0.0, 0.0).init(params))

    def values(self, params: Params, obs: Array) -> Array:
        """Return the value of every choice (..., choices)."""
        return jnp.asarray(self.network.apply(params, obs))

    def act(self, env: Any, params: Params, obs: Array, key: Array) -> Array:
        """Return the choices of the largest value."""
        return self.choices[jnp.argmax(self.values(params, obs), -1)]

    def explore(self, env: Any, options: Config, params: Params, obs: Array, key: Array) -> Array:
        """Draw choices, those of larger value more often (Boltzmann)."""
        return self.choices[jax.random.categorical(key, self.values(params, obs) / options.temperature)]

    def value(self, env: Any, params: Params, obs: Array, actions: Array) -> Array:
        """Return the value of the choice that is nearest to each action."""
        nearest = jnp.argmin(jax.vmap(lambda one: self.spaces.actions.distance(actions, one))(self.choices), 0)
        values = self.values(params, obs)
        values = jnp.broadcast_to(values, (*nearest.shape, values.shape[-1]))
        return jnp.take_along_axis(values, nearest[..., None], -1)[..., 0]

    def update(
        self,
        env: Any,
        options: Config,
        scalars: Scalars,
        count: Array,
        params: Params,
        rest: Any,
        memory: Memory,
        key: Array,
    ) -> tuple[Params, Any, Array, Array]:
        """Take one gradient step toward the reward plus the discounted soft value of the next observation."""
        target_params, opt_state = rest
        (batch,) = memory.batches(key, self.options.batch_size)
        target = batch.reward
        if self.bootstraps:
            values, heat = self.values(target_params, batch.next_obs), options.temperature
            soft = heat * (jax.nn.logsumexp(values / heat, -1) - jnp.log(values.shape[-1]))
            target = target + scalars.discount * batch.discount * soft

        def loss_of(params: Params) -> Array:
            return jnp.mean((self.value(env, params, batch.obs, batch.action) - target) ** 2)

        loss, gradient = jax.value_and_grad(loss_of)(params)
        adam = optimizer("adam", options.learning_rate, scalars.max_grad_norm)
        change, opt_state = adam.update(gradient, opt_state, params)
        params = optax.apply_updates(params, change)
        rest = (optax.incremental_update(params, target_params, options.polyak), opt_state)
        return params, rest, loss, optax.tree.norm(gradient)
