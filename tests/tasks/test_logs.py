"""Recorded situations as a task: a walk over all of them, a policy that acts as recorded, pictures, plain values."""

import imageio.v2 as imageio
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import recorded_situations as recorded

from cuelearner_jax import config as configuration
from cuelearner_jax.errors import UserError
from cuelearner_jax.spaces import Box
from cuelearner_jax.task import shape_of
from cuelearner_jax.tasks import logs, registry

CUES = "left,right;up,down;open,close"
BOUNDS = {"low": recorded.LOW, "high": recorded.HIGH}


@pytest.fixture
def folder(tmp_path):
    """A folder of twelve situations."""
    recorded.write(tmp_path / "situations")
    return tmp_path / "situations"


def at(row):
    """The beginning of an episode."""
    return logs.SituationState(jnp.int32(row), jnp.int32(0))


def quiet(words):
    """Nobody is told."""


def walked(env, steps):
    """Rows, observations and metrics of so many steps."""
    state, obs = env.reset(jax.random.key(3))
    rows, seen = [int(state.row)], [np.asarray(obs)]
    for _ in range(steps - 1):
        state, step = env.step(jax.random.key(0), state, jnp.zeros(3))
        rows.append(int(state.row))
        seen.append(np.asarray(step.obs))
    return rows, seen


@pytest.mark.parametrize("order", ["recorded", "shuffled"])
def test_a_walk_meets_every_situation_once(order, folder):
    observations, _ = recorded.arrays()
    task = logs.task_of(folder, CUES, **BOUNDS)
    env = task.environment(task.configure(order=order))
    rows, seen = walked(env, 12)
    assert sorted(rows) == list(range(12))
    places = np.asarray(env.places)
    np.testing.assert_array_equal(seen, observations[places[rows]])
    assert (places == np.arange(12)).all() == (order == "recorded")


def test_a_step_tells_how_far_the_action_is_from_the_recorded_one(folder):
    task = logs.task_of(folder, CUES, **BOUNDS)
    env = task.environment(task.plain())
    action = env.recorded[4] + jnp.array([0.0, 0.04, 0.0])  # a tenth of that entry's range
    _, step = env.step(jax.random.key(0), at(4), action)
    assert float(step.metrics["change"]) == pytest.approx(0.1, abs=1e-6)
    assert float(step.reward) == 0.0
    assert not bool(step.terminated)


def test_the_recorded_policy_acts_as_recorded_with_and_without_states(folder):
    task = logs.task_of(folder, CUES, **BOUNDS)
    env = task.environment(task.plain())
    policy, rows = logs.Recorded(env), jnp.array([7, 0, 3])
    for states in (logs.SituationState(rows, rows), None):
        found = policy.act(jax.random.key(0), states, env.rows[rows])
        np.testing.assert_allclose(found, env.recorded[rows], atol=1e-7)


def test_cues_have_the_words_the_names_of_the_recording_and_keys_of_their_own(folder):
    space = logs.space_of(logs.task_of(folder, CUES, **BOUNDS).plain())
    assert [(cue.name, cue.words) for cue in space.cues] == [
        ("sideways", ("left", "right")),
        ("height", ("up", "down")),
        ("fingers", ("open", "close")),
    ]
    assert space.cues[0].keys == ("ArrowLeft", "ArrowRight")
    keys = [key for cue in space.cues for key in cue.keys]
    assert len(set(keys)) == 6
    assert not {"a", "d"} & set(keys)  # which stand for the arrows too
    assert [cue.name for cue in logs.space_of(logs.task_of(folder, note=quiet).plain()).cues] == list(recorded.ENTRIES)
    with pytest.raises(UserError, match="give two keys for each of 3 cues"):
        logs.space_of(logs.task_of(folder, CUES, **BOUNDS).configure(keys=("q", "a")))


def test_bounds_are_those_of_the_recording_and_that_is_told(folder):
    told = []
    space = logs.space_of(logs.task_of(folder, CUES, note=told.append).plain())
    _, actions = recorded.arrays()
    np.testing.assert_allclose(space.low, actions.min(0), rtol=1e-6)
    np.testing.assert_allclose(space.high, actions.max(0), rtol=1e-6)
    (line,) = told
    assert "bounds of the actions are their range (sideways" in line
    assert "give low and high" in line


def test_a_configuration_is_plain_and_describes_the_layout_without_the_folder(folder):
    config = logs.task_of(folder, CUES, **BOUNDS).plain()
    assert configuration.from_json(logs.LogsConfig, configuration.to_json(config)) == config
    for file in folder.rglob("*.*"):
        file.unlink()
    view = logs.LOGS.view(config)
    assert view.actions == logs.space_of(config)
    assert [one.name for one in view.observation] == ["observation"]
    assert shape_of(logs.LOGS, config).rows.shape == (12, 4)


def test_networks_see_entries_of_the_order_of_one(folder):
    observations, _ = recorded.arrays()
    task = logs.task_of(folder, CUES, **BOUNDS)
    view = task.view(task.plain())
    first, high = jnp.asarray(observations[0]), jnp.asarray(recorded.HIGH)
    scaled = np.asarray(jax.vmap(lambda obs: view.features(obs, high).own)(jnp.asarray(observations)))
    np.testing.assert_allclose(scaled.mean(0), 0.0, atol=1e-5)
    np.testing.assert_allclose(scaled.std(0), 1.0, atol=1e-5)
    np.testing.assert_allclose(view.features(first, high).turned, 1.0, atol=1e-6)
    np.testing.assert_allclose(view.features(first, jnp.asarray([recorded.LOW] * 2)).turned, -1.0, atol=1e-6)


def test_other_situations_in_the_folder_are_refused(folder):
    config = logs.task_of(folder, CUES, **BOUNDS).plain()
    (folder / "situations.parquet").unlink()
    (folder / "pictures").rename(folder / "old")
    recorded.write(folder, rows=13)
    with pytest.raises(UserError, match="holds other situations than before"):
        logs.LOGS.environment(config)


def test_it_is_named_by_its_folder(folder):
    task = registry.resolve(f"logs:{folder}")
    assert task.name == "logs"
    assert isinstance(logs.space_of(task.plain()), Box)
    assert registry.find("logs") is logs.LOGS
    with pytest.raises(UserError, match="name their folder, as logs:FOLDER"):
        logs.LOGS.environment(logs.LOGS.plain())


@pytest.mark.parametrize(
    ("given", "told"),
    [
        ({"cues": "left,right;up,down"}, "2 pairs of words for 3 entries"),
        ({"low": (0.0,) * 3, "high": (0.1,) * 3}, "give bounds that hold the recorded actions"),
        ({"actions": "directions"}, r"\(directions, 2 entries\): give another kind"),
        ({"actions": "boxes"}, "did you mean 'box'"),
    ],
)
def test_what_does_not_fit_is_told(given, told, folder):
    with pytest.raises(UserError, match=told):
        logs.task_of(folder, **given, note=quiet)


def test_directions_and_choices_are_recorded_too(tmp_path):
    random = np.random.default_rng(0)
    angles = random.uniform(-np.pi, np.pi, 8)
    ways = np.stack([np.cos(angles), np.sin(angles)], -1)
    for name, actions in (("directions", ways), ("choices", np.eye(3)[random.integers(0, 3, 8)])):
        (tmp_path / name).mkdir()
        np.savez(tmp_path / name / "situations.npz", observation=random.normal(size=(8, 2)), action=actions)
        config = logs.task_of(tmp_path / name, "higher,lower" if name == "choices" else "", actions=name).plain()
        assert logs.space_of(config).name == name


def test_the_picture_of_a_situation_is_its_sketch(folder):
    task = logs.task_of(folder, CUES, **BOUNDS)
    env, drawn = task.environment(task.plain()), task.pictures()
    sketch = drawn.sketch(env, at(2))
    assert sketch.box[2:] == (16, 12)
    assert sketch.words == f"situation {int(env.places[2])}"
    assert drawn.reel(env, at(2), jnp.zeros(3)) is None
    frames, rewards = drawn.record(env, None, jax.random.key(0), 14)
    assert [int(frame[0, 0, 0]) for frame in frames[:12]] == np.asarray(env.places).tolist()
    assert rewards == [0.0] * 14


def test_a_clip_takes_its_time_and_a_row_without_a_picture_is_blank(tmp_path):
    film = [np.full((12, 16, 3), 2 * number, np.uint8) for number in range(90)]
    imageio.mimsave(tmp_path / "film.gif", film, duration=50)  # [ms]
    action = np.array([[-1.0], [1.0]])
    np.savez(tmp_path / "situations.npz", observation=action, action=action, picture=np.array(["film.gif", ""]))
    task = logs.task_of(tmp_path, note=quiet)
    env, drawn = task.environment(task.configure(order="recorded")), task.pictures()
    reel = drawn.reel(env, at(0), jnp.zeros(1))
    assert (len(reel.pictures), len(reel.pictures) * reel.period) == (60, pytest.approx(4.5))
    assert drawn.reel(env, at(1), jnp.zeros(1)) is None
    assert drawn.sketch(env, at(1)).words == "situation 1"
