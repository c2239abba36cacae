"""Formats: files of the current one are read as what they said, others and nonsense are refused in one line."""

import json
from pathlib import Path

import pytest

from cuelearner_jax.errors import UserError
from cuelearner_jax.storage import formats

PATH = Path("somewhere") / "file"
ROOT = Path(__file__).resolve().parents[2]


def refused(kind, values, message):
    with pytest.raises(UserError, match=message) as refusal:
        formats.check(kind, values, PATH)
    assert "\n" not in str(refusal.value)
    assert str(refusal.value).startswith(str(PATH))


@pytest.mark.parametrize("kind", formats.FORMATS)
def test_a_file_of_another_format_is_refused(kind):
    for other in (0, formats.FORMATS[kind] + 1):
        refused(kind, {"format": other}, rf"is of format {other}, .*: use the cuelearner that wrote it")
    formats.check(kind, {"format": formats.FORMATS[kind]}, PATH)


@pytest.mark.parametrize("kind", formats.FORMATS)
@pytest.mark.parametrize("values", [None, 3, [], "text", *({"format": n} for n in (True, 1.0, "1", None, []))])
def test_nonsense_is_refused_as_damaged(kind, values):
    refused(kind, values, "damaged")


def test_what_is_no_json_is_refused_as_damaged(tmp_path):
    path = tmp_path / "config.json"
    for content in (b"", b"{", b"\xff\xfe\x00", b"[]", b'{"split": "tuning"}'):
        path.write_bytes(content)
        with pytest.raises(UserError, match=r"config\.json is damaged"):
            formats.read("config", path)


@pytest.mark.parametrize(
    ("kind", "pattern"),
    [
        ("config", "docs/data/**/config.json"),
        ("config", "envs/cuelearner_envs/agents/*/config.json"),
        ("teacher", "envs/cuelearner_envs/billiards/teachers/*/teacher.json"),
    ],
)
def test_files_that_are_shipped_are_still_read(kind, pattern):
    paths = sorted(ROOT.glob(pattern))
    assert paths
    for path in paths:
        values = json.loads(path.read_text())
        values.pop(formats.DIGEST, None)
        assert formats.read(kind, path) == {"format": formats.FORMATS[kind], **values}


def test_what_was_written_is_read_and_nothing_else(tmp_path):
    path = tmp_path / "config.json"
    values = {"task": {"name": "window"}, "scalars": {"eps_deg": 20.0}, "grid": {"seeds": (1, 2)}}
    formats.write("config", path, values)
    assert formats.read("config", path) == {**values, "grid": {"seeds": [1, 2]}, "format": 1}
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
            assert "damaged" in str(error) or "is of format" in str(error)
    assert unharmed < 0.05 * 8 * len(whole)


def test_a_file_that_may_not_be_read_is_not_called_damaged(tmp_path):
    with pytest.raises(UserError, match=r"cannot be read \(Is a directory\): check its permissions"):
        formats.read("config", tmp_path)
