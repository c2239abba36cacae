"""The folder of a teacher in training promises what a run's folder does; and nothing in it is not finite."""

import dataclasses
import fcntl
import json
import math
from contextlib import contextmanager

import jax
import numpy as np
import probes
import pytest

from cuelearner_jax.errors import NotFinite, UserError
from cuelearner_jax.storage.folders import LOCK
from cuelearner_jax.teachers import program, stored, training
from cuelearner_jax.teachers.learned import TeacherConfig
from cuelearner_jax.terminal import Interrupted

CONFIG = TeacherConfig(
    layers=(8,), tables=4, tries=4, search=8, directions=8, memory=2, updates=1, batch_size=8, rounds=4
)
TASK, WORLD = probes.make_task(), probes.WindowConfig()


@pytest.fixture(autouse=True, scope="module")
def compiled_once():
    """Two rounds a stretch; every training of these tests runs the same programs."""
    made = {}

    def make(config):
        if config not in made:
            made[config] = program.make_program(config)
        return made[config]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(training, "make_program", make)
        patch.setattr(training, "ROUNDS_A_STRETCH", 2)
        yield


def train(out, config=CONFIG, seed=0, **options):
    return training.train(TASK, WORLD, config, out, seed, 20, "cuelearner teacher train", **options)


@contextmanager
def stopped():
    """Ctrl-C in the first stretch."""

    class Event:
        def is_set(self):
            return True

    @contextmanager
    def interruptible():
        yield Event()

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(training, "interruptible", interruptible)
        yield


def weights(folder):
    return jax.tree.leaves(stored.load(folder, TASK.environment(WORLD), 0.0, 0.0).params)


def refused(out, says, **options):
    """Refused in one line that changes nothing but the mark of who writes there."""

    def files():
        return {name: found for name, found in probes.files_of(out).items() if name.name != LOCK}

    before = files()
    with pytest.raises(UserError, match=says):
        train(out, **options)
    assert files() == before


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    out = tmp_path_factory.mktemp("whole") / "teacher"
    train(out)
    return out


@pytest.fixture
def begun(tmp_path):
    out = tmp_path / "teacher"
    with stopped(), pytest.raises(Interrupted, match="stopped at round 2"):
        train(out)
    return out


@pytest.mark.long
def test_a_stopped_training_goes_on_to_the_same_teacher(whole, begun):
    train(begun, resume=True)
    assert {path.name for path in begun.iterdir()} == {LOCK, "network", "teacher.json"}
    for one, other in zip(weights(begun), weights(whole), strict=True):
        np.testing.assert_array_equal(one, other)
    told = json.loads((begun / "teacher.json").read_text())
    assert [row[0] for row in told["history"]["rows"]] == [2, 4]
    # A kill while the rest was tidied away: config.json goes first, so the teacher stays as it is.
    (begun / "training").mkdir()
    before = (begun / "teacher.json").read_bytes()
    train(begun, resume=True)
    assert (begun / "teacher.json").read_bytes() == before


def test_a_finished_teacher_is_left_as_it_is(whole):
    refused(whole, "not empty")
    refused(whole, "another config", resume=True, config=dataclasses.replace(CONFIG, rounds=6))
    refused(whole, "another seed", resume=True, seed=1)
    before = (whole / "teacher.json").read_bytes()
    assert train(whole, resume=True) == json.loads(before)["reward"]
    assert (whole / "teacher.json").read_bytes() == before


def test_what_is_begun_is_not_mixed_with_anything(begun, tmp_path):
    refused(begun, "--resume to go on")
    refused(begun, r"another config\.rounds", resume=True, config=dataclasses.replace(CONFIG, rounds=6))
    refused(begun, "another seed", resume=True, seed=1)
    with (begun / LOCK).open("r+") as other:
        fcntl.flock(other, fcntl.LOCK_EX)
        refused(begun, "is being written by", resume=True)
    for text in ("[[2, 0.1", "3", "[[1, 2, 3]]", '[["a", 1, 2, 3]]', "{}x", '{"a": 1}'):
        (begun / "history.json").write_text(text)
        refused(begun, "history.json is damaged: restore it, or delete it", resume=True)
    (begun / "history.json").unlink()
    train(begun, resume=True)
    (tmp_path / "thesis.txt").write_text("mine")
    refused(tmp_path, "not empty")
    refused(tmp_path, "nothing to resume", resume=True)


def test_a_training_that_diverges_stops_and_keeps_what_was_finite(begun):
    newest = begun / "training" / "2"
    before = probes.files_of(newest)
    usual = training.make_program(CONFIG)

    def poisoned(env, state, rounds):
        return usual.train(env, state.replace(params=jax.tree.map(lambda leaf: leaf * math.inf, state.params)), rounds)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(training, "make_program", lambda config: usual._replace(train=poisoned))
        with pytest.raises(NotFinite, match=r"by round 4, and was not written; .* holds the checkpoint of round 2"):
            train(begun, resume=True)
    assert probes.files_of(newest) == before
    assert not (begun / "teacher.json").exists()


def test_weights_beyond_half_precision_are_not_written(tmp_path):
    env = TASK.environment(WORLD)
    state = training.make_program(CONFIG).init(env, jax.random.key(0))
    huge = state.replace(average=jax.tree.map(lambda leaf: 1e6 + leaf, state.average))
    with pytest.raises(NotFinite, match="beyond 65"):
        stored.save(tmp_path / "teacher", program.finished(CONFIG, env, huge), {})
    assert not (tmp_path / "teacher").exists()


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"learning_rate": math.nan}, "positive, finite"),
        ({"learning_rate": math.inf}, "positive, finite"),
        ({"learning_rate": -1.0}, "positive, finite"),
        ({"explore_probability": math.nan}, "from 0 to 1"),
        ({"spread_deg": math.nan}, "from 0 to 180"),
        ({"tables": 0}, "teacher.tables is 0"),
        ({"tables": 10**12}, "at most 2147483647"),
        ({"rounds": 10**6, "updates": 10**6}, "teacher.rounds times teacher.updates"),
        ({"tries": 3}, "at least 4"),
        ({"layers": (8, 0)}, "positive width"),
    ],
    ids=str,
)
def test_settings_that_cannot_work_are_refused(tmp_path, change, says):
    refused(tmp_path / "new", says, config=dataclasses.replace(CONFIG, **change))


@pytest.mark.parametrize(
    ("seed", "steps", "says"),
    [(-1, 20, "--seed is -1"), (10**20, 20, "--seed"), (0, 0, "--eval-steps is 0"), (0, 150, "beyond 100 a multiple")],
)
def test_numbers_that_cannot_work_are_refused(seed, steps, says):
    with pytest.raises(UserError, match=says):
        training.check(CONFIG, seed, steps)


def test_the_memory_that_a_training_needs_grows_with_its_tables():
    env = TASK.environment(WORLD)
    few, many = (training.needed_bytes(dataclasses.replace(CONFIG, tables=n), env) for n in (1000, 10**9))
    assert many / few == pytest.approx(10**6, rel=0.05)
    kept = 10**9 * CONFIG.memory * (2 + 4 * 2 + 4) * 4  # observations, tries and rewards
    assert many > kept + 2 * 4 * 8 * 8 * 10**9
