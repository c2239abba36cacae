"""Soft actor-critic (SAC) in a box: a squashed Gaussian actor and any number of critics.

Source: Haarnoja et al., "Soft actor-critic algorithms and applications", 2018, with the temperature tuned (Eq. 18).
More critics, of which each target takes a random subset: Chen et al., "Randomized ensembled double Q-learning", ICLR
2021. Layer normalisation, and as many guided as own steps in a minibatch: Ball et al., "Efficient online reinforcement
learning with offline data" (RLPD), ICML 2023. Critics over bins of value: `categorical`.

Networks see actions in unit coordinates: -1 is each entry's lower bound, 1 its upper bound.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Annotated, Any, ClassVar, NamedTuple

import flax.linen as nn
import jax
import jax.numpy as jnp
import optax
from flax import struct
from jaxtyping import Array, Float, Int, PRNGKeyArray

from cuelearner_jax.agents import categorical
from cuelearner_jax.agents.categorical import CategoricalCritic
from cuelearner_jax.agents.ddqn import optimizer
from cuelearner_jax.agents.networks import next_moments, normalised, q_network
from cuelearner_jax.agents.replay import Memory, Transition
from cuelearner_jax.config import POSITIVE, SHARE, Bounds, Frame, Layers, Scalars, Sizes, part
from cuelearner_jax.environment import Spaces
from cuelearner_jax.errors import UserError
from cuelearner_jax.spaces import Box
from cuelearner_jax.types import Actions, Number, Observations, Params

LOG_STD = (-20.0, 2.0)  # bounds of the logarithm of the Gaussian's standard deviation


@part
class SACConfig:
    """Options of soft actor-critic."""

    NAME: ClassVar[str] = "sac"
    ABOUT: ClassVar[str] = "soft actor-critic in a box, with any number of critics"
    SORTS: ClassVar[bool] = True

    actor_layers: Layers = (256, 256)
    """Hidden layers of the actor."""
    critic_layers: Layers = (256, 256)
    """Hidden layers of each critic."""
    critics: Annotated[int, POSITIVE] = 2
    """Number of critics."""
    target_critics: Annotated[int, POSITIVE] = 2
    """Critics drawn for each target, of whose values the smallest counts. With more critics than that the actor climbs
    their mean, else their smallest value."""
    layer_norm: bool = False
    """Normalise the critics' hidden layers, which keeps the values of untried actions from growing."""
    bins: bool = False
    """Critics of XQC: a distribution over bins of value, by batch and weight normalisation and cross-entropy."""
    normalise_obs: bool = False
    """Networks see observations less their mean, over their standard deviation, as minibatches so far have them."""
    batch_size: Annotated[int, POSITIVE] = 256
    """Transitions in a minibatch."""
    updates_per_step: Annotated[int, POSITIVE] = 1
    """Minibatches for the critics after each environment step; actor and temperature learn from the last one."""
    replay_capacity: Annotated[int, POSITIVE] = 1_000_000
    """Transitions kept (a multiple of num_envs)."""
    guided_share: Annotated[float, SHARE] = 0.5
    """Share of guided steps in a minibatch, once there are any; the rest are the agent's own."""
    actor_rate: Annotated[float, Bounds(0)] = 3e-4
    """Adam's step size of the actor."""
    critic_rate: Annotated[float, Bounds(0)] = 3e-4
    """Adam's step size of the critics."""
    temperature_rate: Annotated[float, Bounds(0)] = 3e-4
    """Adam's step size of the temperature's logarithm (0: the temperature stays)."""
    first_temperature: Annotated[float, Bounds(0, above=True)] = 1.0
    """Temperature at first: what a nat of entropy is worth, in units of reward."""
    target_entropy: float = -1.0
    """Entropy that the temperature is tuned to, for each entry of an action, in unit coordinates [nats]."""
    entropy_in_targets: bool = True
    """Include the entropy of the next action in targets."""
    polyak: Annotated[float, SHARE] = 0.005
    """Rate at which the target critics follow."""

    def make(self, frame: Frame, spaces: Spaces, bootstraps: bool = False) -> SoftActorCritic:
        """Return the agent for an environment's spaces."""
        if not isinstance(spaces.actions, Box):
            advice = "give --agent ddqn, which serves any space"
            raise UserError(f"agent 'sac' acts in boxes, not in {spaces.actions.name}: {advice}")
        if frame != "raw":
            advice = "give --sizes.frame raw"
            raise UserError(f"sizes.frame is {frame!r}, but the actor of 'sac' has no action as input: {advice}")
        return SoftActorCritic(self, frame, spaces, bootstraps)

    def check(self, sizes: Sizes, bootstraps: bool) -> None:
        """Raise UserError for options that do not work together."""
        if self.target_critics > self.critics:
            raise UserError(f"agent.target_critics is {self.target_critics}: give up to agent.critics ({self.critics})")
        if self.bins and self.layer_norm:
            raise UserError("agent.bins normalises by batches already: give it without agent.layer_norm")


class Actor(nn.Module):
    """ReLU layers on an observation; Xavier-uniform weights, zero biases."""

    layers: Sequence[int]
    size: int

    @nn.compact
    def __call__(self, obs: Float[Array, "... obs"]) -> tuple[Float[Array, "... action"], Float[Array, "... action"]]:
        """Return mean and logarithm of the standard deviation of the Gaussian."""
        x = obs
        for width in self.layers:
            x = nn.relu(nn.Dense(width, kernel_init=nn.initializers.xavier_uniform())(x))
        mean, log_std = jnp.split(nn.Dense(2 * self.size, kernel_init=nn.initializers.xavier_uniform())(x), 2, -1)
        return mean, jnp.clip(log_std, *LOG_STD)


class ActionSample(NamedTuple):
    """Actions drawn from the squashed Gaussian."""

    unit: Actions  # in unit coordinates
    log_density: Float[Array, " n"]  # in unit coordinates


class SACState(struct.PyTreeNode):
    """The learning state of SAC beside its parameters."""

    target_critics: Params  # None where nothing bootstraps (discount 0)
    log_temperature: Float[Array, ""]  # logarithm of the temperature over `SACConfig.first_temperature`
    actor_opt: Any
    critics_opt: Any
    temperature_opt: Any


@dataclass(frozen=True)
class SoftActorCritic:
    """The functions of SAC (`protocol.AgentFunctions`).

    Parameters are a dictionary of `actor`, `critics` and, where observations are normalised, `obs`.
    """

    options: SACConfig
    frame: Frame
    spaces: Spaces
    bootstraps: bool  # whether targets use the next observation (discount above 0)

    def init(self, key: PRNGKeyArray) -> tuple[Params, SACState]:
        """Return random parameters, target critics that are copies, and the first temperature."""
        own, space = self.options, self.spaces.actions
        k_actor, k_critics = jax.random.split(key)
        obs, action = jnp.zeros(self._critic_inputs), jnp.zeros(space.size)
        actor = self._actor.init(k_actor, obs[: self.spaces.obs_size])
        first = self._critic.start if isinstance(self._critic, CategoricalCritic) else self._critic.init
        critics = jax.vmap(lambda k: first(k, obs, action))(jax.random.split(k_critics, own.critics))
        log_temperature = jnp.zeros(())
        opt_states = (optimizer("adam", 0.0, 0.0).init(leaf) for leaf in (actor, critics, log_temperature))
        copy = jax.tree.map(jnp.copy, critics) if self.bootstraps else None
        params: Params = {"actor": actor, "critics": critics}
        if own.normalise_obs:
            params["obs"] = {"mean": obs, "variance": jnp.ones_like(obs)}
        return params, SACState(copy, log_temperature, *opt_states)

    def act(self, env: Any, params: Params, obs: Observations, key: PRNGKeyArray) -> Actions:
        """Return the squashed mean of the Gaussian."""
        return self.in_box(jnp.tanh(self._gaussian(params["actor"], self._normalised(params, obs))[0]))

    def explore(self, env: Any, options: SACConfig, params: Params, obs: Observations, key: PRNGKeyArray) -> Actions:
        """Return actions drawn from the squashed Gaussian."""
        return self.in_box(self.draw(params["actor"], self._normalised(params, obs), key).unit)

    def in_unit(self, actions: Float[Array, "*n action"]) -> Float[Array, "*n action"]:
        """Return actions of the box in unit coordinates."""
        return self._box.even(actions)

    def in_box(self, unit: Float[Array, "*n action"]) -> Float[Array, "*n action"]:
        """Return actions in unit coordinates as actions of the box."""
        return self.spaces.actions.exp(self._box.middle(), unit / 2)

    def draw(self, actor: Params, obs: Observations, key: PRNGKeyArray) -> ActionSample:
        """Draw actions from the squashed Gaussian, with their log-densities; both have gradients."""
        mean, log_std = self._gaussian(actor, obs)
        noise = jax.random.normal(key, mean.shape)
        before = mean + jnp.exp(log_std) * noise
        return ActionSample(jnp.tanh(before), squashed_log_density(noise, log_std, before))

    def values(
        self, critics: Params, obs: Float[Array, "*n obs"], unit: Float[Array, "*m action"]
    ) -> Float[Array, "critics *m"]:
        """Return the values by each critic of actions in unit coordinates."""
        network = self._critic
        if isinstance(network, CategoricalCritic):
            return jax.vmap(network.values, (0, None, None))(critics, obs, unit)
        return jax.vmap(lambda critic: jnp.asarray(network.apply(critic, obs, unit))[..., 0])(critics)

    def update(
        self,
        env: Any,
        options: SACConfig,
        scalars: Scalars,
        count: Int[Array, ""],
        params: Params,
        rest: SACState,
        memory: Memory,
        key: PRNGKeyArray,
    ) -> tuple[Params, SACState, Float[Array, ""], Float[Array, ""]]:
        """Make as many critic steps as the options say, then one step of actor and temperature.

        See `protocol.AgentFunctions.update`. The loss is the critics'.
        """
        own, actor, most = self.options, params["actor"], scalars.max_grad_norm
        k_critics, k_actor = jax.random.split(key)
        temperature = options.first_temperature * jnp.exp(rest.log_temperature)

        def minibatch(carry: tuple[Any, ...], own_key: tuple[PRNGKeyArray, Array]) -> tuple[Any, Any]:
            (critics, opt_state, target_critics, moments, _), (key, number) = carry, own_key
            k_batch, k_target = jax.random.split(key)
            (batch,) = memory.batches(k_batch, own.batch_size, guided_share=options.guided_share)
            if batch.privileged is not None:  # from here on observations are those of critics
                pairs = zip((batch.obs, batch.next_obs), batch.privileged, strict=True)
                obs, next_obs = (jnp.concatenate(pair, -1) for pair in pairs)
                batch = batch.replace(obs=obs, next_obs=next_obs)
            if own.normalise_obs:
                moments = next_moments(moments, batch.obs, number)
                after = normalised(batch.next_obs, moments) if self.bootstraps else batch.next_obs
                batch = batch.replace(obs=normalised(batch.obs, moments), next_obs=after)
            behind = scalars.discount, actor, target_critics, temperature, batch, k_target
            if own.bins:
                error = self._binned_error(*behind, critics, number)
            else:
                targets, unit = self.targets(*behind)[None], self.in_unit(batch.action)
                error = lambda params: (jnp.mean((self.values(params, batch.obs, unit) - targets) ** 2), {})  # noqa: E731
            (loss, news), gradient = jax.value_and_grad(error, has_aux=True)(critics)
            critics, opt_state = optimizer_step(options.critic_rate, most, gradient, opt_state, critics)
            critics = categorical.with_unit_weights({**critics, **news}) if own.bins else critics
            if self.bootstraps:
                target_critics = optax.incremental_update(critics, target_critics, options.polyak)
            return (critics, opt_state, target_critics, moments, batch.obs), (loss, optax.tree.norm(gradient))

        none = jnp.zeros((own.batch_size, self._critic_inputs))
        start = params["critics"], rest.critics_opt, rest.target_critics, params.get("obs"), none
        keys = jax.random.split(k_critics, own.updates_per_step)
        numbers = (count - 1) * own.updates_per_step + 1 + jnp.arange(own.updates_per_step)
        last, (losses, norms) = jax.lax.scan(minibatch, start, (keys, numbers))
        critics, critics_opt, target_critics, moments, obs = last

        def actor_loss(actor: Params) -> tuple[Array, Array]:
            draws = self.draw(actor, obs, k_actor)
            values = self.values(critics, obs, draws.unit)
            value = values.mean(0) if own.critics > own.target_critics else values.min(0)
            return (temperature * draws.log_density - value).mean(), draws.log_density.mean()

        (_, log_density), gradient = jax.value_and_grad(actor_loss, has_aux=True)(actor)
        actor, actor_opt = optimizer_step(options.actor_rate, most, gradient, rest.actor_opt, actor)
        surplus = -log_density - options.target_entropy * self.spaces.actions.size
        log_temperature, temperature_opt = optimizer_step(
            options.temperature_rate, most, temperature * surplus, rest.temperature_opt, rest.log_temperature
        )
        state = SACState(target_critics, log_temperature, actor_opt, critics_opt, temperature_opt)
        norm = jnp.maximum(norms.max(), optax.tree.norm(gradient))
        params = {**params, "actor": actor, "critics": critics} | ({} if moments is None else {"obs": moments})
        return params, state, losses.mean(), norm

    def targets(
        self,
        discount: Number,
        actor: Params,
        target_critics: Params,
        temperature: Number,
        batch: Transition,
        key: PRNGKeyArray,
    ) -> Float[Array, " batch"]:
        """Return the critics' targets of a batch: r + discount * (Q'(s', a') - temperature * log p(a')).

        Q' is the smallest value of the target critics drawn for this batch, a' the actor's draw.
        """
        if not self.bootstraps:
            return batch.reward
        k_act, k_critics = jax.random.split(key)
        draws, judges = self.draw(actor, batch.next_obs, k_act), self._judges(target_critics, k_critics)
        own = self.values(judges, batch.next_obs, draws.unit).min(0)
        value = own - temperature * draws.log_density if self.options.entropy_in_targets else own
        return jax.lax.stop_gradient(batch.reward + discount * batch.discount * value)

    def _binned_error(
        self,
        discount: Array | float,
        actor: Params,
        target_critics: Params,
        temperature: Array | float,
        batch: Transition,
        key: PRNGKeyArray,
        before: Params,
        count: Int[Array, ""],
    ) -> Callable[[Params], tuple[Array, dict[str, Any]]]:
        """Return the critics' cross-entropy as a function of them, with what else of them changes.

        The target is the distribution of the next value by the target critic that expects least, normalised as the
        critics are: by one batch of steps and next steps.
        """
        network, obs, unit = self._critic, batch.obs, self.in_unit(batch.action)
        assert isinstance(network, CategoricalCritic)
        size = categorical.next_unit(before["unit"], batch.reward, discount, count)
        atoms, weights = batch.reward[:, None], jnp.ones((len(batch.reward), 1))
        if self.bootstraps:
            k_act, k_critics = jax.random.split(key)
            draws, judges = self.draw(actor, batch.next_obs, k_act), self._judges(target_critics, k_critics)
            obs, unit = jnp.concatenate([obs, batch.next_obs]), jnp.concatenate([unit, draws.unit])
            logits = jax.vmap(network.by_batch, (0, None, None))(judges, obs, unit)[0][:, len(batch.reward) :]
            least = (jax.nn.softmax(logits) @ categorical.BINS).argmin(0)
            weights = jax.nn.softmax(jnp.take_along_axis(logits, least[None, :, None], 0)[0])
            future = jnp.broadcast_to(categorical.BINS * judges["unit"][0], weights.shape)
            future = future - temperature * draws.log_density[:, None] * self.options.entropy_in_targets
            atoms = atoms + discount * batch.discount[:, None] * future
        target = categorical.project(atoms / size[0], weights)
        obs, unit, target = jax.lax.stop_gradient((obs, unit, target))

        def error(critics: Params) -> tuple[Array, dict[str, Any]]:
            losses, statistics = jax.vmap(network.loss, (0, None, None, None))(critics, obs, unit, target)
            return losses.mean(), {"batch_stats": statistics, "unit": size}

        return error

    def _judges(self, target_critics: Params, key: PRNGKeyArray) -> Params:
        """Return the target critics of one batch, a random subset where the options ask for fewer."""
        own = self.options
        if own.target_critics == own.critics:
            return target_critics
        subset = jax.random.permutation(key, own.critics)[: own.target_critics]
        return jax.tree.map(lambda leaf: leaf[subset], target_critics)

    def _gaussian(self, actor: Params, obs: Observations) -> tuple[Array, Array]:
        mean, log_std = self._actor.apply(actor, obs[..., : self.spaces.obs_size])
        return jnp.asarray(mean), jnp.asarray(log_std)

    def _normalised(self, params: Params, obs: Observations) -> Observations:
        return normalised(obs, jax.tree.map(lambda leaf: leaf[: self.spaces.obs_size], params.get("obs")))

    @property
    def _critic_inputs(self) -> int:
        return self.spaces.obs_size + self.spaces.privileged

    @property
    def _actor(self) -> Actor:
        return Actor(self.options.actor_layers, self.spaces.actions.size)

    @property
    def _critic(self) -> nn.Module:
        if self.options.bins:
            return CategoricalCritic(self.options.critic_layers)
        return q_network(self.options.critic_layers, layer_norm=self.options.layer_norm)

    @property
    def _box(self) -> Box:
        assert isinstance(self.spaces.actions, Box)
        return self.spaces.actions


def squashed_log_density(
    noise: Float[Array, "n action"], log_std: Float[Array, "n action"], before: Float[Array, "n action"]
) -> Float[Array, " n"]:
    """Return log p(tanh(u)) of u = mean + std * noise, independent entries (Haarnoja et al., appendix C).

    `noise` is standard normal, `log_std` the logarithm of std, and `before` is u. log(1 - tanh(u)^2) is written as
    2 (log 2 - u - softplus(-2 u)), which is finite for any u.
    """
    normal = -0.5 * (noise**2 + math.log(2 * math.pi)) - log_std
    squashed = 2 * (math.log(2) - before - jax.nn.softplus(-2 * before))
    return jnp.sum(normal - squashed, -1)


def optimizer_step(rate: Number, max_norm: Number, gradient: Any, opt_state: Any, params: Any) -> tuple[Any, Any]:
    """Return parameters and Adam's state after a step whose gradient is clipped to a norm."""
    change, opt_state = optimizer("adam", rate, max_norm).update(gradient, opt_state, params)
    return optax.apply_updates(params, change), opt_state
