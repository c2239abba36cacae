"""A teacher's folder: what is kept of its network, and what is refused."""

import jax
import jax.numpy as jnp
import numpy as np
import probes
import pytest

from cuelearner_jax import teachers
from cuelearner_jax.errors import UserError
from cuelearner_jax.spaces import directions
from cuelearner_jax.teachers import LearnedTeacher, init_params

ENV = probes.Window(mirrors=True)
ABOUT = {"config": {"layers": [32, 32], "directions": 72}}
OBS = directions.evenly_spaced(4)


@pytest.fixture(scope="module")
def made():
    return LearnedTeacher(ENV, init_params((32, 32), ENV, jax.random.key(0)), 0.0, 0.0, (32, 32), 72)


def test_it_comes_back_from_disk_in_half_precision(made, tmp_path):
    teachers.save(tmp_path / "made", made, ABOUT)
    loaded = teachers.load(tmp_path / "made", ENV, 0.2, 0.1)
    for mine, yours in zip(jax.tree.leaves(loaded.params), jax.tree.leaves(made.params), strict=True):
        assert mine.dtype == jnp.float32
        np.testing.assert_array_equal(mine, np.asarray(yours).astype(np.float16).astype(np.float32))
    assert (float(loaded.aim_error), float(loaded.habit)) == pytest.approx((0.2, 0.1))
    assert (loaded.layers, loaded.directions) == ((32, 32), 72)
    np.testing.assert_allclose(loaded.values(OBS[1], OBS), made.values(OBS[1], OBS), atol=5e-3)


def test_a_teacher_of_another_task_is_refused(made, tmp_path):
    teachers.save(tmp_path, made, ABOUT)
    probes.edit_json(tmp_path / "teacher.json", lambda about: about["config"].update(layers=[32]))
    with pytest.raises(UserError, match="another configuration or version of the program"):
        teachers.load(tmp_path, ENV, 0.0, 0.0)
