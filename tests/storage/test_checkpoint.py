"""Checkpoints: what was saved comes back bit by bit, and what cannot be read is said in one line."""

import hashlib
import shutil

import jax
import jax.numpy as jnp
import numpy as np
import orbax.checkpoint as ocp
import probes
import pytest

from cuelearner_jax.errors import UserError
from cuelearner_jax.storage import checkpoint
from cuelearner_jax.storage.checkpoint import KEPT, checkpoints

pytestmark = pytest.mark.usefixtures("garbage_of_its_own")


def state(seed=0):
    """Everything that a lane may hold: keys, empty leaves, missing subtrees, all kinds of numbers."""
    rng = np.random.default_rng(seed)
    return {
        "block": [
            {"weights": jnp.array(rng.normal(size=(3, 400)), jnp.float32), "flags": jnp.array([True, False, True])},
            {"keys": jax.random.split(jax.random.key(seed), 3), "empty": jnp.zeros((3, 0)), "none": None, "bare": {}},
        ],
        "numbers": (jnp.array(7 + seed, jnp.int32), np.float32(0.1 + seed), jnp.array(rng.normal(size=2), jnp.float16)),
    }


def shapes(tree):
    return jax.tree.map(lambda leaf: jax.ShapeDtypeStruct(leaf.shape, leaf.dtype), tree)


def assert_bitwise(mine, theirs):
    assert jax.tree.structure(mine) == jax.tree.structure(theirs)
    for one, other in zip(jax.tree.leaves(mine), jax.tree.leaves(theirs), strict=True):
        assert (one.shape, one.dtype) == (other.shape, other.dtype)
        one, other = (probes.words(leaf) for leaf in (one, other))  # noqa: PLW2901
        np.testing.assert_array_equal(np.asarray(one), np.asarray(other))


def save(folder, *numbers):
    with checkpoints(folder) as saved:
        for number in numbers:
            saved.save(number, {"policy": state(number), "rest": state(number + 100)})


def restore(folder, like=None, read_only=True):
    with checkpoints(folder, read_only) as saved:
        return saved.restore({"policy": shapes(state())} if like is None else like)


@pytest.mark.parametrize("like", [pytest.param(lambda item: item, marks=pytest.mark.long), shapes])
def test_everything_comes_back_bit_by_bit(tmp_path, like):
    save(tmp_path, 3)
    found = restore(tmp_path, {"policy": like(state()), "rest": like(state())}, read_only=False)
    assert_bitwise(found, {"policy": state(3), "rest": state(103)})
    # A key that came back draws what it would have drawn.
    drawn = jax.random.uniform(found["policy"]["block"][1]["keys"][1])
    assert drawn == jax.random.uniform(state(3)["block"][1]["keys"][1])


@pytest.mark.long
def test_numbers_that_are_not_finite_come_back(tmp_path):
    odd = {"a": jnp.array([jnp.nan, jnp.inf, -jnp.inf, -0.0, 1e-42])}
    with checkpoints(tmp_path) as saved:
        saved.save(0, {"odd": odd})
    found = np.asarray(restore(tmp_path, {"odd": odd})["odd"]["a"])
    np.testing.assert_array_equal(found.view(np.int32), np.asarray(odd["a"]).view(np.int32))


def test_a_part_can_be_read_without_the_rest(tmp_path):
    save(tmp_path, 3)
    for path in (tmp_path / "3" / "rest").rglob("*"):
        if path.is_file():
            path.unlink()
    assert_bitwise(restore(tmp_path), {"policy": state(3)})


def test_the_newest_two_are_kept_and_the_newest_is_read(tmp_path):
    save(tmp_path, 1, 5, 12)
    assert KEPT == 2
    assert sorted(path.name for path in tmp_path.iterdir()) == ["12", "5"]
    with checkpoints(tmp_path) as saved:
        assert saved.latest() == 12
    assert_bitwise(restore(tmp_path), {"policy": state(12)})


def test_a_deleted_newest_leads_back_to_the_one_before(tmp_path):
    save(tmp_path, 1, 5)
    (tmp_path / "5").rename(tmp_path.parent / "elsewhere")
    assert_bitwise(restore(tmp_path), {"policy": state(1)})
    save(tmp_path, 7)
    assert_bitwise(restore(tmp_path), {"policy": state(7)})


def test_a_save_that_was_killed_does_not_count(tmp_path):
    save(tmp_path, 1, 5)
    (tmp_path / "5").rename(tmp_path / "5.orbax-checkpoint-tmp-0")
    assert_bitwise(restore(tmp_path), {"policy": state(1)})


def test_no_checkpoint_is_said_so(tmp_path):
    with checkpoints(tmp_path) as saved:
        assert saved.latest() is None
    with pytest.raises(UserError, match="stopped before its first checkpoint"):
        restore(tmp_path)


@pytest.mark.parametrize("content", [b"", b"\0" * 100], ids=["emptied", "zeroed"])
def test_a_damaged_checkpoint_is_refused(tmp_path, content):
    save(tmp_path, 5)
    policy = tmp_path / "5" / "policy"
    files = [path for path in policy.rglob("*") if path.is_file()]
    for path in (max(files, key=lambda path: path.stat().st_size), policy / "manifest.ocdbt"):  # the numbers first
        whole = path.read_bytes()
        path.write_bytes(content)
        with pytest.raises(UserError, match=r"checkpoint 5 in .* cannot be read .*: it is damaged") as refusal:
            restore(tmp_path)
        assert "\n" not in str(refusal.value)
        path.write_bytes(whole)


@pytest.mark.long
def test_no_changed_bit_of_a_checkpoint_goes_unnoticed(tmp_path):
    """Orbax alone reads some of these without a word."""
    save(tmp_path, 5)
    rng = np.random.default_rng(0)
    files = [path for path in (tmp_path / "5" / "policy").rglob("*") if path.is_file()]
    largest = max(files, key=lambda path: path.stat().st_size)  # the numbers themselves
    whole, refused = largest.read_bytes(), 0
    for bit in rng.integers(0, 8 * len(whole), 6):
        spoilt = bytearray(whole)
        spoilt[bit // 8] ^= 1 << bit % 8
        largest.write_bytes(spoilt)
        try:
            assert_bitwise(restore(tmp_path), {"policy": state(5)})
        except UserError as error:
            assert "damaged" in str(error)
            refused += 1
    assert refused > 3


def test_numbers_that_others_put_in_place_are_refused(tmp_path):
    save(tmp_path / "mine", 5)
    save(tmp_path / "theirs", 6)
    shutil.rmtree(tmp_path / "mine" / "5" / "policy")
    shutil.copytree(tmp_path / "theirs" / "6" / "policy", tmp_path / "mine" / "5" / "policy")
    with pytest.raises(UserError, match=r"policy\['block'\].* is not what was written.*it is damaged"):
        restore(tmp_path / "mine")
    shutil.rmtree(tmp_path / "mine" / "5" / "digests")
    with pytest.raises(UserError, match="cannot be read"):
        restore(tmp_path / "mine")


def test_a_checkpoint_that_may_not_be_read_is_not_called_damaged(tmp_path, monkeypatch):
    save(tmp_path, 5)

    def forbidden(*_, **__):
        raise ValueError("PERMISSION_DENIED: Error opening file")

    monkeypatch.setattr(ocp.CheckpointManager, "restore", forbidden)
    with pytest.raises(UserError, match="check the permissions of its files, nothing was changed") as refusal:
        restore(tmp_path)
    assert "delete" not in str(refusal.value)


def test_the_digest_of_an_array_is_that_of_its_values_however_it_is_cut():
    values = np.arange(24, dtype=np.float32).reshape(8, 3)
    digest = checkpoint._digest
    expected = hashlib.sha256(b"(8, 3) float32" + values.tobytes()).hexdigest()
    assert digest(values) == digest(jnp.asarray(values)) == expected
    others = (values, values.T, values.astype(np.float64), values.reshape(-1), -values)
    assert len({digest(other) for other in others}) == len(others)


def other(change):
    like = shapes(state())
    change(like["block"][0])
    return {"policy": like}


OTHERS = {
    "wider": lambda item: item.update(weights=jax.ShapeDtypeStruct((3, 401), jnp.float32)),
    "fewer lanes": lambda item: item.update(weights=jax.ShapeDtypeStruct((2, 400), jnp.float32)),
    "flat": lambda item: item.update(weights=jax.ShapeDtypeStruct((1200,), jnp.float32)),
    "one more": lambda item: item.update(more=jax.ShapeDtypeStruct((2,), jnp.float32)),
    "one fewer": lambda item: item.pop("weights"),
}


@pytest.mark.parametrize("change", ["wider", *(pytest.param(name, marks=pytest.mark.long) for name in [*OTHERS][1:])])
def test_a_checkpoint_of_other_shapes_is_refused(tmp_path, change):
    save(tmp_path, 5)
    with pytest.raises(UserError, match="of another configuration, or of another version") as refused:
        restore(tmp_path, other(OTHERS[change]))
    assert "delete" not in str(refused.value)  # nothing is wrong with it


def test_a_checkpoint_knows_its_run(tmp_path):
    for run in ("mine", ""):
        with checkpoints(tmp_path / run, run=run) as saved:
            saved.save(1, {"policy": state()})
        with checkpoints(tmp_path / run, read_only=True, run=run) as saved:
            saved.restore({"policy": shapes(state())})
    with (
        checkpoints(tmp_path / "mine", read_only=True, run="yours") as saved,
        pytest.raises(UserError, match="it belongs to another run"),
    ):
        saved.restore({"policy": shapes(state())})


def test_an_item_that_was_never_saved_is_refused(tmp_path):
    save(tmp_path, 5)
    with pytest.raises(UserError, match="cannot be read"):
        restore(tmp_path, {"clock": shapes(state())})


def test_reading_changes_nothing_on_disk(tmp_path):
    save(tmp_path, 1, 5)
    (tmp_path / "6.orbax-checkpoint-tmp-0").mkdir()
    before = probes.files_of(tmp_path)
    assert before
    restore(tmp_path)
    with checkpoints(tmp_path, read_only=True) as saved:
        assert saved.latest() == 5
    assert probes.files_of(tmp_path) == before
