"""Label files: they come back as they were, and files that do not fit are refused."""

import json

import numpy as np
import probes
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from cuelearner_jax.labelling import files

from cuelearner_jax.errors import UserError
from cuelearner_jax.runs import sweep
from cuelearner_jax.runs.grid import Grid

TASK = {"name": "window", "half_width_deg": 28.0}
EPS = probes.CONFIG.scalars.eps_deg


def label_sets(lanes=2, slots=20, obs_size=2, seed=0):
    rng = np.random.default_rng(seed)
    draw = lambda size: rng.normal(size=(lanes, slots, size)).astype(np.float32)  # noqa: E731
    valid = np.ones((lanes, slots), bool)
    return probes.label_set(draw(obs_size), draw(2), draw(2), valid)


@pytest.fixture
def path(tmp_path):
    return tmp_path / "labels.parquet"


def written(path, seeds=(4, 9), task=None, guidance="relative", eps_deg=EPS, **kinds):
    labels = label_sets(lanes=len(seeds), **kinds)
    files.write(path, task or TASK, guidance, eps_deg, np.array(seeds), labels)
    return labels


def test_labels_come_back_as_they_were(path):
    labels = written(path)
    file = files.read(path)
    assert file.task == TASK
    assert (file.guidance, file.eps_deg) == ("relative", EPS)
    assert file.seeds.tolist() == [4] * 20 + [9] * 20
    for name in ("obs", "action", "target"):
        np.testing.assert_array_equal(getattr(file.labels, name), getattr(labels, name).reshape(40, 2))
    assert file.labels.valid.all()
    assert sorted(entry.name for entry in path.parent.iterdir()) == ["labels.parquet"]


def test_only_labels_that_count_are_written(path):
    labels = label_sets()
    labels = labels.replace(valid=np.arange(20)[None] < np.array([[3], [0]]))
    files.write(path, TASK, "relative", EPS, np.array([4, 9]), labels)
    file = files.read(path)
    assert file.seeds.tolist() == [4] * 3
    np.testing.assert_array_equal(file.labels.obs, labels.obs[0, :3])


def test_what_the_numbers_mean_is_written_in_the_file(path):
    written(path)
    meta = json.loads(pq.read_schema(path).metadata[files.META])
    assert meta["conventions"]["angles"] == "radians, counterclockwise positive"
    assert set(meta["conventions"]) >= {"obs", "action", "target"}


def test_lanes_get_their_own_seeds_labels_padded(path):
    labels = written(path)
    rows = files.for_lanes(files.read(path), np.array([9, 4, 9]), np.array([20, 5, 12]), 30)
    assert rows.obs.shape == (3, 30, 2)
    assert rows.valid.sum(1).tolist() == [20, 5, 12]
    for lane, (source, budget) in enumerate([(1, 20), (0, 5), (1, 12)]):
        assert rows.valid[lane, :budget].all()
        np.testing.assert_array_equal(rows.target[lane, :budget], labels.target[source, :budget])
        np.testing.assert_array_equal(rows.target[lane, budget:], 0)


def test_one_set_serves_every_seed(path):
    labels = written(path, seeds=(7,))
    rows = files.for_lanes(files.read(path), np.array([0, 1]), np.array([20, 20]), 20)
    np.testing.assert_array_equal(rows.obs, np.repeat(labels.obs, 2, 0))


def test_too_few_labels_and_missing_seeds_are_refused(path):
    written(path)
    with pytest.raises(UserError, match="has 20 labels for seed 4, the budget is 21"):
        files.for_lanes(files.read(path), np.array([4]), np.array([21]), 30)
    with pytest.raises(UserError, match="has 0 labels for seed 5"):
        files.for_lanes(files.read(path), np.array([5]), np.array([1]), 30)


def test_a_missing_file_is_refused(path):
    with pytest.raises(UserError, match="no label file"):
        files.read(path)
    with pytest.raises(UserError, match="no label file"):
        files.read(path.parent)


def test_a_file_without_labels_is_refused(path):
    labels = label_sets()
    files.write(path, TASK, "relative", EPS, np.array([4, 9]), labels.replace(valid=np.zeros((2, 20), bool)))
    with pytest.raises(UserError, match="holds no labels"):
        files.read(path)


def damaged_at(path, where, length):
    content = bytearray(path.read_bytes())
    content[where : where + length] = bytes(length)
    path.write_bytes(content)


@pytest.mark.parametrize("share", [0.0, 0.1, 0.3, 0.5, 0.7, 0.9, 0.97])
def test_a_damaged_file_is_refused(path, share):
    written(path)
    damaged_at(path, int(share * path.stat().st_size), 60)
    with pytest.raises(UserError, match="damaged"):
        files.read(path)


@pytest.mark.parametrize("share", [0.0, 0.5, 0.99])
def test_a_cut_off_file_is_refused(path, share):
    written(path)
    path.write_bytes(path.read_bytes()[: int(share * path.stat().st_size)])
    with pytest.raises(UserError, match="damaged"):
        files.read(path)


def test_text_and_foreign_tables_are_refused(path):
    path.write_text("seed,obs\n1,2\n")
    with pytest.raises(UserError, match="not a label file"):
        files.read(path)
    pq.write_table(pa.table({"seed": [1]}), path)
    with pytest.raises(UserError, match="not a label file"):
        files.read(path)
    pq.write_table(pa.table({"seed": [1]}).replace_schema_metadata({files.META: b"{}"}), path)
    with pytest.raises(UserError, match="not a label file"):
        files.read(path)


@pytest.mark.parametrize("missing", ["task", "guidance", "eps_deg"])
def test_a_file_that_does_not_say_what_it_holds_is_refused(path, missing):
    written(path)
    table = pq.read_table(path)
    meta = json.loads(table.schema.metadata[files.META])
    del meta[missing]
    pq.write_table(table.replace_schema_metadata({files.META: json.dumps(meta).encode()}), path)
    with pytest.raises(UserError, match="not a label file"):
        files.read(path)


GRID = Grid(("none", "relative"), seeds=(4, 9), labels=(10, 15))


def read_for(path, grid=GRID, task=None):
    return sweep.read_labels(path, task or probes.make_task(), probes.CONFIG, grid)


def test_labels_that_fit_a_run(path):
    written(path)
    assert len(read_for(path).seeds) == 40


def test_labels_of_another_task_are_refused(path):
    written(path, task={"name": "billiards"})
    with pytest.raises(UserError, match="labels of billiards"):
        read_for(path)


def test_labels_of_other_observations_are_refused(path):
    written(path, obs_size=3)
    with pytest.raises(UserError, match="3 observations"):
        read_for(path)


def test_labels_of_another_guidance_are_refused(path):
    written(path, guidance="demonstration")
    with pytest.raises(UserError, match="demonstration labels"):
        read_for(path)


def test_labels_of_another_strength_are_refused(path):
    written(path, eps_deg=EPS / 2)
    with pytest.raises(UserError, match=f"give --scalars.eps-deg {EPS / 2:g}"):
        read_for(path)


def test_a_digest_tells_contents_apart(path):
    written(path)
    first = files.digest(path)
    written(path)
    assert files.digest(path) == first
    written(path, seed=1)
    assert files.digest(path) != first


def test_labels_for_a_grid_that_asks_for_none_are_refused(path):
    written(path)
    with pytest.raises(UserError, match="--guidance relative"):
        read_for(path, Grid(("none", "heuristic"), seeds=(4, 9), labels=(10,)))


def test_a_budget_beyond_the_file_is_refused(path):
    written(path)
    with pytest.raises(UserError, match="the budget is 21"):
        read_for(path, Grid(("relative",), seeds=(4, 9), labels=(10, 21)))
