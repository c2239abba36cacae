"""JSON files: those of the current format are read as what they said, others and nonsense are refused in one line."""

import json
from pathlib import Path

import pytest

from cuelearner_jax.errors import UserError
from cuelearner_jax.storage import formats

ROOT = Path(__file__).resolve().parents[2]


@pytest.mark.parametrize(
    "content", [b"", b"{", b"\xff\xfe\x00", b"[]", b"3", b"null", b'{"split": "tuning"}', b'{"format": "1"}']
)
def test_nonsense_is_refused_as_damaged(tmp_path, content):
    path = tmp_path / "config.json"
    path.write_bytes(content)
    with pytest.raises(UserError, match=r"config\.json is damaged"):
        formats.read("config", path)


@pytest.mark.parametrize("kind", formats.FORMATS)
def test_values_are_read_as_they_were_written_unless_they_changed_or_are_of_another_format(tmp_path, kind):
    path = tmp_path / "file.json"
    formats.write(kind, path, {"task": {"name": "window"}, "grid": {"seeds": (1, 2)}})
    values = {"task": {"name": "window"}, "grid": {"seeds": [1, 2]}, "format": formats.FORMATS[kind]}
    assert formats.read(kind, path) == values
    path.write_text(path.read_text().replace("window", "windom"))
    with pytest.raises(UserError, match="damaged"):
        formats.read(kind, path)
    path.write_text(json.dumps({**values, "format": 0}))
    with pytest.raises(UserError, match=r"is of format 0, .*: use the cuelearner that wrote it"):
        formats.read(kind, path)


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
