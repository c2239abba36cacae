"""Probe environments whose values are known by hand, their teacher and task, and small configurations to train on them.

In the manner of bsuite's and rejax's probes: each isolates one thing that a learner can get wrong.
"""

import dataclasses
import json
import math
from dataclasses import dataclass
from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import struct

from cuelearner_jax import asking
from cuelearner_jax.agents import ddqn
from cuelearner_jax.agents.networks import as_function, q_network
from cuelearner_jax.config import Scalars, Schedule, Sizes, digest
from cuelearner_jax.environment import Aims, Features, Quantity, WholeObservations
from cuelearner_jax.guides import registry as guidances
from cuelearner_jax.loop import start_clock
from cuelearner_jax.run_config import RunConfig
from cuelearner_jax.runs.program import make_program
from cuelearner_jax.spaces.directions import difference, evenly_spaced, from_angle, inward, rotate
from cuelearner_jax.task import Body, Task
from cuelearner_jax.types import Label, Step


class Window(WholeObservations, struct.PyTreeNode):
    """A bandit: one shot an episode, reward 1 within `half_width` of the best direction, which the observation tells.

    The observation is one of `contexts` evenly spaced unit vectors; the best direction is the observation turned by
    `offset`. Exactly symmetric under quarter turns, which `mirrors` offers.
    """

    half_width: jax.Array | float = 0.5  # [rad]
    offset: jax.Array | float = 0.6  # [rad]
    contexts: int = struct.field(pytree_node=False, default=4)
    mirrors: bool = struct.field(pytree_node=False, default=False)

    observation = (Quantity("context", 2, "1"),)

    @property
    def symmetries(self):
        return 4 if self.mirrors else 1

    def reset(self, key):
        context = jax.random.randint(key, (), 0, self.contexts).astype(jnp.float32)
        obs = from_angle(context * (2 * math.pi / self.contexts))
        return obs, obs

    def best(self, obs):
        return rotate(obs, self.offset)

    def step(self, key, state, action):
        reward = (jnp.abs(difference(self.best(state), action)) <= self.half_width).astype(jnp.float32)
        following, obs = self.reset(key)
        return following, Step(obs, state, state, reward, jnp.array(True), jnp.array(False), {"hit": reward}, {})

    def heuristic(self, obs):
        return rotate(obs, -1.0)  # wrong, and none of the evenly spaced directions

    def mirror(self, which, obs, vector):
        return rotate(obs, which * (math.pi / 2)), rotate(vector, which * (math.pi / 2))

    def features(self, obs, action):
        return Features(obs, jnp.concatenate([inward(jnp.broadcast_to(obs, action.shape), action), action], axis=-1))


class Aimed(Window):
    """The bandit with four aims, told apart by where they lie from the context; its expert means the second.

    The last is impossible.
    """

    order = (0, 1, 2, 3)
    possible = (True, True, True, False)

    @property
    def turns(self):
        return jnp.array((-1.0, 0.6, 2.5, -2.2))[jnp.array(self.order)]

    def aims(self, obs):
        turns = self.turns
        found = from_angle(jnp.arctan2(obs[1], obs[0])[None] + turns)
        features = jnp.stack([jnp.cos(turns), jnp.sin(turns), turns, jnp.broadcast_to(obs[0], turns.shape)], -1)
        return Aims(found, features, jnp.array(self.possible)[jnp.array(self.order)])


class Chain(WholeObservations, struct.PyTreeNode):
    """Two steps: place 0 pays half the action's y and leads to place 1, which pays the action's x and ends the episode.

    Ends by truncation (the last observation is then place 1's own) or by termination; either way place 0 follows.
    Values at discount g: Q(1, a) = a_x, plus g / (1 - g) if truncated; Q(0, a) = a_y / 2 + g max Q(1, .).
    """

    truncates: jax.Array | bool = False

    observation = (Quantity("context", 2, "1"),)

    def reset(self, key):
        return jnp.zeros((), jnp.int32), self.observe(0)

    def observe(self, place):
        return jnp.where(jnp.asarray(place) == 0, jnp.array([1.0, 0.0]), jnp.array([0.0, 1.0]))

    def step(self, key, state, action):
        ends = state == 1
        after = jnp.where(ends, 0, 1)
        reward = jnp.where(ends, action[0], 0.5 * action[1])
        final = self.observe(1)
        step = Step(self.observe(after), final, final, reward, ends & ~self.truncates, ends & self.truncates, {}, {})
        return after, step

    def heuristic(self, obs):
        return from_angle(jnp.array(2.0))


class Expert(struct.PyTreeNode):
    """Knows a window's best direction exactly."""

    env: Window

    def best_action(self, state, obs):
        return self.env.best(obs)


@dataclass(frozen=True)
class WindowConfig:
    """The bandit as a task's configuration."""

    half_width_deg: float = 28.0
    """Half the width of the winning window [deg]."""


def make_task(name="window"):
    """The bandit as a task that nothing draws."""
    body = Body("point", "", lambda config, split: Window(jnp.deg2rad(jnp.array(config.half_width_deg))))
    return Task(name, "the bandit", WindowConfig, (body,), teacher=lambda config, env: Expert(env))


SIZES = Sizes(feedback_layers=(32, 32), num_envs=4, labels_per_round=10, fit_steps=200, fit_batch_size=32)
SCALARS = Scalars(max_grad_norm=10.0, eps_deg=20.0, tau_deg=1.0, feedback_learning_rate=5e-3)
AGENT = ddqn.DDQNConfig(
    q_layers=(32, 32),
    directions=16,
    target_directions=16,
    batch_size=32,
    replay_capacity=4000,
    optimizer="adam",
    learning_rate=3e-3,
)
SCHEDULE = Schedule(
    total_steps=48,
    random_steps=8,
    learn_after=4,
    guidance_until=24,
    eval_every=16,
    eval_steps=20,
    eval_envs=10,
    checkpoint_every=16,
)
CONFIG = RunConfig(WindowConfig(), SIZES, SCALARS, SCHEDULE, AGENT)
SETTINGS = CONFIG.settings
FUNCTIONS = CONFIG.agent_in(Window())  # of the agent, on the bandit


def config(arbiter=None, **groups):
    """`CONFIG` with other values in its groups, and with another arbiter."""
    changed = {name: dataclasses.replace(getattr(CONFIG, name), **values) for name, values in groups.items()}
    return dataclasses.replace(CONFIG, arbiter=arbiter or CONFIG.arbiter, **changed)


CHAIN = config(  # of runs on the chain, which learn from uniform actions
    sizes={"num_envs": 2},
    scalars={"discount": 0.5},
    schedule={"random_steps": 2000, "learn_after": 50},
    agent={"polyak": 0.05, "learning_rate": 0.005, "target_every": 1},
)


def chain_program(config, kind):
    """Return a training program on the chain."""
    return make_program(config, guidances.make(kind, config.sizes, Chain()), Chain(jnp.array(False)), 0)


def chain_values(program, config, truncates):
    """Return the learned values at both places of east, north, west and south; and the state."""
    env = Chain(jnp.array(truncates))
    _, state, _ = program.train(env, config.settings, start_clock(), start(program, [3], [0], env), 1000)
    q, params = as_function(q_network(config.agent.q_layers)), lane(state.agent.params, 0)
    return [np.asarray(q(params, env.observe(place), evenly_spaced(4)))[:, 0] for place in (0, 1)], state


LARGEST = 60  # labels of the largest budget in the tests' loop


@cache
def window_program(kind):
    """Return one training program on the bandit for all tests, so that it compiles once."""
    guide = guidances.make(kind, SIZES, Window())
    return make_program(CONFIG, guide, Window(), LARGEST if guide.asks else 0)


def label_rounds(guidance, sizes):
    """`asking.label_round` of a guidance, compiled."""

    def one(env, teacher, scalars, base, guide, lane_key):
        return asking.label_round(asking.Inquiry(guidance, env, scalars, base), sizes, teacher, guide, lane_key)

    return jax.jit(one)


def start(program, seeds, budgets, env=None):
    """Fresh lanes; the arrays of another call are never the same, for programs donate what they are given."""
    seeds, budgets = jnp.array(seeds, jnp.int32), jnp.array(budgets, jnp.int32)
    return program.init(Window() if env is None else env, seeds, budgets, jax.random.key(0))


def long_but(few, names):
    """Parameters of a test: `make test` runs the few, `make test-all` the others too."""
    return [pytest.param(name, marks=() if name in few else pytest.mark.long) for name in names]


def stored(state, lane, steps):
    """Return the columns (steps, ...) of a lane's replay in the order of time."""
    rows = np.asarray(state.agent.replay[lane, :steps])
    names = {"obs": slice(0, 2), "action": slice(2, 4), "reward": 4}
    if rows.shape[1] > 5:  # something bootstraps
        names |= {"discount": 5, "ended": 6, "next_obs": slice(7, None)}
    return {name: rows[:, columns] for name, columns in names.items()}


def greedy_actions(q, params, obs, directions=AGENT.directions):
    """The argmax of one lane's values over the agent's directions, for observations (n, 2)."""
    options = evenly_spaced(directions)
    return np.asarray(options[jnp.argmax(jax.vmap(lambda one: q(params, one, options)[:, 0])(jnp.asarray(obs)), -1)])


def label_set(obs, action, answer, valid):
    """Labels as NumPy arrays."""
    return Label(obs, action, answer, valid)


def lane(tree, index):
    """Return one lane of a block as NumPy arrays."""
    return jax.tree.map(lambda leaf: np.asarray(words(leaf)[index]), tree)


def words(leaf):
    """A leaf whose entries can be compared: the words of a key, anything else as it is."""
    return jax.random.key_data(leaf) if jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key) else leaf


def files_of(folder):
    """Every file at or below a folder with its bytes and time: equal before and after if nothing was changed.

    The mark of the process that wrote last is left out.
    """
    return {
        path.relative_to(folder): (path.lstat().st_mtime_ns, path.read_bytes() if path.is_file() else None)
        for path in sorted(folder.rglob("*"))
        if path.name != ".lock"
    }


def edit_json(path, change):
    """Rewrite a JSON file by a function of its values; one with a digest gets that of the new ones."""
    values = json.loads(path.read_text())
    sealed = values.pop("digest", None) is not None
    change(values)
    path.write_text(json.dumps({**values, "digest": digest(values)} if sealed else values))
