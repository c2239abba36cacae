"""Formats: older files are read as what they said, newer ones and nonsense are refused in one line."""

import json
from pathlib import Path

import numpy as np
import pytest

from cuelearner_jax.errors import UserError
from cuelearner_jax.records import formats

PATH = Path("somewhere") / "file"
ROOT = Path(__file__).resolve().parents[2]
EPS = 20.0


def directions(*degrees):
    angles = np.deg2rad(np.array(degrees))
    return np.stack([np.cos(angles), np.sin(angles)], -1).astype(np.float32)


def relative(*answers, eps_deg=EPS, **others):
    """Labels of format 0: actions all around, each with the target of its answer."""
    at = np.linspace(-170, 180, len(answers))
    action = directions(*at)
    columns = {"seed": np.arange(len(answers)), "obs": action, "action": action}
    columns["target"] = directions(*(at + eps_deg * np.array(answers))) - action
    return {"task": {"name": "window"}, "guidance": "relative", "eps_deg": eps_deg, "columns": columns, **others}


def refused(kind, values, message):
    with pytest.raises(UserError, match=message) as refusal:
        formats.upgrade(kind, values, PATH)
    assert "\n" not in str(refusal.value)
    assert str(refusal.value).startswith(str(PATH))


def test_every_format_leads_to_the_current_one():
    assert set(formats.STEPS) == {(kind, n) for kind, current in formats.FORMATS.items() for n in range(current)}
    assert set(formats.REMEDIES) == set(formats.FORMATS)


def test_files_without_a_number_get_one_and_nothing_else():
    values = {"task": {"name": "window"}, "seed": 3}
    assert formats.upgrade("config", values, PATH) == {**values, "format": 2}
    assert "format" not in values


@pytest.mark.parametrize("number", [{}, {"format": 1}, {"format": 2}])
def test_a_teacher_that_saw_in_another_order_is_refused(number):
    refused("teacher", {"task": {"name": "window"}, **number}, "trained by an earlier cuelearner.*: train it anew with")


@pytest.mark.parametrize("kind", formats.FORMATS)
def test_a_file_of_the_current_format_stays_as_it_is(kind):
    values = {"anything": 1, "format": formats.FORMATS[kind]}
    assert formats.upgrade(kind, dict(values), PATH) == values


@pytest.mark.parametrize("kind", formats.FORMATS)
def test_a_newer_file_is_refused(kind):
    newer = formats.FORMATS[kind] + 1
    refused(kind, {"format": newer}, rf"was written by a newer cuelearner: update, .*format is {newer}")


@pytest.mark.parametrize("kind", formats.FORMATS)
@pytest.mark.parametrize("values", [None, 3, [], "text", *({"format": n} for n in (-1, True, 1.0, "1", None, []))])
def test_nonsense_is_refused_as_damaged(kind, values):
    refused(kind, values, "damaged")


def test_targets_become_the_answers_that_they_came_from():
    answers = [1, 0, -1, -1, 1, 0, 1, -1]
    for eps_deg in (0.1, EPS, 120.0):
        values = formats.upgrade("labels", relative(*answers, eps_deg=eps_deg), PATH)
        answer = values["columns"]["answer"]
        assert (answer.shape, answer.dtype) == ((8, 1), np.float32)
        assert answer[:, 0].tolist() == answers
        assert not np.signbit(answer[answer == 0]).any()
        assert (values["answers"], values["eps_deg"], values["format"]) == ("relative", eps_deg, 3)
        assert {"guidance", "target"}.isdisjoint([*values, *values["columns"]])


def test_an_upgrade_leaves_what_it_was_given():
    old = relative(1, -1)
    formats.upgrade("labels", old, PATH)
    assert set(old["columns"]) == {"seed", "obs", "action", "target"}


@pytest.mark.parametrize("missing", ["guidance", "eps_deg", "columns"])
def test_older_labels_that_do_not_say_what_they_are_are_refused(missing):
    values = relative(1, -1)
    del values[missing]
    refused("labels", values, "not a label file")


def test_older_labels_that_make_no_sense_are_refused():
    refused("labels", relative(1, -1, guidance="scalar"), "not a label file")
    refused("labels", relative(2, -1), "not a label file")
    refused("labels", {**relative(1), "eps_deg": "five"}, "not a label file")
    refused("labels", {**relative(1), "eps_deg": float("nan")}, "not a label file")
    refused("labels", {**relative(1), "columns": {"action": directions(0)}}, "not a label file")


def test_files_are_read_in_the_current_format(tmp_path):
    path = tmp_path / "config.json"
    path.write_text('{"split": "tuning"}')
    assert formats.read("config", path) == {"split": "tuning", "format": 2}
    assert path.read_text() == '{"split": "tuning"}'
    for content in (b"", b"{", b"\xff\xfe\x00", b"[]"):
        path.write_bytes(content)
        with pytest.raises(UserError, match=r"config\.json is damaged"):
            formats.read("config", path)


@pytest.mark.parametrize(
    ("kind", "pattern"),
    [("config", "docs/data/**/config.json"), ("teacher", "envs/cuelearner_envs/billiards/teachers/*/teacher.json")],
)
def test_files_that_are_shipped_are_still_read(kind, pattern):
    paths = sorted(ROOT.glob(pattern))
    assert paths
    for path in paths:
        values = json.loads(path.read_text())
        if "shard" in values:
            values["shard"] = dict(zip(("index", "count"), values["shard"], strict=True), seeds=None)
        values.pop(formats.DIGEST, None)
        assert formats.read(kind, path) == {"format": formats.FORMATS[kind], **values}


def test_what_was_written_is_read_and_nothing_else(tmp_path):
    path = tmp_path / "config.json"
    values = {"task": {"name": "window"}, "scalars": {"eps_deg": 20.0}, "grid": {"seeds": (1, 2)}}
    formats.write("config", path, values)
    assert formats.read("config", path) == {**values, "grid": {"seeds": [1, 2]}, "format": 2}
    whole = path.read_bytes()
    unharmed = 0
    for bit in range(8 * len(whole)):
        spoilt = bytearray(whole)
        spoilt[bit // 8] ^= 1 << bit % 8
        path.write_bytes(spoilt)
        try:
            assert formats.read("config", path)["scalars"] == {"eps_deg": 20.0}
            unharmed += 1  # a space became another white space
        except UserError as error:
            assert "damaged" in str(error) or "newer" in str(error)
    assert unharmed < 0.05 * 8 * len(whole)


def test_a_file_that_may_not_be_read_is_not_called_damaged(tmp_path):
    with pytest.raises(UserError, match=r"cannot be read \(Is a directory\): check its permissions"):
        formats.read("config", tmp_path)
