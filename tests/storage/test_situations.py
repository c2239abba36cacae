"""Recorded situations: three forms of a folder and a LeRobot dataset say the same; what is wrong is told in a line."""

import io
import json
import pickle

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import recorded_situations as recorded
from PIL import Image

from cuelearner_jax.environment import BASE, PROPOSED
from cuelearner_jax.errors import UserError
from cuelearner_jax.storage import situations


@pytest.mark.parametrize("form", ["parquet", "csv", "npz"])
def test_a_folder_is_read(form, tmp_path):
    observations, actions = recorded.write(tmp_path / "there", form=form)
    found = situations.read(tmp_path / "there")
    np.testing.assert_array_equal(found.observations, observations)
    np.testing.assert_array_equal(found.actions, actions)
    assert found.entries == (() if form == "npz" else recorded.ENTRIES)
    assert [(one.name, one.size) for one in found.slices] == [("observation", 4)]
    picture = found.picture(7)
    assert picture.kind == "image/png"
    assert Image.open(io.BytesIO(picture.data)).getpixel((0, 0)) == (7, 0, 0)


def test_a_lerobot_dataset_is_read(tmp_path):
    observations, actions = recorded.write_lerobot(tmp_path / "set", video_fps=30)  # the data's rate is 10
    found = situations.read(tmp_path / "set")
    np.testing.assert_array_equal(found.observations, observations)
    np.testing.assert_array_equal(found.actions, actions)
    assert [one.name for one in found.slices] == ["shoulder", "elbow", "wrist", "jaw"]
    assert found.entries == recorded.ENTRIES
    for row in (0, 4, 5, 11):  # of both episodes, which share a video
        shade = np.asarray(Image.open(io.BytesIO(found.picture(row).data)).convert("L")).mean()
        assert shade == pytest.approx(20 * row, abs=4)


def test_parts_nested_names_and_booleans_of_a_lerobot_dataset_are_read(tmp_path):
    observations, actions = recorded.write_lerobot(tmp_path / "set")
    path = tmp_path / "set/meta/info.json"
    info = json.loads(path.read_text())
    del info["features"]["action"]
    info["features"] |= {
        "action.left": {"dtype": "float32", "shape": [2], "names": {"arm": ["x"], "hand": [["grip"]]}},
        "action.open": {"dtype": "bool", "shape": [1], "names": {"open": 0}},
    }
    path.write_text(json.dumps(info))
    for file in (tmp_path / "set/data/chunk-000").iterdir():
        stored = pq.read_table(file)
        rows = stored["action"].to_pylist()
        left, is_open = pa.array([row[:2] for row in rows]), pa.array([row[2] > 0 for row in rows])
        pq.write_table(stored.append_column("action.left", left).append_column("action.open", is_open), file)
    found = situations.read(tmp_path / "set")
    assert found.entries == ("left: x", "left: grip", "open: open")
    np.testing.assert_array_equal(found.actions, np.c_[actions[:, :2], actions[:, 2] > 0])
    np.testing.assert_array_equal(found.observations, observations)


def test_pictures_alone_are_read_as_proposed_actions_and_interventions_left_out(tmp_path):
    _, actions = recorded.write_lerobot(tmp_path / "set")
    path = tmp_path / "set/meta/info.json"
    info = json.loads(path.read_text())
    del info["features"]["observation.state"]
    info["features"]["intervention"] = {"dtype": "bool", "shape": [1], "names": None}
    path.write_text(json.dumps(info))
    for file in (tmp_path / "set/data/chunk-000").iterdir():
        stored = pq.read_table(file)
        took_over = pa.array([frame == 2 for frame in stored["frame_index"].to_pylist()])
        pq.write_table(stored.append_column("intervention", took_over), file)
    found = situations.read(tmp_path / "set")
    rows = [row for row in range(12) if row not in (2, 7)]
    np.testing.assert_array_equal(found.actions, actions[rows])
    np.testing.assert_array_equal(found.observations, found.actions)
    assert [(one.name, one.kind) for one in found.slices] == [(BASE, PROPOSED)]
    shade = np.asarray(Image.open(io.BytesIO(found.picture(6).data)).convert("L")).mean()
    assert shade == pytest.approx(20 * rows[6], abs=4)


def test_proposed_actions_are_part_of_what_is_observed(tmp_path):
    columns = GOOD | {"phase": [0.0, 0.5], "text": ["pick", ""]}
    (tmp_path / "there").mkdir()
    stored = pa.table(columns).replace_schema_metadata({"cuelearner": json.dumps({"low": [-1.0], "high": [2.0]})})
    pq.write_table(stored, tmp_path / "there/situations.parquet")
    found = situations.read(tmp_path / "there")
    np.testing.assert_array_equal(found.observations, [[0.0, 1.0, 0.0, 0.5], [2.0, 3.0, 0.5, 0.25]])
    assert [(one.name, one.size) for one in found.slices] == [("observation", 2), ("phase", 1), (BASE, 1)]
    assert (found.about["low"], found.about["high"], found.text(0)) == ([-1.0], [2.0], "pick")
    table(tmp_path / "more", **columns, effect=[[0.1, 0.2], [0.3, 0.4]])
    found = situations.read(tmp_path / "more")
    np.testing.assert_allclose(found.observations[1], [2.0, 3.0, 0.5, 0.3, 0.4, 0.25])
    assert [(one.name, one.kind) for one in found.slices[-2:]] == [("effect", "effect"), (BASE, PROPOSED)]


def table(folder, **columns):
    folder.mkdir(exist_ok=True)
    pq.write_table(pa.table(columns), folder / "situations.parquet")


GOOD = {"observation": [[0.0, 1.0], [2.0, 3.0]], "action": [[0.5], [0.25]]}


@pytest.mark.parametrize(
    ("changed", "told"),
    [
        ({"action": None}, "has the columns observation: give one column action"),
        ({"observation": [[0.0, 1.0], [2.0]]}, "give the same number of numbers in every row of the column obser"),
        ({"observation": [[0.0, 1.0], [2.0, float("nan")]]}, "the rows 1 are not finite"),
        ({"phase": [0.0, 0.0], "effect": [[0.1], [0.2]]}, "in effect as many numbers as observation times action"),
    ],
)
def test_what_does_not_fit_is_told(changed, told, tmp_path):
    table(tmp_path / "there", **{name: values for name, values in {**GOOD, **changed}.items() if values is not None})
    with pytest.raises(UserError) as error:
        situations.read(tmp_path / "there")
    assert told in str(error.value)


@pytest.mark.parametrize(
    "text", ["\ufeffobservation,action.x,action.y\n1 2,3,4\n", 'action.x,action.y,observation\n3,4,"[1, 2]"\n']
)
def test_a_csv_file_of_any_program_is_read(text, tmp_path):
    (tmp_path / "situations.csv").write_text(text, encoding="utf-8")
    found = situations.read(tmp_path)
    np.testing.assert_array_equal(found.observations, [[1, 2]])
    np.testing.assert_array_equal(found.actions, [[3, 4]])
    assert found.entries == ("x", "y")


@pytest.mark.parametrize(
    ("name", "told"), [("../secret.png", "leads out of"), ("notes.txt", "is no picture's file that the page shows")]
)
def test_a_picture_that_cannot_be_shown_is_told_when_it_is_wanted(name, told, tmp_path):
    table(tmp_path / "there", **GOOD, picture=[name, None])
    found = situations.read(tmp_path / "there")
    assert found.picture(1) is None
    with pytest.raises(UserError, match=told):
        found.picture(0)


def test_a_folder_without_a_table_is_told(tmp_path):
    with pytest.raises(UserError, match="is no LeRobot dataset either: give"):
        situations.read(tmp_path)


class Trap:
    """Its unpickling would be seen."""

    def __reduce__(self):
        return print, ("executed",)


def test_nothing_is_unpickled(tmp_path, capsys):
    (tmp_path / "there").mkdir()
    np.savez(tmp_path / "there/situations.npz", observation=np.zeros((1, 2)), action=np.array([Trap()], object))
    with pytest.raises(UserError, match="without Python objects"):
        situations.read(tmp_path / "there")
    (tmp_path / "there/situations.npz").write_bytes(pickle.dumps(Trap()))
    with pytest.raises(UserError, match="cannot be read"):
        situations.read(tmp_path / "there")
    assert "executed" not in capsys.readouterr().out


@pytest.mark.parametrize(
    ("change", "told"),
    [
        (lambda info: info.update(codebase_version="v2.1"), "of the format 'v2.1', v3.0 is needed"),
        (lambda info: info["features"].pop("action"), "has no feature action"),
        (lambda info: info["features"]["action"].update(shape=[2]), "action does not hold 2 numbers"),
        (lambda info: info["features"]["action"].update(shape=[2, 3]), "action has more than one axis: store it"),
    ],
)
def test_a_lerobot_dataset_that_cannot_be_read_is_told(change, told, tmp_path):
    recorded.write_lerobot(tmp_path / "set")
    path = tmp_path / "set/meta/info.json"
    info = json.loads(path.read_text())
    change(info)
    path.write_text(json.dumps(info))
    with pytest.raises(UserError, match=told):
        situations.read(tmp_path / "set")
