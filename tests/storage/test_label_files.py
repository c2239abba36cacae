"""Label files: they come back as they were, a kill loses nothing that was said, and damaged files are refused."""

import json

import numpy as np
import probes
import pytest

from cuelearner_jax.errors import UserError
from cuelearner_jax.spaces import DIRECTIONS
from cuelearner_jax.storage import label_files as files
from cuelearner_jax.storage import table as tables

TASK = {"name": "window", "half_width_deg": 28.0}
EPS = 20.0
NAMES = ("obs", "action", "answer")


def label_sets(lanes=2, slots=20, obs_size=3, width=1, seed=0):
    rng = np.random.default_rng(seed)
    draw = lambda size: rng.normal(size=(lanes, slots, size)).astype(np.float32)  # noqa: E731
    return probes.label_set(draw(obs_size), draw(2), np.sign(draw(width)), np.ones((lanes, slots), bool))


@pytest.fixture
def path(tmp_path):
    return tmp_path / "labels.parquet"


def written(path, seeds=(4, 9), task=None, answers="relative", eps_deg=EPS, **kinds):
    labels = label_sets(lanes=len(seeds), **kinds)
    files.write(path, task or TASK, answers, DIRECTIONS, eps_deg, np.array(seeds), labels)
    return labels


def test_labels_come_back_as_they_were(path):
    labels = written(path)
    file = files.read(path)
    assert file.task == TASK
    assert (file.answers, file.space, file.eps) == ("relative", DIRECTIONS, EPS)
    assert file.seeds.tolist() == [4] * 20 + [9] * 20
    for name in NAMES:
        whole = getattr(labels, name)
        np.testing.assert_array_equal(getattr(file.labels, name), whole.reshape(40, whole.shape[-1]))
    assert file.labels.valid.all()
    assert sorted(entry.name for entry in path.parent.iterdir()) == ["labels.parquet"]


def test_only_labels_that_count_are_written(path):
    labels = label_sets()
    labels = labels.replace(valid=np.arange(20)[None] < np.array([[3], [0]]))
    files.write(path, TASK, "relative", DIRECTIONS, EPS, np.array([4, 9]), labels)
    file = files.read(path)
    assert file.seeds.tolist() == [4] * 3
    np.testing.assert_array_equal(file.labels.obs, labels.obs[0, :3])


def test_lanes_get_their_own_seeds_labels_padded(path):
    labels = written(path)
    rows = files.for_lanes(files.read(path), np.array([9, 4, 9]), np.array([20, 5, 12]), 30)
    assert rows.obs.shape == (3, 30, 3)
    assert rows.answer.shape == (3, 30, 1)
    assert rows.valid.sum(1).tolist() == [20, 5, 12]
    for lane, (source, budget) in enumerate([(1, 20), (0, 5), (1, 12)]):
        assert rows.valid[lane, :budget].all()
        np.testing.assert_array_equal(rows.answer[lane, :budget], labels.answer[source, :budget])
        np.testing.assert_array_equal(rows.answer[lane, budget:], 0)


def test_one_set_serves_every_seed_and_missing_labels_are_refused(path):
    labels = written(path, seeds=(7,))
    rows = files.for_lanes(files.read(path), np.array([0, 1]), np.array([20, 20]), 20)
    np.testing.assert_array_equal(rows.obs, np.repeat(labels.obs, 2, 0))
    written(path)
    with pytest.raises(UserError, match="has 20 labels for seed 4, the budget is 21"):
        files.for_lanes(files.read(path), np.array([4]), np.array([21]), 30)
    with pytest.raises(UserError, match="labels for the seeds 4, 9, none for seed 5: give --seeds"):
        files.for_lanes(files.read(path), np.array([5]), np.array([1]), 30)
    written(path, seeds=(3, 4, 5, 6))
    with pytest.raises(UserError, match="labels for the seeds 3 to 6, none for seed 7"):
        files.for_lanes(files.read(path), np.array([7]), np.array([1]), 30)


def test_a_digest_tells_contents_apart(path):
    written(path)
    first = files.digest(path)
    written(path)
    assert files.digest(path) == first
    written(path, seed=1)
    assert files.digest(path) != first


# Files that cannot be read.


def test_no_file_and_a_file_without_labels_are_refused(path):
    for missing in (path, path.parent):
        with pytest.raises(UserError, match="no label file"):
            files.read(missing)
    labels = label_sets().replace(valid=np.zeros((2, 20), bool))
    files.write(path, TASK, "relative", DIRECTIONS, EPS, np.array([4, 9]), labels)
    with pytest.raises(UserError, match="holds no labels"):
        files.read(path)


GOOD = {"format": 1, "task": TASK, "answers": "relative", "space": DIRECTIONS.to_json(), "eps": EPS}
LINE = {"seed": 0, "obs": [0.1, 0.2], "action": [0.0, 1.0], "answer": [1.0]}


@pytest.mark.parametrize(
    ("head", "row", "says"),
    [
        ({"format": 2}, {}, "is of format 2"),
        ({"format": None}, {}, "not a label file"),
        ({"task": None}, {}, "not a label file"),
        ({"space": {}}, {}, "not a label file"),
        ({}, {"obs": [0.1]}, "not a label file"),
        ({}, {"seed": 0.5}, "not a label file"),
    ],
)
def test_a_head_or_a_row_that_means_nothing_is_refused(tmp_path, head, row, says):
    lines = [{"about": {**GOOD, **head}}, LINE, {**LINE, **row}]
    (tmp_path / files.JSONL).write_text("".join(json.dumps(line) + "\n" for line in lines))
    with pytest.raises(UserError, match=says) as refusal:
        files.read(tmp_path)
    assert "\n" not in str(refusal.value)


# One label at a time.


def said(folder, numbers, answers="relative", eps_deg=EPS):
    """Appends some of the labels of `label_sets(1)`, by number."""
    labels = label_sets(lanes=1)
    with files.LabelWriter(folder, TASK, answers, DIRECTIONS, eps_deg) as writer:
        for index in numbers:
            writer.append(seed=7, **{name: getattr(labels, name)[0, index] for name in NAMES})
    return labels


def assert_holds(file, labels, count):
    assert (file.task, file.answers, file.space, file.eps) == (TASK, "relative", DIRECTIONS, EPS)
    assert file.seeds.tolist() == [7] * count
    for name in NAMES:
        np.testing.assert_array_equal(getattr(file.labels, name), getattr(labels, name)[0, :count])


def test_a_finished_session_is_a_label_file_and_can_be_continued(tmp_path):
    labels = said(tmp_path, range(20))
    assert tables.finish(tmp_path, files.SCHEMA) == tmp_path / files.PARQUET
    assert [entry.name for entry in tmp_path.iterdir()] == [files.PARQUET]
    assert_holds(files.read(tmp_path / files.PARQUET), labels, 20)
    files.write(tmp_path / "whole.parquet", TASK, "relative", DIRECTIONS, EPS, np.array([7]), labels)
    assert (tmp_path / "whole.parquet").read_bytes() == (tmp_path / files.PARQUET).read_bytes()
    before = files.digest(tmp_path)
    said(tmp_path, [])  # opened again, without another answer
    assert not (tmp_path / files.PARQUET).exists()
    assert files.digest(tmp_path) == before
    said(tmp_path, [3])
    assert len(files.read(tmp_path / files.JSONL).seeds) == 21
    assert files.digest(tmp_path) != before


def test_a_label_that_could_not_be_read_is_not_written(tmp_path):
    labels = said(tmp_path, range(2))
    row = {name: getattr(labels, name)[0, 2] for name in NAMES}
    with files.LabelWriter(tmp_path, TASK, "relative", DIRECTIONS, EPS) as writer:
        writer.append(seed=7, **row)
        for name, wrong, message in (
            ("action", np.array([np.inf, 0.0]), "action is not finite"),
            ("answer", np.array([np.nan]), "answer is not finite"),
        ):
            with pytest.raises(ValueError, match=message):
                writer.append(seed=7, **{**row, name: wrong})
    assert_holds(files.read(tmp_path / files.JSONL), labels, 3)
