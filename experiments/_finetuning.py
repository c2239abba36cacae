"""RL fine-tuning in the changed world: the training loop from a finished agent's parameters, actions turned at random.

What the paper compares adaptation with ("Finetuning the RL policy on the new environment"; its public code: SGD with a
small step, Gaussian action noise). Lanes differ by arrays alone (base agent, seed, step size, noise), so a sweep of
settings over many bases is one compiled program: side by side on an accelerator, one by one on a CPU.

    lanes = every(bases=16, seeds=(0,), learning_rates=(0.001, 0.01), noises_deg=(0.2,))
    tuning = FineTuning(config, env, agents, lanes)
    while tuning.step < 20_000:
        tuning.train(2_000)
        found = evaluate.watched_lanes(world, tuning.policy(world), episodes(), 100, 10_000).means
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from functools import partial
from itertools import product
from typing import Annotated, Any, ClassVar, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Float, PRNGKeyArray

from cuelearner_jax.agents import ddqn
from cuelearner_jax.config import Bounds, Frame, part
from cuelearner_jax.devices import compiler_options, each_lane, each_lane_in_place
from cuelearner_jax.environment import Environment, Spaces, view_of
from cuelearner_jax.errors import UserError
from cuelearner_jax.guides import registry as guidances
from cuelearner_jax.guides.base import NoGuide
from cuelearner_jax.loop import Clock, Lane, TrainState, make_lane, start_clock
from cuelearner_jax.policies import Agent
from cuelearner_jax.run_config import RunConfig, Settings, check


class Lanes(NamedTuple):
    """The policies to fine-tune and their settings, one row per lane."""

    base: np.ndarray  # (lanes,) int: which of the base agents
    seed: np.ndarray  # (lanes,) int: of everything random
    learning_rate: np.ndarray  # (lanes,) float
    noise_deg: np.ndarray  # (lanes,) float: standard deviation of the random turn of every action [deg]

    def __len__(self) -> int:
        return len(self.seed)


def every(bases: int, seeds: Sequence[int], learning_rates: Sequence[float], noises_deg: Sequence[float]) -> Lanes:
    """Every base agent with every seed, step size and noise; the bases of one setting side by side."""
    rows = list(product(learning_rates, noises_deg, range(bases), seeds))
    rate, noise, base, seed = (np.array(column) for column in zip(*rows, strict=True))
    return Lanes(base.astype(np.int32), seed.astype(np.int32), rate.astype(np.float32), noise.astype(np.float32))


class Tuned(struct.PyTreeNode):
    """A lane on its way; of a block every leaf has a leading axis of lanes."""

    state: TrainState
    learning_rate: Float[Array, ""]
    noise_deg: Float[Array, ""]  # [deg]


@part
class Noisy(ddqn.DdqnConfig):
    """Options of an agent whose actions are turned at random while it learns."""

    NAME: ClassVar[str] = "ddqn-noisy"
    ABOUT: ClassVar[str] = "double DQN whose actions are turned at random while it learns"

    noise_deg: Annotated[float, Bounds(0)] = 0.0
    """Standard deviation of the random turn of every action [deg]."""

    def make(self, frame: Frame, spaces: Spaces, bootstraps: bool = False) -> NoisyDQN:
        """The agent for an environment's spaces."""
        return NoisyDQN(self, frame, spaces, bootstraps)


class NoisyDQN(ddqn.DoubleDQN):
    """Double DQN whose actions are turned at random while it learns."""

    def explore(
        self, env: Any, options: Noisy, params: Any, obs: Float[Array, "n obs"], key: PRNGKeyArray
    ) -> Float[Array, "n action"]:
        """The greedy action, turned by a normal angle."""
        greedy = super().explore(env, options, params, obs, key)
        turns = jax.random.normal(key, (len(obs), 1))
        return self.spaces.actions.toward(greedy, turns, jnp.deg2rad(options.noise_deg))


@partial(jax.jit, static_argnames=("lane",))
def _begin(lane: Lane, env: Any, params: Any, columns: Any) -> Tuned:
    def one(base: Array, seed: Array, rate: Array, noise: Array) -> Tuned:
        own = jax.tree.map(lambda leaf: leaf[base], params)
        state = lane.init(env, jax.random.key(seed), 0)
        training = state.agent.training
        follows = None if training.target_params is None else jax.tree.map(jnp.copy, own)
        agent = state.agent.replace(params=own, training=training.replace(target_params=follows))
        return Tuned(state.replace(agent=agent), rate, noise)

    return each_lane(one)(*columns)


def _stretch(
    lane: Lane, env: Any, settings: Settings, clock: Clock, block: Tuned, iterations: int
) -> tuple[Tuned, Clock, Float[Array, " lanes"]]:
    """Train all lanes for some iterations; return (block, clock, mean reward of each lane's own steps)."""

    def one(tuned: Tuned) -> tuple[Tuned, Clock, Array]:
        agent = dataclasses.replace(settings.agent, learning_rate=tuned.learning_rate, noise_deg=tuned.noise_deg)
        own = settings._replace(agent=agent)

        def iteration(carry: tuple[Clock, TrainState], _: None) -> tuple[tuple[Clock, TrainState], Array]:
            clock, state = carry
            state, metrics = lane.iterate(env, own, clock, state)
            return (lane.advance(clock, own.schedule), state), metrics["reward"]

        (after, trained), rewards = jax.lax.scan(iteration, (clock, tuned.state), length=iterations)
        return tuned.replace(state=lane.keep_finite(trained, tuned.state)), after, rewards.mean()

    return each_lane_in_place(one)(block)


class FineTuning:
    """Trained agents fine-tuned in a changed world; lanes differ in base, seed, step size and noise."""

    def __init__(self, config: RunConfig, env: Environment, agents: Agent, lanes: Lanes) -> None:
        """Start at the beginning.

        Args:
            config: sizes, scalars and schedule of the learning; the two numbers that lanes have of their own are
                not looked at, and no step is uniform whatever it says.
            env: the changed world.
            agents: a block of finished agents with networks of the same sizes.
            lanes: what is fine-tuned.

        Raises:
            UserError: settings that cannot work.
        """
        if min(lanes.noise_deg) < 0 or min(lanes.learning_rate) < 0:
            raise UserError("step sizes and noises of fine-tuning must not be negative")
        schedule = dataclasses.replace(config.schedule, random_steps=0, guidance_until=0)
        agent = Noisy(**vars(config.agent))
        self.config = dataclasses.replace(config, agent=agent, schedule=schedule)
        check(self.config)
        self.env, self.lanes, self.clock = env, lanes, start_clock()
        self._lane = make_lane(self.config, guidances.make(NoGuide.name, config.sizes, env), env, 0)
        self._train = jax.jit(
            _stretch,
            static_argnames=("lane", "iterations"),
            donate_argnames="block",
            compiler_options=compiler_options(len(lanes)),
        )
        columns = tuple(jnp.asarray(column) for column in lanes)
        self.block: Tuned = _begin(self._lane, env, agents.params, columns)

    @property
    def step(self) -> int:
        """Environment steps of each lane so far."""
        return int(self.clock.step)

    @property
    def failed(self) -> np.ndarray:
        """Mask (lanes,) of lanes that are no longer finite; they keep their last finite state."""
        return np.asarray(self.block.state.failed)

    def train(self, steps: int) -> np.ndarray:
        """Train every lane for some more steps; return the mean reward (lanes,) of these steps.

        Raises UserError unless they are a multiple of the environments of a lane.
        """
        together = self.config.sizes.num_envs
        if steps < 1 or steps % together:
            raise UserError(f"{steps} steps of {together} environments: give a multiple of sizes.num_envs ({together})")
        self.block, self.clock, rewards = self._train(
            self._lane, self.env, self.config.settings, self.clock, self.block, steps // together
        )
        return np.asarray(rewards)

    def policy(self, env: Any) -> Agent:
        """The agents as they are, a block, in a world."""
        return Agent(self.block.state.agent.params, self.config.agent_in(env), view_of(env))
