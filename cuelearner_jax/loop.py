"""The training loop of every guidance: policy -> guidance.act -> environment -> replay -> update.

`Lane` has three pure functions: `act` chooses actions, `absorb` stores their results, `learn` makes the gradient steps.
`iterate` runs all three with a JAX environment between the first two; any other environment can be stepped there.

The code is written for one lane (one seed with one label budget); `runs.program` maps it over lanes. Random numbers
come from the lane's own key folded with the shared counters, so a lane's result does not depend on the other lanes. On
a CPU the result is the same bit by bit, on an accelerator up to the order in which matrix products are summed.
"""

from __future__ import annotations

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from cuelearner_jax import asking
from cuelearner_jax.agents.networks import all_finite
from cuelearner_jax.agents.protocol import AgentFunctions, AgentOptions
from cuelearner_jax.agents.replay import Memory, RingBuffer, buffer_for, count_guided, stored_step
from cuelearner_jax.arbiters import Arbiter, Outcome
from cuelearner_jax.asking import GuideState, Stream, label_slots
from cuelearner_jax.config import Scalars, Schedule, Sizes, static
from cuelearner_jax.environment import Environment, actions_of, spaces_of
from cuelearner_jax.guides.base import Guide
from cuelearner_jax.guides.refining import Refinement, no_refinement
from cuelearner_jax.policies import asked_from
from cuelearner_jax.run_config import RunConfig, Settings
from cuelearner_jax.types import EnvState, Label, Params, Step, Teacher

Parts = tuple[AgentOptions, Arbiter, bool]  # options with None for floats; whether targets bootstrap


class AgentState(struct.PyTreeNode):
    """The agent's part of a lane: parameters, learning state, replay and environments."""

    params: Params  # parameters that act
    training: Any  # learning state beside them, such as a target network and the optimiser's state
    replay: Float[Array, "capacity width"]
    env: EnvState  # leading axis: num_envs
    obs: Float[Array, "num_envs obs"]
    guided: Int[Array, "capacity 1"] | None = None  # guided steps up to each row of replay, where the agent asks


class TrainState(struct.PyTreeNode):
    """The whole state of one lane: one seed with one label budget."""

    agent: AgentState
    guide: GuideState
    arbiter: Any  # in which environments the guide's action is executed; see `arbiters`
    key: PRNGKeyArray
    # True once a loss, gradient or parameter was not finite; the lane then keeps its last finite state
    failed: Bool[Array, ""]


class Clock(struct.PyTreeNode):
    """Counters shared by all lanes; they are never vmapped, so that branches on them stay branches."""

    step: Int[Array, ""]  # environment steps of each lane
    update: Int[Array, ""]  # gradient steps of each lane
    round: Int[Array, ""]  # label rounds of each lane


def start_clock() -> Clock:
    """Return the clock with all counters at zero."""
    return Clock(jnp.zeros((), jnp.int32), jnp.zeros((), jnp.int32), jnp.zeros((), jnp.int32))


class Keys(NamedTuple):
    """Random keys of one iteration, by consumer; they are derived together, which takes an accelerator microseconds."""

    act: PRNGKeyArray
    step: PRNGKeyArray  # the environments
    absorb: PRNGKeyArray  # the arbiter
    learn: PRNGKeyArray


class ActStep(NamedTuple):
    """The actions that `Lane.act` chose, to be executed and then given to `Lane.absorb`."""

    actions: Float[Array, "num_envs action"]
    passes: Int[Array, " num_envs"]  # number of guidance passes that moved each action
    remembered: Float[Array, "num_envs memory"]  # what replay stores of the observations that were acted on


class Lane(NamedTuple):
    """The training loop of one lane."""

    sizes: Sizes
    guidance: Guide
    learner: AgentFunctions
    arbiter: Arbiter  # with None for floats
    buffer: RingBuffer
    bootstraps: bool  # whether targets use the next observation (discount above 0)
    largest_budget: int

    @property
    def stores(self) -> bool:
        """Whether labelled steps are kept for the agent to learn from."""
        return self.sizes.store_labelled and self.guidance.asks

    def init(self, env: Environment, key: PRNGKeyArray, budget: Int[Array, ""] | int) -> TrainState:
        """Return a new lane. Budgets do not affect the random numbers: lanes of one seed start alike."""
        k_agent, k_guidance, k_ask, k_env = jax.random.split(jax.random.fold_in(key, Stream.INIT), 4)
        slots = label_slots(self.largest_budget, self.sizes)
        params, training = self.learner.init(k_agent)
        env_state, obs = jax.vmap(env.reset)(jax.random.split(k_env, self.sizes.num_envs))
        capacity = self.learner.options.replay_capacity
        # Guided steps are counted for an agent that draws them separately, under a guide that acts.
        counts = getattr(self.learner.options, "SORTS", False) and self.guidance.moves and not self.stores
        guided = jnp.zeros((capacity, 1), jnp.int32) if counts else None
        guide = asking.start(self.guidance, env, slots, budget, k_guidance, k_ask, self.sizes)
        return TrainState(
            agent=AgentState(params, training, self.buffer.empty(capacity), env_state, obs, guided),
            guide=guide.replace(stored=self.buffer.empty(slots)) if self.stores else guide,
            arbiter=self.arbiter.init(self.sizes.num_envs),
            key=key,
            failed=jnp.array(False),
        )

    def label_round(self, env: Environment, teacher: Teacher, scalars: Scalars, state: TrainState) -> TrainState:
        """Ask a simulated teacher one round of questions (see `asking.label_round`); `state` may lack its agent."""
        base = asked_from(env, self.sizes)
        of = asking.Inquiry(self.guidance, env, scalars, base, pack=self._pack if self.stores else None)
        return asking.with_guide(state, asking.label_round(of, self.sizes, teacher, state.guide, state.key))

    def _pack(self, remembered: Array, actions: Array, step: Step) -> Float[Array, "n width"]:
        """Return steps (n, ...) as rows of replay."""
        return self.buffer.pack(jax.vmap(partial(stored_step, bootstraps=self.bootstraps))(remembered, actions, step))

    def take_labels(self, env: Environment, scalars: Scalars, labels: Label, state: TrainState) -> TrainState:
        """Return the lane with given labels in place of questions, and a model fitted to them."""
        guide = state.guide.replace(labels=labels, asked=state.guide.budget)
        return asking.with_guide(state, asking.fit(self.guidance, env, scalars, guide, state.key))

    def keep_finite(self, state: TrainState, before: TrainState) -> TrainState:
        """Return a lane after a stretch; a lane that has failed keeps the parameters of `before`.

        This is checked once a stretch, since a check at each gradient step would read all parameters again.
        """
        learned_state = lambda lane: (lane.agent.params, lane.agent.training)  # noqa: E731
        failed = state.failed | ~all_finite(learned_state(state))
        keep = lambda new, old: jnp.where(failed, old, new)  # noqa: E731
        params, training = jax.tree.map(keep, learned_state(state), learned_state(before))
        return state.replace(agent=state.agent.replace(params=params, training=training), failed=failed)

    def advance(self, clock: Clock, schedule: Schedule) -> Clock:
        """Return the clock after one iteration."""
        steps, updates = self.sizes.num_envs, self.sizes.gradient_steps or self.sizes.num_envs
        updates = jnp.where(clock.step + steps >= schedule.learn_after, updates, 0)
        return clock.replace(step=clock.step + steps, update=clock.update + updates)

    def keys(self, clock: Clock, state: TrainState) -> Keys:
        """Return the keys of one iteration."""
        return Keys(*jax.random.split(jax.random.fold_in(jax.random.fold_in(state.key, Stream.TRAIN), clock.step), 4))

    def iterate(
        self, env: Environment, settings: Settings, clock: Clock, state: TrainState
    ) -> tuple[TrainState, dict[str, Float[Array, ""]]]:
        """Make one step in each of the lane's environments, then gradient steps."""
        keys = self.keys(clock, state)
        acted = self.act(env, settings, clock, state, keys.act)
        k_envs = jax.random.split(keys.step, self.sizes.num_envs)
        env_state, step = jax.vmap(env.step)(k_envs, state.agent.env, acted.actions)
        state, step_metrics = self.absorb(settings, clock, state, keys.absorb, acted, step)
        state = state.replace(agent=state.agent.replace(env=env_state))
        state, learn_metrics = self.learn(env, settings, clock, state, keys.learn)
        return state, {**step_metrics, **learn_metrics}

    def act(self, env: Environment, settings: Settings, clock: Clock, state: TrainState, key: PRNGKeyArray) -> ActStep:
        """Return the actions to execute in each environment.

        Uniform at first, then the agent's; refined by the guidance until the cut-off, where the arbiter says so. The
        branches depend on the shared clock alone, so they stay branches under vmap.
        """
        agent, schedule = state.agent, settings.schedule
        base = jax.lax.cond(
            clock.step < schedule.random_steps,
            lambda: actions_of(env).sample(key, (self.sizes.num_envs,)),
            lambda: self.learner.explore(env, settings.agent, agent.params, agent.obs, key),
        )
        guided = settings.arbiter.guided(state.arbiter)
        refined: Refinement = jax.lax.cond(
            guides(clock, schedule),
            lambda: self.guidance.act(state.guide.model, env, agent.obs, base, guided, settings.scalars),
            lambda: no_refinement(base),
        )
        return ActStep(refined.actions, refined.passes, jax.vmap(env.remember)(agent.env, agent.obs))

    def absorb(
        self, settings: Settings, clock: Clock, state: TrainState, key: PRNGKeyArray, acted: ActStep, step: Step
    ) -> tuple[TrainState, dict[str, Float[Array, ""]]]:
        """Return the lane after its actions were executed: steps are in replay, and the next observations are set.

        `step` (num_envs, ...) is the result of the actions. The caller keeps the environments' states.
        """
        agent, done = state.agent, step.terminated | step.truncated
        outcome = Outcome(step.reward, done, guides(clock, settings.schedule), self.bootstraps)
        arbiter = settings.arbiter.follow(state.arbiter, outcome, settings.scalars, key)
        stored = jax.vmap(partial(stored_step, bootstraps=self.bootstraps))(acted.remembered, acted.actions, step)
        agent = agent.replace(replay=self.buffer.add(agent.replay, clock.step, stored), obs=step.obs)
        if agent.guided is not None:
            agent = agent.replace(guided=count_guided(agent.guided, clock.step, acted.passes > 0))
        passes = acted.passes.astype(jnp.float32)
        guided = (passes > 0).astype(jnp.float32)
        metrics = {"reward": step.reward.mean(), "passes": passes.mean(), "guided_share": guided.mean()}
        return state.replace(agent=agent, arbiter=arbiter), metrics

    def learn(
        self, env: Environment, settings: Settings, clock: Clock, state: TrainState, key: PRNGKeyArray
    ) -> tuple[TrainState, dict[str, Float[Array, ""]]]:
        """Make gradient steps, once replay holds enough."""
        filled, agent, schedule = clock.step + self.sizes.num_envs, state.agent, settings.schedule
        memory = Memory(env, self.buffer, agent.replay, filled, self.sizes.num_envs, self.bootstraps, agent.guided)
        if (stored := state.guide.stored) is not None:
            memory = memory._replace(labelled=Memory(env, self.buffer, stored, state.guide.asked, 1, self.bootstraps))

        def update(carry: tuple[Any, Any], index: Array) -> tuple[tuple[Any, Any], Any]:
            count, own = clock.update + index + 1, jax.random.fold_in(key, index)
            params, training, loss, norm = self.learner.update(
                env, settings.agent, settings.scalars, count, *carry, memory, own
            )
            return (params, training), (loss, norm)

        def updates() -> tuple[tuple[Any, Any], Array, Array]:
            indices = jnp.arange(self.sizes.gradient_steps or self.sizes.num_envs)
            carry, (losses, norms) = jax.lax.scan(update, (agent.params, agent.training), indices)
            return carry, losses.mean(), all_finite((losses, norms))

        (params, training), loss, finite = jax.lax.cond(
            filled >= schedule.learn_after,
            updates,
            lambda: ((agent.params, agent.training), jnp.zeros(()), jnp.array(True)),
        )
        agent = agent.replace(params=params, training=training)
        return state.replace(agent=agent, failed=state.failed | ~finite), {"loss": loss}


def guides(clock: Clock, schedule: Schedule) -> Bool[Array, ""]:
    """Return whether guidance is active: after the random steps and before the cut-off."""
    return (clock.step >= schedule.random_steps) & (clock.step < schedule.guidance_until)


def parts_of(config: RunConfig) -> Parts:
    """Return the parts of a configuration that shape a lane."""
    return static(config.agent), static(config.arbiter), config.bootstraps


def lane_of(sizes: Sizes, parts: Parts, guidance: Guide, largest_budget: int, env: Environment) -> Lane:
    """Return the loop of one lane for parts whose float options are None; of the environment only shapes are used."""
    agent, arbiter, bootstraps = parts
    learner = agent.make(sizes.frame, spaces_of(env), bootstraps)
    return Lane(sizes, guidance, learner, arbiter, buffer_for(env, bootstraps), bootstraps, largest_budget)
