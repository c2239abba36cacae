"""The one training loop, whatever the guidance: policy -> guidance.act -> environment -> replay -> update.

Written for one lane (one seed with one label budget); lanes are put side by side once, in `make_program`. Random
numbers come from the lane's own key folded with the shared counters, so a lane's result does not depend on its
neighbours: not by a bit on a CPU, on an accelerator up to the order in which sums of matrix products are taken.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache, partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax.sharding import Mesh
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from cuelearner_jax import asking
from cuelearner_jax.agents.learning import Learner, all_finite, learner, stored_step
from cuelearner_jax.arbiters import paced as pace
from cuelearner_jax.asking import label_slots
from cuelearner_jax.config import RunConfig, Scalars, Schedule, Sizes
from cuelearner_jax.devices import (
    BY_LANE,
    SHARED,
    compiler_options,
    each_lane,
    each_lane_in_place,
    lane_mesh,
    over_lanes,
)
from cuelearner_jax.environment import Environment
from cuelearner_jax.guides.base import Guide
from cuelearner_jax.guides.refining import Refined, untouched
from cuelearner_jax.policies import Agent, Uniform
from cuelearner_jax.types import Clock, GuideState, Label, Params, Stream, Teacher, TrainState

PROGRAMS_KEPT = 8  # compiled ones that a process holds for its next runs


class Program(NamedTuple):
    """Jitted functions over a block of lanes (leading axis of `state`). They donate the state they are given.

    The clock is not donated: blocks share it.
    """

    # (env, seeds (lanes,), budgets (lanes,), root key) -> state
    init: Callable[[Any, Array, Array, PRNGKeyArray], TrainState]
    # (env, teacher, scalars, clock, state, labels (lanes,) at which this instalment ends (default: the budgets),
    # own=True: about the agent's actions, not uniform ones) -> clock, state
    label_round: Callable[..., tuple[Clock, TrainState]]
    # (env, scalars, labels (lanes, slots, ...) that were given elsewhere, state) -> state
    take_labels: Callable[[Any, Scalars, Label, TrainState], TrainState]
    # (env, scalars, schedule, clock, state, iterations) -> clock, state, metrics (lanes,)
    train: Callable[[Any, Scalars, Schedule, Clock, TrainState, int], tuple[Clock, TrainState, dict[str, Array]]]


def start_clock() -> Clock:
    """All counters at zero."""
    return Clock(jnp.zeros((), jnp.int32), jnp.zeros((), jnp.int32), jnp.zeros((), jnp.int32))


def make_program(
    config: RunConfig,
    guidance: Guide,
    env: Environment,
    largest_budget: int,
    mesh: Mesh | None = None,
    lanes: int = 1,
) -> Program:
    """Compiles (on first use) the loop for one kind of guidance.

    Another run of the same sizes, guidance and shapes in this process is given the same program, compiled already.

    Args:
        config: sizes and whether targets bootstrap are taken from here; scalars and schedule are passed at each call.
        env: gives shapes; any environment of the same structure may be passed at the calls.
        largest_budget: labels that the largest lane may use.
        mesh: devices that share the lanes, whose number they must divide into (default: the first device alone).
        lanes: that each device is expected to take at once; how fast it is may hang on it, nothing else.
    """
    leaves, structure = jax.tree.flatten(jax.eval_shape(lambda env: env, env))
    lane = (config.sizes, config.bootstraps, config.noisy, guidance, largest_budget)
    return _program_of(*lane, structure, tuple(leaves), mesh or lane_mesh(jax.local_devices()[:1]), lanes)


@lru_cache(maxsize=PROGRAMS_KEPT)
def _program_of(
    sizes: Sizes,
    bootstraps: bool,
    noisy: bool,
    guidance: Guide,
    largest_budget: int,
    structure: Any,
    leaves: tuple[jax.ShapeDtypeStruct, ...],
    mesh: Mesh,
    lanes: int,
) -> Program:
    """The program of lanes in environments of this structure and these shapes."""
    lane = _lane_of(sizes, bootstraps, noisy, guidance, largest_budget, jax.tree.unflatten(structure, leaves))

    def init(env, seeds, budgets, root):
        keys = jax.vmap(lambda seed: jax.random.fold_in(root, seed))(seeds)
        return each_lane(partial(lane.init, env))(keys, budgets)

    def label_round(env, teacher, scalars, clock, state, until, own):
        rest, agent = state.replace(agent=None), state.agent  # which is large; of it questions need the network alone
        networks = (agent.params,) if own else ()
        asked = each_lane(partial(lane.label_round, env, teacher, scalars))(until, rest, *networks)
        return clock.replace(round=clock.round + 1), asked.replace(agent=agent)

    def one_round(env, teacher, scalars, clock, state, until=None, own=False):
        until = state.guide.budget if until is None else until
        whole = over_lanes(mesh, partial(label_round, own=own), (*(SHARED,) * 4, BY_LANE, BY_LANE), (SHARED, BY_LANE))
        return whole(env, teacher, scalars, clock, state, until)

    def take_labels(env, scalars, labels, state):
        rest, agent = state.replace(agent=None), state.agent
        return each_lane(partial(lane.take_labels, env, scalars))(labels, rest).replace(agent=agent)

    def train(env, scalars, schedule, clock, state, iterations):
        def run(state):
            def iteration(carry, _):
                clock, state = carry
                state, metrics = lane.iterate(env, scalars, schedule, clock, state)
                return (lane.advance(clock, schedule), state), metrics

            (after, trained), metrics = jax.lax.scan(iteration, (clock, state), length=iterations)
            return lane.kept_finite(trained, state), after, jax.tree.map(lambda leaf: leaf.mean(0), metrics)

        state, after, metrics = each_lane_in_place(run)(state)
        return after, state, metrics

    def stretch(env, scalars, schedule, clock, state, iterations):
        whole = over_lanes(
            mesh, partial(train, iterations=iterations), (*(SHARED,) * 4, BY_LANE), (SHARED, BY_LANE, BY_LANE)
        )
        return whole(env, scalars, schedule, clock, state)

    init = over_lanes(mesh, init, (SHARED, BY_LANE, BY_LANE, SHARED), BY_LANE)
    take_labels = over_lanes(mesh, take_labels, (SHARED, SHARED, BY_LANE, BY_LANE), BY_LANE)
    return Program(
        init=jax.jit(init),
        label_round=jax.jit(one_round, donate_argnames="state", static_argnames="own"),
        take_labels=jax.jit(take_labels, donate_argnums=3),
        train=jax.jit(
            stretch, donate_argnames="state", static_argnames="iterations", compiler_options=compiler_options(lanes)
        ),
    )


class Lane(NamedTuple):
    """The loop of one lane."""

    sizes: Sizes
    guidance: Guide
    learner: Learner
    largest_budget: int
    noisy: bool = False  # are actions turned at random?

    def init(
        self, env: Environment, key: PRNGKeyArray, budget: Int[Array, ""] | int, params: Params | None = None
    ) -> TrainState:
        """A fresh lane. Budgets do not touch the random numbers: lanes of one seed start alike.

        `params`: of a finished agent, to go on from (None: random ones).
        """
        k_q, k_guidance, k_ask, k_env = jax.random.split(jax.random.fold_in(key, Stream.INIT), 4)
        slots = label_slots(self.largest_budget, self.sizes)
        agent = self.learner.init(env, k_q, k_env)
        if params is not None:
            follows = None if agent.target_params is None else jax.tree.map(jnp.copy, params)
            agent = agent.replace(params=params, target_params=follows)
        return TrainState(
            agent=agent,
            guide=asking.start(self.guidance, env, slots, budget, k_guidance, k_ask, self.sizes),
            key=key,
            failed=jnp.array(False),
            pace=pace.start(self.sizes.num_envs) if self.sizes.pace else None,
        )

    def label_round(
        self,
        env: Environment,
        teacher: Teacher,
        scalars: Scalars,
        until: Int[Array, ""],
        state: TrainState,
        params: Params | None = None,
    ) -> TrainState:
        """One round of questions to a simulated teacher (see `asking.label_round`).

        Args:
            until: labels at which the instalment ends.
            state: the lane, its agent left out.
            params: the agent's, whose greedy actions are then asked about, refined within `ask_bound_deg`: local
                corrections. None: uniform actions are the base, refined as far as they lead.
        """
        base, bound = Uniform(self.learner.actions), None
        if params is not None:
            base = Agent(params, self.sizes, self.learner.actions, env)
            bound = self.learner.actions.from_unit(scalars.ask_bound_deg)
        guide = asking.label_round(
            self.guidance, self.sizes, env, teacher, scalars, base, state.guide, state.key, until, bound
        )
        return self.guided(state, guide)

    def take_labels(self, env: Environment, scalars: Scalars, labels: Label, state: TrainState) -> TrainState:
        """Labels that were given elsewhere, in place of questions, and the model fitted to them."""
        return self.guided(state, asking.take_labels(self.guidance, env, scalars, labels, state.guide, state.key))

    def guided(self, state: TrainState, guide: GuideState) -> TrainState:
        """The lane with a new guide; where that is not finite the lane fails, and keeps the one that it had."""
        failed = state.failed | ~all_finite((guide.model, guide.labels))
        kept = jax.tree.map(lambda new, old: jnp.where(failed, old, new), guide, state.guide)
        return state.replace(guide=kept, failed=failed)

    def kept_finite(self, state: TrainState, before: TrainState) -> TrainState:
        """A lane after a stretch; one that has failed, in it or before, with what it had learned `before`.

        Asked once a stretch, not at each gradient step: that would read all parameters once more.
        """
        learned = lambda lane: (lane.agent.params, lane.agent.target_params, lane.agent.opt_state)  # noqa: E731
        failed = state.failed | ~all_finite(learned(state))
        kept = jax.tree.map(lambda new, old: jnp.where(failed, old, new), learned(state), learned(before))
        params, target_params, opt_state = kept
        agent = state.agent.replace(params=params, target_params=target_params, opt_state=opt_state)
        return state.replace(agent=agent, failed=failed)

    def advance(self, clock: Clock, schedule: Schedule) -> Clock:
        """The clock after one iteration."""
        steps = self.sizes.num_envs
        updates = jnp.where(clock.step + steps >= schedule.learn_after, steps * self.sizes.updates_per_step, 0)
        return clock.replace(step=clock.step + steps, update=clock.update + updates)

    def iterate(
        self, env: Environment, scalars: Scalars, schedule: Schedule, clock: Clock, state: TrainState
    ) -> tuple[TrainState, dict[str, Float[Array, ""]]]:
        """One step in each of the lane's environments, then as many gradient steps."""
        key = jax.random.fold_in(jax.random.fold_in(state.key, Stream.TRAIN), clock.step)
        k_act, k_env, k_guided, k_learn = jax.random.split(key, 4)
        action, passes = self.act(env, scalars, schedule, clock, state, k_act)
        agent, bootstraps = state.agent, self.learner.bootstraps
        remembered = jax.vmap(env.remember)(agent.env, agent.obs)
        env_state, step = jax.vmap(env.step)(jax.random.split(k_env, self.sizes.num_envs), agent.env, action)
        done = step.terminated | step.truncated
        paced = state.pace
        if paced is not None:
            counts = guides(clock, schedule)
            paced = pace.follow(paced, scalars, bootstraps, step.reward, done, agent.guided, counts)
        share = scalars.guided_probability if paced is None else pace.probability(paced, scalars)
        redrawn = jax.random.bernoulli(k_guided, share, done.shape)
        stored = jax.vmap(partial(stored_step, bootstraps=bootstraps))(remembered, action, step)
        agent = agent.replace(
            replay=self.learner.buffer.add(agent.replay, clock.step, stored),
            env=env_state,
            obs=step.obs,
            guided=jnp.where(done, redrawn, agent.guided),
        )
        agent, loss, finite = jax.lax.cond(
            clock.step + self.sizes.num_envs >= schedule.learn_after,
            lambda agent: self.learner.learn(env, scalars, schedule, clock, agent, k_learn),
            lambda agent: (agent, jnp.zeros(()), jnp.array(True)),
            agent,
        )
        metrics = {"reward": step.reward.mean(), "loss": loss, "passes": passes.astype(jnp.float32).mean()}
        if paced is not None:
            metrics["guided_share"] = (passes > 0).astype(jnp.float32).mean()
        return state.replace(agent=agent, failed=state.failed | ~finite, pace=paced), metrics

    def act(
        self, env: Environment, scalars: Scalars, schedule: Schedule, clock: Clock, state: TrainState, key: PRNGKeyArray
    ) -> Refined:
        """Actions to execute (num_envs, action), and how often guidance moved each.

        Uniform at first, then greedy; in guided episodes refined by the guidance until the cut-off. The branches hang
        on the shared clock alone, so they stay branches under vmap.
        """
        agent = state.agent
        base = jax.lax.cond(
            clock.step < schedule.random_steps,
            lambda: self.learner.actions.sample(key, (self.sizes.num_envs,)),
            lambda: self.turned(scalars, self.learner.greedy(env, agent), key),
        )
        return jax.lax.cond(
            guides(clock, schedule),
            lambda: self.guide(env, scalars, schedule, clock, state, base),
            lambda: untouched(base),
        )

    def turned(
        self, scalars: Scalars, actions: Float[Array, "num_envs action"], key: PRNGKeyArray
    ) -> Float[Array, "num_envs action"]:
        """Actions each turned by a normal angle; as they are where there is no noise."""
        if not self.noisy:
            return actions
        space = self.learner.actions
        changes = jax.random.normal(key, (actions.shape[0], len(space.cues)))
        return space.toward(actions, changes, space.from_unit(scalars.action_noise_deg))

    def guide(
        self,
        env: Environment,
        scalars: Scalars,
        schedule: Schedule,
        clock: Clock,
        state: TrainState,
        base: Float[Array, "num_envs action"],
    ) -> Refined:
        """The agent's actions as guidance has them, in guided episodes.

        Once there are labels about its own actions, within `ask_bound_deg` of them: these are local corrections.
        """
        agent, guidance = state.agent, self.guidance
        where = (state.guide.model, env, agent.obs, base, agent.guided, scalars)
        if len(schedule.ask_at) == 1:
            return guidance.act(*where)
        ask_bound = self.learner.actions.from_unit(scalars.ask_bound_deg)
        bound = jnp.where(clock.step >= schedule.ask_at[1], ask_bound, jnp.pi)
        return guidance.act_within(bound, *where)


def guides(clock: Clock, schedule: Schedule) -> Bool[Array, ""]:
    """Is this the time of guidance: after the random steps and before the cut-off?"""
    return (clock.step >= schedule.random_steps) & (clock.step < schedule.guidance_until)


def make_lane(config: RunConfig, guidance: Guide, env: Environment, largest_budget: int) -> Lane:
    """The loop of one lane for an environment, whose shapes alone are looked at."""
    return _lane_of(config.sizes, config.bootstraps, config.noisy, guidance, largest_budget, env)


def _lane_of(
    sizes: Sizes, bootstraps: bool, noisy: bool, guidance: Guide, largest_budget: int, env: Environment
) -> Lane:
    return Lane(sizes, guidance, learner(sizes, bootstraps, env), largest_budget, noisy)
