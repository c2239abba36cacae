"""Formats: older files are read as what they said, newer ones and nonsense are refused in one line."""

import json
from pathlib import Path

import pytest

from cuelearner_jax.errors import UserError
from cuelearner_jax.storage import formats

PATH = Path("somewhere") / "file"
ROOT = Path(__file__).resolve().parents[2]


def refused(kind, values, message):
    with pytest.raises(UserError, match=message) as refusal:
        formats.upgrade(kind, values, PATH)
    assert "\n" not in str(refusal.value)
    assert str(refusal.value).startswith(str(PATH))


def test_every_format_leads_to_the_current_one():
    first = {"labels": 2, "due": 2}  # of those before files had no checksums, or there were none
    every = {(kind, n) for kind, last in formats.FORMATS.items() for n in range(first.get(kind, 0), last)}
    assert set(formats.STEPS) == every
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


@pytest.mark.parametrize("number", [0, 1])
def test_labels_of_before_files_had_checksums_are_refused(number):
    refused("labels", {"format": number, "task": {"name": "window"}}, f"is of format {number}, which had no checksums")


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


def test_a_file_larger_than_any_is_not_read(tmp_path, monkeypatch):
    path = tmp_path / "config.json"
    formats.write("config", path, {"task": {}})
    monkeypatch.setattr(formats, "LARGEST", path.stat().st_size - 1)
    monkeypatch.setattr(Path, "read_text", None)
    with pytest.raises(UserError, match=r"is damaged or of another program.* bytes, more than any such file has"):
        formats.read("config", path)
