"""Training a teacher: it learns a bandit whose best direction is known, can be stopped, keeps what is finite."""

from contextlib import contextmanager
from types import SimpleNamespace

import jax
import numpy as np
import probes
import pytest
import train_teacher
from _teacher_program import TeacherConfig

from cuelearner_jax import teachers
from cuelearner_jax.errors import UserError
from cuelearner_jax.terminal import Interrupted

TASK, WORLD = probes.make_task(), probes.WindowConfig()
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


@pytest.fixture(autouse=True)
def _two_stretches(monkeypatch):
    monkeypatch.setattr(train_teacher, "ROUNDS_A_STRETCH", 100)


def train(out, **changed):
    asked = train_teacher.Asked(WORLD, out, **{"teacher": CONFIG, "eval_steps": 20, **changed})
    return train_teacher.train(TASK, asked, "the command")


@pytest.fixture
def begun(tmp_path):
    """A training that Ctrl-C has stopped in its first stretch."""

    @contextmanager
    def interruptible():
        yield SimpleNamespace(is_set=lambda: True)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(train_teacher, "interruptible", interruptible)
        with pytest.raises(Interrupted, match="stopped at round 100"):
            train(tmp_path / "teacher")
    return tmp_path / "teacher"


@pytest.mark.long
def test_a_stopped_training_goes_on_to_the_same_teacher_and_mixes_with_nothing(begun, tmp_path):
    with pytest.raises(UserError, match="other values of seed"):
        train(begun, resume=True, seed=1)
    assert train(begun, resume=True) == train(tmp_path / "whole")
    assert {path.name for path in begun.iterdir()} == {"network", "teacher.json"}
    mine, yours = (
        jax.tree.leaves(teachers.load(folder, TASK.environment(WORLD), 0.0, 0.0).params)
        for folder in (begun, tmp_path / "whole")
    )
    for one, another in zip(mine, yours, strict=True):
        np.testing.assert_array_equal(one, another)
