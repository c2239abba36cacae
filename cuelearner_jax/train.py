"""The one training loop, whatever the guidance: policy -> guidance.act -> environment -> replay -> update.

Written for one lane (one seed with one label budget); `vmap` over lanes happens once, in `make_program`. Random numbers
come from the lane's own key folded with the shared counters, so a lane's result does not depend on its neighbours.
"""

from __future__ import annotations

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax
from jax.sharding import Mesh
from jaxtyping import Array, Int, PRNGKeyArray

from cuelearner_jax import actions as geometry
from cuelearner_jax.agent import ddqn
from cuelearner_jax.agent.choice import greedy_actions
from cuelearner_jax.agent.networks import applied, q_network
from cuelearner_jax.agent.replay import RingBuffer, ring_buffer
from cuelearner_jax.config import RunConfig, Scalars, Schedule, Sizes
from cuelearner_jax.devices import BY_LANE, SHARED, compiler_options, each_lane, lane_mesh, over_lanes
from cuelearner_jax.environment import Environment, random_symmetries
from cuelearner_jax.guidance.feedback import empty_labels
from cuelearner_jax.guidance.refining import Refined, untouched
from cuelearner_jax.types import Asking, Clock, Guidance, Label, Memory, Params, Step, Teacher, TrainState, Transition

# Streams of random numbers of one lane, each folded into the lane's key before a counter is.
INIT, ASK, FIT, TRAIN = range(4)


class Program(NamedTuple):
    """Jitted functions over a block of lanes (leading axis of `state`). They donate the state they are given.

    The clock is not donated: blocks share it.
    """

    init: Any  # (env, seeds (lanes,), budgets (lanes,), root key) -> TrainState
    label_round: Any  # (env, teacher, scalars, clock, state) -> (clock, state)
    take_labels: Any  # (env, scalars, labels (lanes, slots, ...), state) -> state: labels that were given elsewhere
    train: Any  # (env, scalars, schedule, clock, state, iterations) -> (clock, state, metrics (lanes,))


def start_clock() -> Clock:
    """All counters at zero."""
    return Clock(jnp.zeros((), jnp.int32), jnp.zeros((), jnp.int32), jnp.zeros((), jnp.int32))


def label_slots(budget: int, sizes: Sizes) -> int:
    """Rows that a label set needs: the budget rounded up to whole rounds."""
    return -(-budget // sizes.labels_per_round) * sizes.labels_per_round


def make_program(
    config: RunConfig,
    guidance: Guidance,
    env: Environment,
    largest_budget: int,
    mesh: Mesh | None = None,
    lanes: int = 1,
) -> Program:
    """Compiles (on first use) the loop for one kind of guidance.

    Args:
        config: sizes and whether targets bootstrap are taken from here; scalars and schedule are passed at each call.
        env: gives shapes; any environment of the same structure may be passed at the calls.
        largest_budget: labels that the largest lane may use.
        mesh: devices that share the lanes, whose number they must divide into (default: the first device alone).
        lanes: that each device is expected to take at once; how fast it is may hang on it, nothing else.
    """
    mesh = mesh or lane_mesh(jax.local_devices()[:1])
    lane = Lane(config.sizes, guidance, config.bootstraps, env.obs_size, largest_budget)

    def init(env, seeds, budgets, root):
        keys = jax.vmap(lambda seed: jax.random.fold_in(root, seed))(seeds)
        return each_lane(partial(lane.init, env))(keys, budgets)

    def label_round(env, teacher, scalars, clock, state):
        state = each_lane(partial(lane.label_round, env, teacher, scalars, clock))(state)
        return clock.replace(round=clock.round + 1), state

    def take_labels(env, scalars, labels, state):
        return each_lane(partial(lane.take_labels, env, scalars))(labels, state)

    def train(env, scalars, schedule, clock, state, iterations):
        def run(state):
            def iteration(carry, _):
                clock, state = carry
                state, metrics = lane.iterate(env, scalars, schedule, clock, state)
                return (lane.advance(clock, schedule), state), metrics

            (after, state), metrics = jax.lax.scan(iteration, (clock, state), length=iterations)
            return after, state, jax.tree.map(lambda leaf: leaf.mean(0), metrics)

        return each_lane(run, gives=(None, 0, 0))(state)

    def stretch(env, scalars, schedule, clock, state, iterations):
        whole = over_lanes(
            mesh, partial(train, iterations=iterations), (*(SHARED,) * 4, BY_LANE), (SHARED, BY_LANE, BY_LANE)
        )
        return whole(env, scalars, schedule, clock, state)

    init = over_lanes(mesh, init, (SHARED, BY_LANE, BY_LANE, SHARED), BY_LANE)
    label_round = over_lanes(mesh, label_round, (*(SHARED,) * 4, BY_LANE), (SHARED, BY_LANE))
    take_labels = over_lanes(mesh, take_labels, (SHARED, SHARED, BY_LANE, BY_LANE), BY_LANE)
    return Program(
        init=jax.jit(init),
        label_round=jax.jit(label_round, donate_argnums=4),
        take_labels=jax.jit(take_labels, donate_argnums=3),
        train=jax.jit(
            stretch, donate_argnames="state", static_argnames="iterations", compiler_options=compiler_options(lanes)
        ),
    )


class Lane(NamedTuple):
    """The loop of one lane."""

    sizes: Sizes
    guidance: Guidance
    bootstraps: bool
    obs_size: int
    largest_budget: int

    def buffer(self, env: Environment) -> RingBuffer:
        """The replay of an environment's steps."""

        def one_step(key: PRNGKeyArray) -> Memory:
            state, obs = env.reset(key)
            action = jnp.zeros(2)
            return self.memory(env.remember(state, obs), action, env.step(key, state, action)[1])

        shapes = jax.eval_shape(one_step, jax.random.key(0))
        return ring_buffer(jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), shapes))

    def memory(self, obs: jax.Array, action: jax.Array, step: Step) -> Memory:
        """What replay keeps of one step from the remembered observation `obs`."""
        kept = slice(None) if self.bootstraps else slice(0)
        return Memory(
            obs=obs,
            action=action,
            reward=step.reward,
            discount=1.0 - step.terminated[None].astype(jnp.float32)[kept],
            ended=(step.terminated | step.truncated)[None].astype(jnp.float32)[kept],
            aftermath=step.aftermath[kept],
        )

    def q(self, params: Any, obs: jax.Array, actions: jax.Array) -> jax.Array:
        """Action values (..., 1)."""
        return applied(q_network(self.sizes.q_layers))(params, obs, actions)

    def init(self, env: Environment, key: PRNGKeyArray, budget: Int[Array, ""]) -> TrainState:
        """A fresh lane. Budgets do not touch the random numbers: lanes of one seed start alike."""
        k_q, k_guidance, k_ask, k_env = jax.random.split(jax.random.fold_in(key, INIT), 4)
        params = q_network(self.sizes.q_layers).init(k_q, jnp.zeros(self.obs_size), jnp.zeros(2))
        asking_env, asking_obs = env.reset(k_ask)
        env_state, obs = jax.vmap(env.reset)(jax.random.split(k_env, self.sizes.num_envs))
        labels = empty_labels(label_slots(self.largest_budget, self.sizes), self.obs_size)
        return TrainState(
            params=params,
            target_params=jax.tree.map(jnp.copy, params) if self.bootstraps else None,
            opt_state=self.optimizer(Scalars()).init(params),
            replay=self.buffer(env).empty(self.sizes.replay_capacity),
            guidance=self.guidance.init(k_guidance),
            asking=Asking(asking_env, asking_obs, labels, jnp.asarray(budget, jnp.int32)),
            env=env_state,
            obs=obs,
            guided=jnp.zeros(self.sizes.num_envs, bool),
            key=key,
        )

    def optimizer(self, scalars: Scalars) -> optax.GradientTransformation:
        """The optimiser of the action values."""
        return ddqn.optimizer(self.sizes.optimizer, scalars.learning_rate, scalars.max_grad_norm)

    def label_round(
        self, env: Environment, teacher: Teacher, scalars: Scalars, clock: Clock, state: TrainState
    ) -> TrainState:
        """Asks for one round of labels, about refined actions once a model exists (DAgger), and fits from scratch."""

        def ask(asking: Asking, offset: jax.Array) -> tuple[Asking, None]:
            position = clock.round * self.sizes.labels_per_round + offset
            key = jax.random.fold_in(jax.random.fold_in(state.key, ASK), position)
            k_base, k_refine, k_answer, k_env = jax.random.split(key, 4)
            base = geometry.uniform(k_base)
            refine = jax.random.bernoulli(k_refine, scalars.refined_fraction)
            action, _ = self.guidance.act(state.guidance, env, asking.obs[None], base[None], refine[None], scalars)
            best = teacher.best_action(asking.env, asking.obs)
            target, answered = self.guidance.label(k_answer, action[0], best, scalars)
            label = Label(asking.obs, action[0], target, answered & (position < asking.budget))
            labels = jax.tree.map(
                lambda rows, row: jax.lax.dynamic_update_index_in_dim(rows, row, position, 0), asking.labels, label
            )
            env_state, step = env.step(k_env, asking.env, action[0])
            return asking.replace(env=env_state, obs=step.obs, labels=labels), None

        asked, _ = jax.lax.scan(ask, state.asking, jnp.arange(self.sizes.labels_per_round))
        k_fit = jax.random.fold_in(jax.random.fold_in(state.key, FIT), clock.round)
        model = self.guidance.fit(k_fit, env, asked.labels, scalars)
        # A lane whose budget is spent stays as it is while others go on.
        going = clock.round * self.sizes.labels_per_round < state.asking.budget
        return jax.tree.map(
            lambda new, old: jnp.where(going, new, old), state.replace(asking=asked, guidance=model), state
        )

    def take_labels(self, env: Environment, scalars: Scalars, labels: Label, state: TrainState) -> TrainState:
        """Labels that were given elsewhere, in place of questions, and the model fitted to them."""
        model = self.guidance.fit(jax.random.fold_in(state.key, FIT), env, labels, scalars)
        return state.replace(asking=state.asking.replace(labels=labels), guidance=model)

    def advance(self, clock: Clock, schedule: Schedule) -> Clock:
        """The clock after one iteration."""
        steps = self.sizes.num_envs
        updates = jnp.where(clock.step + steps >= schedule.learn_after, steps * self.sizes.updates_per_step, 0)
        return clock.replace(step=clock.step + steps, update=clock.update + updates)

    def iterate(
        self, env: Environment, scalars: Scalars, schedule: Schedule, clock: Clock, state: TrainState
    ) -> tuple[TrainState, dict[str, jax.Array]]:
        """One step in each of the lane's environments, then as many gradient steps."""
        key = jax.random.fold_in(jax.random.fold_in(state.key, TRAIN), clock.step)
        k_act, k_env, k_guided, k_learn = jax.random.split(key, 4)
        action, passes = self.act(env, scalars, schedule, clock, state, k_act)
        remembered = jax.vmap(env.remember)(state.env, state.obs)
        env_state, step = jax.vmap(env.step)(jax.random.split(k_env, self.sizes.num_envs), state.env, action)
        done = step.terminated | step.truncated
        redrawn = jax.random.bernoulli(k_guided, scalars.guided_probability, done.shape)
        state = state.replace(
            replay=self.buffer(env).add(state.replay, clock.step, jax.vmap(self.memory)(remembered, action, step)),
            env=env_state,
            obs=step.obs,
            guided=jnp.where(done, redrawn, state.guided),
        )
        state, loss = jax.lax.cond(
            clock.step + self.sizes.num_envs >= schedule.learn_after,
            lambda state: self.learn(env, scalars, schedule, clock, state, k_learn),
            lambda state: (state, jnp.zeros(())),
            state,
        )
        return state, {"reward": step.reward.mean(), "loss": loss, "passes": passes.astype(jnp.float32).mean()}

    def act(
        self, env: Environment, scalars: Scalars, schedule: Schedule, clock: Clock, state: TrainState, key: PRNGKeyArray
    ) -> Refined:
        """Directions to execute (num_envs, 2), and how often guidance moved each.

        Uniform at first, then greedy; in guided episodes refined by the guidance until the cut-off. The branches hang
        on the shared clock alone, so they stay branches under vmap.
        """
        base = jax.lax.cond(
            clock.step < schedule.random_steps,
            lambda: geometry.uniform(key, (self.sizes.num_envs,)),
            lambda: greedy_actions(self.sizes, state.params, state.obs),
        )
        guides = (clock.step >= schedule.random_steps) & (clock.step < schedule.guidance_until)
        return jax.lax.cond(
            guides,
            lambda: self.guidance.act(state.guidance, env, state.obs, base, state.guided, scalars),
            lambda: untouched(base),
        )

    def learn(
        self, env: Environment, scalars: Scalars, schedule: Schedule, clock: Clock, state: TrainState, key: PRNGKeyArray
    ) -> tuple[TrainState, jax.Array]:
        """One gradient step for each of the environment steps just made (times `updates_per_step`)."""
        steps = self.sizes.num_envs * self.sizes.updates_per_step
        filled = clock.step + self.sizes.num_envs
        buffer = self.buffer(env)
        optimizer = self.optimizer(scalars)

        def update(carry: tuple, index: jax.Array) -> tuple[tuple, jax.Array]:
            params, target_params, opt_state = carry
            k_sample, k_mirror = jax.random.split(jax.random.fold_in(key, index))
            numbers = buffer.draw(k_sample, state.replay, filled, self.sizes.batch_size)
            batches = [self.one_step(env, buffer.read(state.replay, numbers))]
            if self.sizes.n_step > 1:
                batches.append(self.n_step(env, buffer, state.replay, filled, numbers, scalars))
            batches = [mirrored(k_mirror, env, batch) for batch in batches]
            targets = self.targets(params, target_params, batches, scalars)
            batch = batches[0]
            loss, gradient = jax.value_and_grad(lambda p: ddqn.loss(self.q, p, batch, targets))(params)
            change, opt_state = optimizer.update(gradient, opt_state, params)
            params = optax.apply_updates(params, change)
            if self.bootstraps:
                target_params = jax.lax.cond(
                    (clock.update + index + 1) % schedule.target_every == 0,
                    lambda: ddqn.polyak(params, target_params, scalars.polyak),
                    lambda: target_params,
                )
            return (params, target_params, opt_state), loss

        start = (state.params, state.target_params, state.opt_state)
        (params, target_params, opt_state), losses = jax.lax.scan(update, start, jnp.arange(steps))
        return state.replace(params=params, target_params=target_params, opt_state=opt_state), losses.mean()

    def one_step(self, env: Environment, memory: Memory) -> Transition:
        """Remembered steps (batch, ...) as transitions, their observations rebuilt."""
        if self.bootstraps:
            next_obs = jax.vmap(env.recall_next)(memory.obs, memory.action, memory.aftermath)
            discount = memory.discount[:, 0]
        else:
            next_obs, discount = jnp.zeros((memory.reward.shape[0], 0)), jnp.zeros_like(memory.reward)
        return Transition(jax.vmap(env.recall)(memory.obs), memory.action, memory.reward, discount, next_obs)

    def n_step(
        self,
        env: Environment,
        buffer: RingBuffer,
        rows: jax.Array,
        filled: Int[Array, ""],
        numbers: Int[Array, " batch"],
        scalars: Scalars,
    ) -> Transition:
        """The transitions that begin at rows `numbers` and span up to `n_step` steps of one episode."""
        after = buffer.follow(rows, filled, numbers, self.sizes.n_step, self.sizes.num_envs)
        summed = jax.vmap(partial(ddqn.n_step_return, discount=scalars.discount))
        reward, discount, last = summed(after.rewards, after.discounts, after.ended, after.known)
        first = buffer.read(rows, numbers)
        end = buffer.read(rows, jnp.mod(numbers + last * self.sizes.num_envs, rows.shape[0]))
        next_obs = jax.vmap(env.recall_next)(end.obs, end.action, end.aftermath)
        return Transition(jax.vmap(env.recall)(first.obs), first.action, reward, discount, next_obs)

    def targets(self, params: Params, target_params: Params, batches: list[Transition], scalars: Scalars) -> jax.Array:
        """What the values of a batch are fitted to (batch,): of one-step and, if there are, n-step transitions."""
        options = geometry.evenly_spaced(self.sizes.target_directions)
        chooser = applied(q_network(self.sizes.q_layers, self.sizes.target_dtype))

        def one(item: Transition) -> jax.Array:
            return ddqn.target(self.q, params, target_params, item, options, scalars.discount, chooser)

        # One pass through the networks for both: their weights are what has to be read.
        joined = jax.tree.map(lambda *leaves: jnp.concatenate(leaves), *batches)
        near, *far = jnp.split(jax.vmap(one)(joined), len(batches))
        return near + scalars.n_step_weight * (far[0] - near) if far else near


def mirrored(key: PRNGKeyArray, env: Environment, batch: Transition) -> Transition:
    """Each transition under a random symmetry of the environment."""
    image = random_symmetries(key, env, batch.reward.shape[0])
    obs, action = image(batch.obs, batch.action)
    next_obs = image(batch.next_obs, batch.action)[0] if batch.next_obs.shape[-1] else batch.next_obs
    return batch.replace(obs=obs, action=action, next_obs=next_obs)
