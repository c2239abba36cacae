"""The agent of one lane: what it keeps of a step, its batches, and its gradient steps (double DQN)."""

from __future__ import annotations

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from cuelearner_jax.actions import Actions
from cuelearner_jax.agents import ddqn, view
from cuelearner_jax.agents.choice import fresh_params, greedy_actions, values
from cuelearner_jax.agents.replay import RingBuffer, ring_buffer
from cuelearner_jax.config import AgentScalars, AgentSizes, Schedule
from cuelearner_jax.environment import Environment, actions_of, random_symmetries, spaces_of
from cuelearner_jax.types import AgentState, Clock, Params, Step, StoredStep, Transition


class Learner(NamedTuple):
    """Pure functions of one agent, made by `learner`."""

    sizes: AgentSizes
    bootstraps: bool  # do targets look at the next observation?
    actions: Actions
    buffer: RingBuffer

    def optimizer(self, scalars: AgentScalars) -> optax.GradientTransformation:
        """The optimiser of the action values."""
        return ddqn.optimizer(self.sizes.optimizer, scalars.learning_rate, scalars.max_grad_norm)

    def init(self, env: Environment, k_params: PRNGKeyArray, k_env: PRNGKeyArray) -> AgentState:
        """A fresh agent at the start of its environments' first episodes."""
        params = fresh_params(self.sizes, spaces_of(env), k_params)
        env_state, obs = jax.vmap(env.reset)(jax.random.split(k_env, self.sizes.num_envs))
        return AgentState(
            params=params,
            target_params=jax.tree.map(jnp.copy, params) if self.bootstraps else None,
            opt_state=self.optimizer(AgentScalars()).init(params),
            replay=self.buffer.empty(self.sizes.replay_capacity),
            env=env_state,
            obs=obs,
            guided=jnp.zeros(self.sizes.num_envs, bool),
        )

    def greedy(self, env: Environment, agent: AgentState) -> Float[Array, "num_envs action"]:
        """The greedy choice in each of its environments."""
        return greedy_actions(self.sizes, self.actions, env, agent.params, agent.obs)

    def learn(
        self,
        env: Environment,
        scalars: AgentScalars,
        schedule: Schedule,
        clock: Clock,
        agent: AgentState,
        key: PRNGKeyArray,
    ) -> tuple[AgentState, Float[Array, ""], Bool[Array, ""]]:
        """As many gradient steps as environment steps were just made (times `updates_per_step`).

        Returns:
            The agent; the mean loss; were all losses and gradients finite?
        """
        steps = self.sizes.num_envs * self.sizes.updates_per_step
        filled = clock.step + self.sizes.num_envs
        optimizer, q = self.optimizer(scalars), values(self.sizes, env)

        def update(carry: tuple, index: jax.Array) -> tuple[tuple, tuple[jax.Array, jax.Array]]:
            params, target_params, opt_state = carry
            k_sample, k_mirror = jax.random.split(jax.random.fold_in(key, index))
            numbers = self.buffer.draw(k_sample, agent.replay, filled, self.sizes.batch_size)
            batches = [self.one_step(env, self.buffer.read(agent.replay, numbers))]
            if self.sizes.n_step > 1:
                batches.append(self.n_step(env, agent.replay, filled, numbers, scalars))
            batches = [mirrored(k_mirror, env, batch) for batch in batches]
            targets = self.targets(env, params, target_params, batches, scalars)
            batch = batches[0]
            loss, gradient = jax.value_and_grad(lambda p: ddqn.loss(q, p, batch, targets))(params)
            change, opt_state = optimizer.update(gradient, opt_state, params)
            params = optax.apply_updates(params, change)
            if self.bootstraps:
                target_params = jax.lax.cond(
                    (clock.update + index + 1) % schedule.target_every == 0,
                    lambda: ddqn.polyak(params, target_params, scalars.polyak),
                    lambda: target_params,
                )
            return (params, target_params, opt_state), (loss, optax.tree.norm(gradient))

        start = (agent.params, agent.target_params, agent.opt_state)
        (params, target_params, opt_state), (losses, norms) = jax.lax.scan(update, start, jnp.arange(steps))
        agent = agent.replace(params=params, target_params=target_params, opt_state=opt_state)
        return agent, losses.mean(), all_finite((losses, norms))

    def one_step(self, env: Environment, stored: StoredStep) -> Transition:
        """Stored steps (batch, ...) as transitions, their observations rebuilt."""
        if self.bootstraps:
            next_obs = jax.vmap(env.recall_next)(stored.obs, stored.action, stored.aftermath)
            discount = stored.discount[:, 0]
        else:
            next_obs, discount = jnp.zeros((stored.reward.shape[0], 0)), jnp.zeros_like(stored.reward)
        return Transition(jax.vmap(env.recall)(stored.obs), stored.action, stored.reward, discount, next_obs)

    def n_step(
        self,
        env: Environment,
        rows: Float[Array, "capacity width"],
        filled: Int[Array, ""],
        numbers: Int[Array, " batch"],
        scalars: AgentScalars,
    ) -> Transition:
        """The transitions that begin at rows `numbers` and span up to `n_step` steps of one episode."""
        after = self.buffer.follow(rows, filled, numbers, self.sizes.n_step, self.sizes.num_envs)
        summed = jax.vmap(partial(ddqn.n_step_return, discount=scalars.discount))
        reward, discount, last = summed(after.rewards, after.discounts, after.ended, after.known)
        first = self.buffer.read(rows, numbers)
        end = self.buffer.read(rows, jnp.mod(numbers + last * self.sizes.num_envs, rows.shape[0]))
        next_obs = jax.vmap(env.recall_next)(end.obs, end.action, end.aftermath)
        return Transition(jax.vmap(env.recall)(first.obs), first.action, reward, discount, next_obs)

    def targets(
        self,
        env: Environment,
        params: Params,
        target_params: Params,
        batches: list[Transition],
        scalars: AgentScalars,
    ) -> Float[Array, " batch"]:
        """What the values of a batch are fitted to: of one-step and, if there are, n-step transitions."""
        options = self.actions.spread(self.sizes.target_directions)
        q, chooser = values(self.sizes, env), values(self.sizes, env, jnp.dtype(self.sizes.target_dtype))

        def one(item: Transition) -> jax.Array:
            return ddqn.target(q, params, target_params, item, options, scalars.discount, chooser)

        # One pass through the networks for both: their weights are what has to be read.
        joined = jax.tree.map(lambda *leaves: jnp.concatenate(leaves), *batches)
        near, *far = jnp.split(jax.vmap(one)(joined), len(batches))
        return near + scalars.n_step_weight * (far[0] - near) if far else near


def all_finite(tree: Any) -> Bool[Array, ""]:
    """Is every number of a tree of arrays finite?"""
    numbers = [leaf for leaf in jax.tree.leaves(tree) if jnp.issubdtype(leaf.dtype, jnp.floating)]
    return jnp.stack([jnp.isfinite(leaf).all() for leaf in numbers] or [jnp.array(True)]).all()


def learner(sizes: AgentSizes, bootstraps: bool, env: Environment) -> Learner:
    """The agent for an environment, whose shapes alone are looked at.

    Raises UserError for a frame in which the environment cannot be seen.
    """
    actions = actions_of(env)
    view.widths(sizes.frame, spaces_of(env))

    def one_step(env: Environment, key: PRNGKeyArray) -> StoredStep:
        state, obs = env.reset(key)
        action = jnp.zeros(actions.size)
        return stored_step(env.remember(state, obs), action, env.step(key, state, action)[1], bootstraps)

    shapes = jax.eval_shape(one_step, env, jax.random.key(0))
    example = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), shapes)
    return Learner(sizes, bootstraps, actions, ring_buffer(example))


def stored_step(
    obs: Float[Array, " memory"], action: Float[Array, " action"], step: Step, bootstraps: bool
) -> StoredStep:
    """What replay keeps of one step from the remembered observation `obs`."""
    kept = slice(None) if bootstraps else slice(0)
    ended: Bool[Array, ""] = step.terminated | step.truncated
    return StoredStep(
        obs=obs,
        action=action,
        reward=step.reward,
        discount=1.0 - step.terminated[None].astype(jnp.float32)[kept],
        ended=ended[None].astype(jnp.float32)[kept],
        aftermath=step.aftermath[kept],
    )


def mirrored(key: PRNGKeyArray, env: Environment, batch: Transition) -> Transition:
    """Each transition of a batch under a random symmetry of the environment."""
    image = random_symmetries(key, env, batch.reward.shape[0])
    obs, action = image(batch.obs, batch.action)
    next_obs = image(batch.next_obs, batch.action)[0] if batch.next_obs.shape[-1] else batch.next_obs
    return batch.replace(obs=obs, action=action, next_obs=next_obs)
