"""The training loop of many lanes as compiled programs, kept for the next run of the same shapes."""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache, partial
from typing import Any, NamedTuple

import jax
from jax.sharding import Mesh
from jaxtyping import Array, PRNGKeyArray

from cuelearner_jax import devices
from cuelearner_jax.config import Scalars, Sizes
from cuelearner_jax.devices import BY_LANE, SHARED, each_lane, each_lane_in_place, lane_mesh, over_lanes
from cuelearner_jax.environment import Environment
from cuelearner_jax.guides.base import Guide
from cuelearner_jax.loop import Clock, Parts, TrainState, lane_of, parts_of
from cuelearner_jax.run_config import RunConfig, Settings
from cuelearner_jax.types import Label, Teacher

MOST_PROGRAMS = 8  # compiled programs that a process keeps for its next runs


class Program(NamedTuple):
    """Jitted functions over a block of lanes (leading axis of `state`). They donate the state they are given.

    The clock is not donated: blocks share it.
    """

    # (env, seeds (lanes,), budgets (lanes,), root key) -> state
    init: Callable[[Any, Array, Array, PRNGKeyArray], TrainState]
    # (env, teacher, scalars, clock, state) -> clock, state
    label_round: Callable[[Any, Teacher, Scalars, Clock, TrainState], tuple[Clock, TrainState]]
    # (env, scalars, labels (lanes, slots, ...) that were given elsewhere, state) -> state
    take_labels: Callable[[Any, Scalars, Label, TrainState], TrainState]
    # (env, settings, clock, state, iterations) -> clock, state, metrics (lanes,)
    train: Callable[[Any, Settings, Clock, TrainState, int], tuple[Clock, TrainState, dict[str, Array]]]


def make_program(
    config: RunConfig, guidance: Guide, env: Environment, largest_budget: int, mesh: Mesh | None = None, lanes: int = 1
) -> Program:
    """Compile (on first use) the loop for one kind of guidance; only the shapes of `env` count.

    Another run of the same sizes, guidance and shapes in this process is given the same program, compiled already.
    `mesh`: devices that share the lanes, whose number they must divide into (default: the first device alone). `lanes`:
    expected number of lanes on each device; only speed depends on it.
    """
    leaves, structure = jax.tree.flatten(jax.eval_shape(lambda env: env, env))
    mesh = mesh or lane_mesh(jax.local_devices()[:1])
    loop = config.sizes, parts_of(config), guidance, largest_budget
    return _program_of(loop, (structure, tuple(leaves)), mesh, lanes)


@lru_cache(maxsize=MOST_PROGRAMS)
def _program_of(loop: tuple[Sizes, Parts, Guide, int], shapes: tuple[Any, Any], mesh: Mesh, lanes: int) -> Program:
    """Return the program of lanes. `loop`: see `lane_of`. `shapes`: structure and leaves of an environment."""
    lane = lane_of(*loop, jax.tree.unflatten(*shapes))

    def init(env, seeds, budgets, root):
        return each_lane(partial(lane.init, env))(jax.vmap(partial(jax.random.fold_in, root))(seeds), budgets)

    def label_round(env, teacher, scalars, clock, state):
        rest, agent = state.replace(agent=None), state.agent  # the agent's state is large, and not needed for questions
        after = each_lane(partial(lane.label_round, env, teacher, scalars))(rest).replace(agent=agent)
        return clock.replace(round=clock.round + 1), after

    def take_labels(env, scalars, labels, state):
        rest, agent = state.replace(agent=None), state.agent
        return each_lane(partial(lane.take_labels, env, scalars))(labels, rest).replace(agent=agent)

    def train(env, settings, clock, state, iterations):
        def run(state):
            def iteration(carry, _):
                clock, state = carry
                state, metrics = lane.iterate(env, settings, clock, state)
                return (lane.advance(clock, settings.schedule), state), metrics

            (after, last), metrics = jax.lax.scan(iteration, (clock, state), length=iterations)
            return lane.keep_finite(last, state), after, jax.tree.map(lambda leaf: leaf.mean(0), metrics)

        state, after, metrics = each_lane_in_place(run)(state)
        return after, state, metrics

    def stretch(env, settings, clock, state, iterations):
        own, axes = partial(train, iterations=iterations), (SHARED, SHARED, SHARED, BY_LANE)
        return over_lanes(mesh, own, axes, (SHARED, BY_LANE, BY_LANE))(env, settings, clock, state)

    init = over_lanes(mesh, init, (SHARED, BY_LANE, BY_LANE, SHARED), BY_LANE)
    label_round = over_lanes(mesh, label_round, (*(SHARED,) * 4, BY_LANE), (SHARED, BY_LANE))
    take_labels = over_lanes(mesh, take_labels, (SHARED, SHARED, BY_LANE, BY_LANE), BY_LANE)
    options = devices.compiler_options(lanes)
    return Program(
        init=jax.jit(init),
        label_round=jax.jit(label_round, donate_argnums=4),
        take_labels=jax.jit(take_labels, donate_argnums=3),
        train=jax.jit(stretch, donate_argnames="state", static_argnames="iterations", compiler_options=options),
    )
