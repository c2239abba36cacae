"""Double DQN over a finite set of actions. The action is an input of the network.

Source: van Hasselt, Guez, Silver, "Deep reinforcement learning with double Q-learning", Eq. 4.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Annotated, Any, ClassVar, Literal

import chex
import jax
import jax.numpy as jnp
import optax
from flax import struct
from jaxtyping import Array, Float, Int, PRNGKeyArray

from cuelearner_jax.agents.choice import best_near_peaks, best_of
from cuelearner_jax.agents.networks import as_function, network_inputs, q_network, widen_layers, widths
from cuelearner_jax.agents.replay import Memory, Transition
from cuelearner_jax.config import POSITIVE, SHARE, TRACED, Bounds, Frame, Layers, Scalars, Sizes, Start, part
from cuelearner_jax.environment import Spaces
from cuelearner_jax.errors import UserError
from cuelearner_jax.spaces import DIRECTIONS
from cuelearner_jax.types import Actions, Number, Observations, Params

ALIGNED = 64  # layers computed in bfloat16 are filled up to multiples: 20% faster on an H200, whose rows want alignment


@part
class DDQNConfig:
    """Options of double DQN."""

    NAME: ClassVar[str] = "ddqn"
    ABOUT: ClassVar[str] = "double DQN over an evenly spaced set of actions"

    q_layers: Layers = (400, 400, 400, 300, 300, 300)
    """Hidden layers of the action-value network."""
    q_start: Start = "xavier"
    """Initial weights of the action-value network: xavier, biases zero; torch, as PyTorch's layers start: weights and
    biases uniform within 1 / sqrt(inputs), as in the paper's public code."""
    directions: Annotated[int, POSITIVE] = 3600
    """Directions over which the agent takes its argmax (3600: every 0.1 deg)."""
    coarse_directions: Annotated[int, Bounds(0)] = 0
    """Directions of a first look while learning, evenly spaced; the argmax over the set is then taken near its peaks
    (0: over all of the set, as every finished policy takes it)."""
    coarse_dtype: Literal["float32", "bfloat16"] = "float32"
    """Arithmetic of the first look (bfloat16 is twice as fast on an accelerator); the choice is made in float32."""
    peaks: Annotated[int, POSITIVE] = 8
    """Peaks of the first look that are looked at closely."""
    exploration: Annotated[float, SHARE] = 0.0
    """Probability that an action while learning is one of the set by chance (epsilon-greedy)."""
    target_directions: Annotated[int, POSITIVE] = 720
    """Directions of the argmax inside bootstrapped targets (unused at discount 0)."""
    batch_size: Annotated[int, POSITIVE] = 100
    """Transitions in a gradient step."""
    replay_capacity: Annotated[int, POSITIVE] = 10_000_000
    """Transitions kept (a multiple of num_envs)."""
    optimizer: Literal["sgd", "adam"] = "sgd"
    """Optimiser of the action-value network."""
    learning_rate: Annotated[float, Bounds(0)] = 0.1
    """Step size of the action-value network."""
    n_step: Annotated[int, POSITIVE] = 1
    """Steps of the n-step return that is averaged with the one-step return (1: the one-step return alone)."""
    n_step_weight: Annotated[float, SHARE] = 0.5
    """Share of the n-step return in a target; the rest is the one-step return."""
    polyak: Annotated[float, SHARE] = 0.005
    """Rate at which the target network follows."""
    target_every: Annotated[int, POSITIVE, TRACED] = 2
    """Gradient steps between two moves of the target network."""

    def make(self, frame: Frame, spaces: Spaces, bootstraps: bool = False) -> DoubleDQN:
        """Return the agent for an environment's spaces."""
        if self.coarse_directions and spaces.actions != DIRECTIONS:
            raise UserError(f"agent.coarse_directions is for directions alone, not for {spaces.actions.name}: give 0")
        widths(frame, spaces)
        return DoubleDQN(self, frame, spaces, bootstraps)

    def check(self, sizes: Sizes, bootstraps: bool) -> None:
        """Raise UserError for options that do not work together."""
        if self.coarse_directions and (self.coarse_directions < 3 or self.directions % self.coarse_directions):
            advice = f"give a divisor of agent.directions ({self.directions}) above 2, or 0 to value all of them"
            raise UserError(f"agent.coarse_directions is {self.coarse_directions}: {advice}")
        if self.coarse_directions and self.peaks > self.coarse_directions:
            raise UserError(f"agent.peaks is {self.peaks}: give at most agent.coarse_directions")
        if self.n_step * sizes.num_envs > self.replay_capacity:
            raise UserError(
                f"agent.n_step is {self.n_step}: give at most {self.replay_capacity // sizes.num_envs}, the steps of "
                "an environment that agent.replay_capacity holds"
            )
        if self.n_step > 1 and not bootstraps:
            raise UserError(f"agent.n_step is {self.n_step}: n-step returns need a scalars.discount above 0")


class DDQNState(struct.PyTreeNode):
    """The learning state of double DQN beside its parameters."""

    target_params: Params  # None where nothing bootstraps (discount 0)
    opt_state: Any


@dataclass(frozen=True)
class DoubleDQN:
    """The agent's functions (`protocol.AgentFunctions`)."""

    options: DDQNConfig
    frame: Frame
    spaces: Spaces
    bootstraps: bool  # whether targets use the next observation (discount above 0)

    def init(self, key: PRNGKeyArray) -> tuple[Params, DDQNState]:
        """Return random parameters, and a target network that is a copy of them."""
        network = q_network(self.options.q_layers).clone(start=self.options.q_start)
        params = network.init(key, *map(jnp.zeros, widths(self.frame, self.spaces)))
        copy = jax.tree.map(jnp.copy, params) if self.bootstraps else None
        return params, DDQNState(copy, optimizer(self.options.optimizer, 0.0, 0.0).init(params))

    def act(self, env: Any, params: Params, obs: Observations, key: PRNGKeyArray) -> Actions:
        """Return the action of the whole set with the largest value.

        The rough first look (`coarse_directions`) is for play while learning alone: where values are sharp it misses
        peaks, which costs a finished agent reward (docs/scaling.md).
        """
        return best_of(partial(self.value, env, params), self._directions, obs)

    def explore(self, env: Any, options: DDQNConfig, params: Params, obs: Observations, key: PRNGKeyArray) -> Actions:
        """Return the greedy action, searched near peaks where the options say so, or one of the set by chance."""
        k_explore, k_choice = jax.random.split(key)
        by_chance = jax.random.choice(k_choice, self._directions, (len(obs),))
        explores = jax.random.bernoulli(k_explore, options.exploration, (len(obs), 1))
        return jnp.where(explores, by_chance, self._greedy(env, params, obs, key))

    def _greedy(self, env: Any, params: Params, obs: Observations, key: PRNGKeyArray) -> Actions:
        own = self.options
        if not own.coarse_directions:
            return self.act(env, params, obs, key)
        rough, layers = params, own.q_layers
        if own.coarse_dtype == "bfloat16":
            rough, layers = widen_layers(params, layers, ALIGNED)
        look = as_function(q_network(layers, jnp.dtype(own.coarse_dtype)))
        return best_near_peaks(
            partial(self.value, env, params),
            lambda one, actions: look(rough, *network_inputs(self.frame, self.spaces.actions, env, one, actions))[:, 0],
            self._directions,
            obs,
            own.coarse_directions,
            own.peaks,
        )

    def value(
        self, env: Any, params: Params, obs: Float[Array, "*n obs"], actions: Float[Array, "*m action"]
    ) -> Float[Array, "*m"]:
        """Return Q of each action; `obs` is one situation for all actions, or one for each."""
        network = as_function(q_network(self.options.q_layers))
        return network(params, *network_inputs(self.frame, self.spaces.actions, env, obs, actions))[..., 0]

    def update(
        self,
        env: Any,
        options: DDQNConfig,
        scalars: Scalars,
        count: Int[Array, ""],
        params: Params,
        rest: DDQNState,
        memory: Memory,
        key: PRNGKeyArray,
    ) -> tuple[Params, DDQNState, Float[Array, ""], Float[Array, ""]]:
        """Make one gradient step (`protocol.AgentFunctions.update`)."""
        own, target_params = self.options, rest.target_params
        batches = memory.batches(key, own.batch_size, own.n_step, scalars.discount)
        batch = batches[0]
        targets = self.targets(env, options, scalars.discount, params, target_params, batches)

        def loss_of(params: Params) -> Float[Array, ""]:
            return loss(self.value(env, params, batch.obs, batch.action), targets)

        value, gradient = jax.value_and_grad(loss_of)(params)
        descent = optimizer(own.optimizer, options.learning_rate, scalars.max_grad_norm)
        change, opt_state = descent.update(gradient, rest.opt_state, params)
        params = optax.apply_updates(params, change)
        if self.bootstraps:
            target_params = jax.lax.cond(
                count % options.target_every == 0,
                lambda: optax.incremental_update(params, target_params, options.polyak),
                lambda: target_params,
            )
        return params, DDQNState(target_params, opt_state), value, optax.tree.norm(gradient)

    def targets(
        self,
        env: Any,
        options: DDQNConfig,
        discount: Number,
        params: Params,
        target_params: Params,
        batches: list[Transition],
    ) -> Float[Array, " batch"]:
        """Return the regression targets of a batch: of its one-step and, if given, n-step transitions."""
        if not self.bootstraps:
            return batches[0].reward
        actions = self.spaces.actions.spread(self.options.target_directions)

        def one(item: Transition) -> Float[Array, ""]:
            # The online network chooses, the target network values.
            choice = actions[jnp.argmax(self.value(env, params, item.next_obs, actions))]
            return target(item.reward, discount * item.discount, self.value(env, target_params, item.next_obs, choice))

        # One pass through the networks for both kinds of return: their weights are what has to be read.
        joined = jax.tree.map(lambda *leaves: jnp.concatenate(leaves), *batches)
        near, *far = jnp.split(jax.vmap(one)(joined), len(batches))
        return near + options.n_step_weight * (far[0] - near) if far else near

    @property
    def _directions(self) -> Float[Array, "m action"]:
        return self.spaces.actions.spread(self.options.directions)


def target(reward: Float[Array, ""], discount: Number, next_value: Float[Array, ""]) -> Float[Array, ""]:
    """Return r + discount * Q'(s', argmax_a Q(s', a)); `discount` is 0 after a termination."""
    chex.assert_rank([reward, discount, next_value], 0)
    return reward + discount * next_value


def loss(values: Float[Array, " batch"], targets: Float[Array, " batch"]) -> Float[Array, ""]:
    """Return the mean squared error of the values of the actions taken."""
    chex.assert_rank([values, targets], 1)
    return jnp.mean(jnp.square(values - targets))


def optimizer(name: Literal["sgd", "adam"], learning_rate: Number, max_norm: Number) -> optax.GradientTransformation:
    """Return SGD or Adam after clipping gradients to a global norm. Both scalars may be traced."""
    maker = {"sgd": optax.sgd, "adam": optax.adam}[name]
    return optax.chain(optax.clip_by_global_norm(max_norm), maker(learning_rate))
