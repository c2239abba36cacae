"""The learned teacher on a bandit whose best direction is known."""

import json
import math

import jax
import jax.numpy as jnp
import numpy as np
import probes
import pytest

from cuelearner_jax import actions
from cuelearner_jax.config import to_json
from cuelearner_jax.errors import UserError
from cuelearner_jax.evaluate import rollout
from cuelearner_jax.policies import Taught
from cuelearner_jax.storage import formats
from cuelearner_jax.teachers import program as training_program
from cuelearner_jax.teachers import stored
from cuelearner_jax.teachers.learned import TeacherConfig

ENV = probes.Window(mirrors=True)
CONFIG = TeacherConfig(
    layers=(32, 32),
    tables=32,
    tries=6,
    search=24,
    directions=72,
    memory=8,
    updates=4,
    batch_size=128,
    learning_rate=5e-3,
    rounds=200,
    spread_deg=10.0,
)
OBS = actions.evenly_spaced(4)


@pytest.fixture(scope="module")
def program():
    return training_program.make_program(CONFIG)


@pytest.fixture(scope="module")
def trained(program):
    state = program.init(ENV, jax.random.key(0))
    metrics = []
    for _ in range(2):
        state, measured = program.train(ENV, state, CONFIG.rounds // 2)
        metrics.append(jax.tree.map(float, measured))
    return state, metrics


@pytest.fixture(scope="module")
def made(trained):
    return training_program.finished(CONFIG, ENV, trained[0])


def test_it_learns_to_win_nearly_always(made, trained):
    measure = jax.jit(lambda made: rollout(Taught(made), ENV, jax.random.key(5), 20, 200))
    assert float(measure(made)["reward"]) > 0.97
    (_, metrics) = trained
    assert metrics[1]["reward"] > metrics[0]["reward"]
    assert metrics[1]["loss"] < 0.5 * metrics[0]["loss"]


def test_its_values_are_chances_to_win(made):
    best = ENV.best(OBS)
    inside = jnp.array([float(made.values(obs, action[None])[0]) for obs, action in zip(OBS, best, strict=True)])
    outside = jnp.array([float(made.values(obs, -action[None])[0]) for obs, action in zip(OBS, best, strict=True)])
    np.testing.assert_allclose(inside, 1, atol=0.15)
    np.testing.assert_allclose(outside, 0, atol=0.15)


def test_an_imperfect_aim_goes_to_the_middle_of_the_window(made):
    careful = made.replace(aim_error=0.3)
    error = [float(actions.difference(ENV.best(obs), careful.best_action(None, obs))) for obs in OBS]
    assert np.abs(error).max() < math.radians(12)


def test_tries_come_first_from_the_best_and_last_from_anywhere(program):
    training = training_program.Trainer(CONFIG)
    state = program.init(ENV, jax.random.key(1))
    keys = jax.random.split(jax.random.key(2), 500)
    tried = jax.jit(jax.vmap(lambda key: training.propose(ENV, state.params, OBS[0], key)))(keys)
    assert tried.shape == (500, CONFIG.tries, 2)
    np.testing.assert_allclose(jnp.linalg.norm(tried, axis=-1), 1, atol=1e-5)
    best_value = training.value(ENV, state.params, OBS[0], actions.evenly_spaced(3600)).max()
    first = training.value(ENV, state.params, OBS[0], tried[:, 0])
    assert float((best_value - first).max()) < 0.1  # as fine as the search is
    counts, _ = np.histogram(actions.to_angle(tried[:, -2:]).ravel(), bins=6, range=(-math.pi, math.pi))
    assert counts.min() > 120  # 167 each


def test_two_seeds_differ_and_one_seed_repeats(program):
    weights = [jax.tree.leaves(program.init(ENV, jax.random.key(seed)).params)[1] for seed in (0, 0, 1)]
    np.testing.assert_array_equal(weights[0], weights[1])
    assert not np.array_equal(weights[0], weights[2])


def test_it_comes_back_from_disk_in_half_precision(made, tmp_path):
    stored.save(tmp_path / "made", made, {"config": to_json(CONFIG)})
    loaded = stored.load(tmp_path / "made", ENV, 0.2, 0.1)
    for mine, yours in zip(jax.tree.leaves(loaded.params), jax.tree.leaves(made.params), strict=True):
        assert mine.dtype == jnp.float32
        np.testing.assert_array_equal(mine, np.asarray(yours).astype(np.float16).astype(np.float32))
    assert (float(loaded.aim_error), float(loaded.habit)) == pytest.approx((0.2, 0.1))
    assert (loaded.layers, loaded.directions) == (CONFIG.layers, CONFIG.directions)
    np.testing.assert_allclose(loaded.values(OBS[1], OBS), made.values(OBS[1], OBS), atol=5e-3)


def test_saving_again_replaces_the_network(made, tmp_path):
    stored.save(tmp_path, made, {"config": to_json(CONFIG)})
    other = made.replace(params=jax.tree.map(lambda leaf: 2 * leaf, made.params))
    stored.save(tmp_path, other, {"config": to_json(CONFIG)})
    weights = jax.tree.leaves(stored.load(tmp_path, ENV, 0.0, 0.0).params)[1]
    np.testing.assert_allclose(weights, 2 * jax.tree.leaves(made.params)[1], rtol=2e-3)


def test_its_description_has_a_format_and_a_newer_one_is_refused(made, tmp_path):
    stored.save(tmp_path, made, {"config": to_json(CONFIG)})
    current = formats.FORMATS["teacher"]
    assert formats.read("teacher", tmp_path / "teacher.json") == {"format": current, "config": to_json(CONFIG)}
    assert stored.load(tmp_path, ENV, 0.0, 0.0).layers == CONFIG.layers
    probes.edit_json(tmp_path / "teacher.json", lambda about: about.update(format=current + 1))
    with pytest.raises(UserError, match="written by a newer cuelearner"):
        stored.load(tmp_path, ENV, 0.0, 0.0)
    probes.edit_json(tmp_path / "teacher.json", lambda about: about.pop("format"))
    with pytest.raises(UserError, match=r"trained by an earlier cuelearner.*: train it anew"):
        stored.load(tmp_path, ENV, 0.0, 0.0)


def test_a_folder_without_a_teacher_is_refused(tmp_path):
    with pytest.raises(UserError, match="no teacher"):
        stored.load(tmp_path, ENV, 0.0, 0.0)


def test_a_teacher_of_another_task_is_refused(made, tmp_path):
    stored.save(tmp_path, made, {"config": to_json(CONFIG)})
    probes.edit_json(tmp_path / "teacher.json", lambda about: about["config"].update(layers=[32]))
    with pytest.raises(UserError, match="another version of the program"):
        stored.load(tmp_path, ENV, 0.0, 0.0)


@pytest.mark.parametrize("text", ["{", "[]", json.dumps({"format": 3}), {"config": 3}])
def test_a_damaged_description_is_refused(made, tmp_path, text):
    stored.save(tmp_path, made, {"config": to_json(CONFIG)})
    if isinstance(text, str):
        (tmp_path / "teacher.json").write_text(text)
    else:  # whole, but no teacher
        formats.write("teacher", tmp_path / "teacher.json", text)
    with pytest.raises(UserError, match="damaged"):
        stored.load(tmp_path, ENV, 0.0, 0.0)
