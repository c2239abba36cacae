"""Checkpoints: what was saved comes back bit by bit, and what cannot be read is said in one line."""

import shutil

import jax
import jax.numpy as jnp
import numpy as np
import probes
import pytest

from cuelearner_jax.errors import UserError
from cuelearner_jax.storage import checkpoint
from cuelearner_jax.storage.checkpoint import MOST_CHECKPOINTS, Checkpoints

pytestmark = pytest.mark.usefixtures("garbage_of_its_own")


def state(seed=0):
    """Everything that a lane may hold: keys, empty leaves, missing subtrees, all kinds of numbers."""
    rng = np.random.default_rng(seed)
    odd = jnp.array([jnp.nan, jnp.inf, -jnp.inf, -0.0, 1e-42])
    return {
        "block": [
            {"weights": jnp.array(rng.normal(size=(3, 400)), jnp.float32), "flags": jnp.array([True, False, True])},
            {"keys": jax.random.split(jax.random.key(seed), 3), "empty": jnp.zeros((3, 0)), "none": None, "bare": {}},
        ],
        "numbers": (jnp.array(7 + seed, jnp.int32), np.float32(0.1 + seed), jnp.array([0.5], jnp.float16), odd),
    }


def shapes(tree):
    return jax.tree.map(lambda leaf: jax.ShapeDtypeStruct(leaf.shape, leaf.dtype), tree)


def assert_bitwise(mine, theirs):
    assert jax.tree.structure(mine) == jax.tree.structure(theirs)
    for one, other in zip(jax.tree.leaves(mine), jax.tree.leaves(theirs), strict=True):
        assert (one.shape, one.dtype) == (other.shape, other.dtype)
        assert np.asarray(probes.words(one)).tobytes() == np.asarray(probes.words(other)).tobytes()


def save(folder, *numbers, run=""):
    with Checkpoints(folder, run=run) as saved:
        for number in numbers:
            saved.save(number, {"policy": state(number), "rest": state(number + 100)})


def restore(folder, like=None, read_only=True, run=""):
    with Checkpoints(folder, read_only, run=run) as saved:
        return saved.restore({"policy": shapes(state())} if like is None else like)


@pytest.fixture(scope="module")
def saved(tmp_path_factory):
    """Checkpoints 5 and 12; nobody writes there."""
    folder = tmp_path_factory.mktemp("checkpoints")
    save(folder, 1, 5, 12, run="mine")
    return folder


def test_the_newest_comes_back_bit_by_bit(saved):
    found = restore(saved, {"policy": shapes(state()), "rest": state()}, run="mine")
    assert_bitwise(found, {"policy": state(12), "rest": state(112)})
    # A key that came back draws what it would have drawn.
    mine, its = (of["block"][1]["keys"][1] for of in (found["policy"], state(12)))
    assert jax.random.uniform(mine) == jax.random.uniform(its)
    assert sorted(path.name for path in saved.iterdir()) == ["12", "5"]
    assert MOST_CHECKPOINTS == 2


def test_a_part_can_be_read_without_the_rest_and_reading_changes_nothing(saved, tmp_path):
    folder = shutil.copytree(saved, tmp_path / "copy")
    shutil.rmtree(folder / "12" / "rest")
    (folder / "13.orbax-checkpoint-tmp-0").mkdir()  # a save that was killed does not count
    before = probes.files_of(folder)
    assert_bitwise(restore(folder, run="mine"), {"policy": state(12)})
    assert probes.files_of(folder) == before


def test_no_checkpoint_is_said_so(tmp_path):
    with Checkpoints(tmp_path) as opened:
        assert opened.latest() is None
        with pytest.raises(UserError, match="stopped before its first checkpoint"):
            opened.restore({"policy": state()})


def test_numbers_that_others_put_in_place_are_refused(saved, tmp_path):
    folder = shutil.copytree(saved, tmp_path / "copy")
    shutil.rmtree(folder / "12" / "policy")
    shutil.copytree(folder / "5" / "policy", folder / "12" / "policy")
    with pytest.raises(UserError, match=r"policy is not what was written.*if it is damaged"):
        restore(folder, run="mine")
    shutil.rmtree(folder / "12" / "digests")
    with pytest.raises(UserError, match="cannot be read"):
        restore(folder, run="mine")


def changed(change):
    like = shapes(state())
    change(like["block"][0])
    return {"policy": like}


@pytest.mark.parametrize(
    "like",
    [
        changed(lambda item: item.update(weights=jax.ShapeDtypeStruct((2, 400), jnp.float32))),
        changed(lambda item: item.update(more=jax.ShapeDtypeStruct((2,), jnp.float32))),
        changed(lambda item: item.pop("weights")),
        {"clock": state()},
    ],
    ids=["fewer lanes", "one more", "one fewer", "an item never saved"],
)
def test_a_checkpoint_of_other_shapes_is_refused(saved, like):
    with pytest.raises(UserError, match="if it is of another configuration or version") as refused:
        restore(saved, like, run="mine")
    assert "\n" not in str(refused.value)


def test_a_checkpoint_knows_its_run(saved):
    with pytest.raises(UserError, match="it belongs to another run"):
        restore(saved, run="yours")


def test_the_digest_of_an_array_is_that_of_its_values_however_it_is_cut():
    values = np.arange(24, dtype=np.float32).reshape(8, 3)
    assert checkpoint.digest([values]) == checkpoint.digest([jnp.asarray(values)])
    others = (values, values.T, values.astype(np.float64), values.reshape(-1), -values)
    assert len({checkpoint.digest([other]) for other in others}) == len(others)
