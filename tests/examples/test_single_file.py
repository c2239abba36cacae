"""The method in one file as an oracle: its functions and the package's give the same numbers of the same inputs."""

import dataclasses
import math

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from cuelearner_envs.billiards.environment import Billiards
from cuelearner_envs.billiards.table import Table
from cuelearner_jax.agents import ddqn
from cuelearner_jax.agents.replay import Memory, RingBuffer, StoredStep
from cuelearner_jax.cli import main
from cuelearner_jax.config import Scalars, Sizes
from cuelearner_jax.environment import spaces_of
from cuelearner_jax.guides import registry as guides
from cuelearner_jax.spaces import DIRECTIONS
from cuelearner_jax.storage import results
from cuelearner_jax.tasks import registry as tasks
from cuelearner_jax.types import GuidanceModel, Label
from examples import single_file

SINGLE = single_file.Config(
    layers=(8, 8), search_directions=90, labels=20, fit_steps=40, fit_batch_size=16, directions=24, batch_size=8
)
ENV = Billiards(Table.one_ball(), max_shots=1)
SIZES = Sizes(normalise_obs=False, feedback_layers=(8, 8), fit_steps=40, fit_batch_size=16)
SCALARS = Scalars(eps_deg=2.0, k_max=100)
GUIDE = guides.make("relative", SIZES, ENV)


def situations(count, seed=0):
    """Observations (count, 6), actions (count, 2) and answers (count,)."""
    random = np.random.default_rng(seed)
    angles, h = random.uniform(-math.pi, math.pi, count), random.integers(-1, 2, count)
    obs = random.normal(size=(count, 6))
    return tuple(jnp.asarray(x, jnp.float32) for x in (obs, np.stack([np.cos(angles), np.sin(angles)], -1), h))


def test_refined_actions():
    tau_max_deg, k_max = 20.0, 7
    obs, first, _ = situations(64)
    params = jax.tree.map(lambda leaf: 3.0 * leaf, GUIDE.init(jax.random.key(5)).params)
    active = jnp.arange(64) % 4 > 0
    scalars = dataclasses.replace(SCALARS, tau_max_deg=tau_max_deg, k_max=k_max)
    act = jax.jit(lambda params: GUIDE.act(GuidanceModel(params, jnp.array(True)), ENV, obs, first, active, scalars))
    package = act(params)
    assert len(np.unique(package.passes)) > 2  # some settle early, some late
    cfg = dataclasses.replace(SINGLE, tau_max=math.radians(tau_max_deg), k_max=k_max)
    single = jax.jit(lambda params: single_file.refine(cfg, params, obs, first, active))(params)
    np.testing.assert_allclose(single, package.actions, atol=1e-5)
    assert np.abs(DIRECTIONS.distance(first, single)).max() > math.radians(5)


def test_fitted_targets_and_the_network_that_is_fitted():
    obs, action, h = situations(20)
    labels = Label(obs, action, h[:, None], jnp.arange(20) < 15)
    given = single_file.Labels(obs, action, h)
    targets = single_file.feedback_targets(SINGLE, given)
    np.testing.assert_allclose(targets, GUIDE.examples(labels, SCALARS).target, atol=1e-5)
    package = jax.jit(lambda key: GUIDE.fit(key, ENV, labels, GUIDE.init(key), SCALARS).params)(jax.random.key(3))
    single = jax.jit(lambda key: single_file.fit(SINGLE, key, given, 15))(jax.random.key(3))
    chex.assert_trees_all_close(single, package, atol=1e-4)
    chex.assert_trees_all_equal_shapes_and_dtypes(single, package)


def test_one_update_of_double_dqn():
    discount = 0.9
    obs, action, reward = situations(40)
    goes_on = (jnp.arange(40) % 3 > 0).astype(jnp.float32)
    cfg, scalars = dataclasses.replace(SINGLE, discount=discount), dataclasses.replace(SCALARS, discount=discount)
    options = ddqn.DDQNConfig(q_layers=(8, 8), directions=24, target_directions=24, batch_size=8, learning_rate=0.01)
    double_dqn = options.make("raw", spaces_of(ENV), bootstraps=True)

    @jax.jit
    def by_the_package(key):
        params, rest = double_dqn.init(key)
        rest = rest.replace(target_params=double_dqn.init(jax.random.key(1))[0])
        steps = StoredStep(obs, action, reward, goes_on[:, None], goes_on[:, None], obs[::-1])
        buffer = RingBuffer(jax.tree.map(lambda leaf: leaf[0], steps))
        memory = Memory(ENV, buffer, buffer.add(buffer.empty(40), jnp.array(0), steps), jnp.array(40), 10, True)
        targets = double_dqn.targets(ENV, options, discount, params, rest.target_params, memory.batches(key, 8))
        learned, after, loss, _ = double_dqn.update(ENV, options, scalars, jnp.array(2), params, rest, memory, key)
        return (learned, after.target_params), targets, loss

    @jax.jit
    def by_the_single_file(key):
        params, other = (single_file.MLP((8, 8), 1).init(k, obs[0], action[0]) for k in (key, jax.random.key(1)))
        agent = single_file.Agent(params, other, jnp.array(1))
        drawn = jax.random.randint(jax.random.split(key)[0], (8,), 0, 40)
        batch = jax.tree.map(lambda leaf: leaf[drawn], single_file.Transition(obs, action, reward, obs[::-1], goes_on))
        after, loss = single_file.update(cfg, agent, batch)
        return (after.params, after.target_params), single_file.value_targets(cfg, agent, batch), loss

    chex.assert_trees_all_close(by_the_single_file(jax.random.key(4)), by_the_package(jax.random.key(4)), atol=1e-5)


def test_its_parameters_are_those_of_the_quickstart():
    preset, cfg = tasks.find("billiards").presets["quickstart"].config, single_file.Config()
    parts = (preset.task, preset.sizes, preset.scalars, preset.schedule, preset.agent)
    renamed = {"feedback_layers": "layers", "q_layers": "layers", "labels_per_round": "labels_per_fit"}
    known = {renamed.get(name, name): value for part in parts for name, value in vars(part).items()}
    for field in dataclasses.fields(cfg):
        value = getattr(cfg, field.name)
        if field.name == "labels":
            assert (value,) == tasks.find("billiards").presets["quickstart"].labels
        elif field.name in known:
            assert known[field.name] == value, field.name
        else:
            assert math.radians(known[f"{field.name}_deg"]) == value, field.name


@pytest.mark.long
def test_a_whole_run_gives_the_rewards_of_the_package(tmp_path):
    cfg = dataclasses.replace(SINGLE, directions=36, total_steps=300, guidance_until=250, batch_size=100)
    short = "--sizes.feedback-layers 8 8 --agent.q-layers 8 8 --task.search-directions 90 --sizes.fit-steps 40"
    short += " --sizes.fit-batch-size 16 --agent.directions 36 --schedule.total-steps 300"
    short += " --schedule.guidance-until 250 --schedule.checkpoint-every 300 --labels 20 --seeds 2 --arbiter episodes"
    assert main(["sweep", "billiards", "--preset", "quickstart", "--out", str(tmp_path / "run"), *short.split()]) == 0
    rows = sorted(results.read([tmp_path / "run"]).to_pylist(), key=lambda row: (row["seed"], row["step"]))
    for guidance, found in single_file.curves(cfg, range(2000, 2002)).items():
        known = [row["reward"] for row in rows if row["guidance"] == guidance]
        np.testing.assert_allclose(found.ravel(), known, atol=1e-6)
