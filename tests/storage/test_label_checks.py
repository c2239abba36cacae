"""Damaged label files with right checksums: each is refused in one line, with status 2, and left alone."""

import copy
import json

import numpy as np
import pyarrow as pa
import pytest

from cuelearner_jax.cli import main
from cuelearner_jax.spaces import DIRECTIONS
from cuelearner_jax.storage import label_files, lines
from cuelearner_jax.storage import table as tables
from cuelearner_jax.storage.label_files import JSONL, PARQUET, SCHEMA

HEAD = {
    "format": 1,
    "task": {"name": "window", "half_width_deg": 28.0},
    "answers": "relative",
    "space": DIRECTIONS.to_json(),
    "eps": 20.0,
    "session": {"seed": 0, "guidance": "relative", "base": "uniform", "observation": [{"name": "goal", "size": 2}]},
}
ROWS = [
    {
        **{"seed": 0, "obs": [0.1, 0.2], "action": [0.0, 1.0], "answer": [answer]},
        **{"item": item, "said": "answer", "seconds": 1.5, "who": "Ada", "when": "2026-01-01T00:00:00+00:00"},
    }
    for item, answer in enumerate([1.0, 0.0, -1.0])
]
ABSENT = object()
HEADS = [
    ("format", ABSENT),
    *(("format", value) for value in (0, 2, 10**30, -1, True, 1.0, "1", None, [1], float("nan"))),
    ("task", ABSENT),
    *(("task", value) for value in (None, "window", [], {}, {"name": None}, {"name": ["window"]}, 3)),
    ("answers", ABSENT),
    *(("answers", value) for value in (None, 3, ["relative"], {})),
    ("space", ABSENT),
    *(("space", value) for value in (None, "plane", {}, {"name": "box", "cues": [], "low": [1], "high": [0]})),
    ("eps", ABSENT),
    *(("eps", value) for value in (None, "20", 0, -20.0, 181, 1e400, float("nan"), True, [20.0])),
    *(
        ("session", value)
        for value in ([], 3, "page", {}, {"seed": None}, {"seed": -1}, {"seed": True}, {"seed": 2**40})
    ),
    *(("session", {"seed": 0, name: 3}) for name in ("base", "robot", "observation")),
    ("session", {"seed": 0, "bound": "wide"}),
    ("session", {"seed": 0, "observation": [{"name": "goal", "size": 10**9}]}),
    ("session", {"seed": 0, "observation": [{"name": "goal", "size": 2.0}]}),
    ("session", {"seed": 0, "observation": ["goal"]}),
]
FIELDS = [
    *(("said", value) for value in ("maybe", "", "ANSWER", "unsure", "undone", "\x1b[31m")),
    *(("answer", value) for value in (ABSENT, [2.0], [0.5], [float("nan")], [float("inf")], [1.0, 0.0], [])),
    *(("action", value) for value in (ABSENT, [3.0, 4.0], [0.0, 0.0], [1.0], [float("nan"), 1.0], [1e30, 0.0], [])),
    *(("obs", value) for value in (ABSENT, [0.1], [float("nan"), 0.0], [float("-inf"), 0.0], [])),
    *(("item", value) for value in (ABSENT, -1, 2**40)),
    *(("seconds", value) for value in (ABSENT, -1.0, float("nan"), float("inf"))),
    *((name, ABSENT) for name in ("who", "when", "seed")),
    ("seed", -1),
]
LINES = [  # of JSONL alone: what the types of Parquet do not hold
    *(("seed", value) for value in ("zero", 0.5, 2**70, [0], {"a": 1})),
    *(("action", value) for value in ("up", 3.0, [[1.0], [0.0]], {"x": 1.0}, [None, 1.0])),
    *(("item", value) for value in ("first", 0.5)),
    *(("who", value) for value in (3, ["Ada"], "\ud800")),
    ("seconds", "long"),
]


def changed(values, name, value):
    kept = {key: old for key, old in values.items() if key != name}
    return kept if value is ABSENT else {**kept, name: value}


def seal(folder, form, head, rows):
    """Writes a label file whose checksums are right; what Python's JSON alone can say is written as it is."""
    folder.mkdir(exist_ok=True)
    if form == JSONL:
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(json, "dumps", lambda value, allow_nan=True, usual=json.dumps: usual(value))
            lines.Writer(folder / JSONL, [{"about": head}, *rows]).close()
    else:
        columns = {name: [row.get(name) for row in rows] for name in {key: None for row in rows for key in row}}
        table = pa.table({name: pa.array(values, SCHEMA.type(name)) for name, values in columns.items()})
        tables.write(folder / PARQUET, table, SCHEMA, about=head)
    return folder


def refused(folder, capsys, *more):
    before = {path.name: path.read_bytes() for path in folder.iterdir()}
    assert main(["labels", "inspect", str(folder), *more]) == 2
    told = capsys.readouterr()
    assert (told.out, told.err.count("\n")) == ("", 1)
    assert told.err.startswith("error: ")
    assert told.err[:-1].isprintable()
    assert {path.name: path.read_bytes() for path in folder.iterdir()} == before
    return told.err


@pytest.mark.parametrize("form", [JSONL, PARQUET])
def test_the_file_that_is_damaged_below_is_one(form, tmp_path, capsys):
    assert main(["labels", "inspect", str(seal(tmp_path / "labels", form, HEAD, ROWS))]) == 0
    assert "-1: 1, 0: 1, 1: 1" in capsys.readouterr().out


@pytest.mark.parametrize("form", [JSONL, PARQUET])
@pytest.mark.parametrize(("name", "value"), HEADS)
def test_a_damaged_head_is_refused(form, name, value, tmp_path, capsys):
    refused(seal(tmp_path / "labels", form, changed(HEAD, name, value), ROWS), capsys)


@pytest.mark.parametrize("form", [JSONL, PARQUET])
@pytest.mark.parametrize(("name", "value"), FIELDS)
def test_a_row_that_is_no_label_is_refused(form, name, value, tmp_path, capsys):
    rows = [ROWS[0], changed(ROWS[1], name, value), ROWS[2]]
    refused(seal(tmp_path / "labels", form, HEAD, rows), capsys)


@pytest.mark.parametrize(("name", "value"), LINES)
def test_a_value_of_another_type_is_refused(name, value, tmp_path, capsys):
    refused(seal(tmp_path / "labels", JSONL, HEAD, [ROWS[0], changed(ROWS[1], name, value)]), capsys)


@pytest.mark.parametrize("head", [None, [], 3, "labels", True])
def test_a_head_that_is_no_object_is_refused(head, tmp_path, capsys):
    refused(seal(tmp_path / "labels", JSONL, head, ROWS), capsys)


DEEP = b"[" * 200_000
RAW = [b"", b"\n", b"\x00" * 64, b"[]\n", b"{}\n", b"null\n", b"3\n", b'"text"\n', DEEP, DEEP + b"\n", b"{" * 9 + b"\n"]
RAW += [
    b"PAR1",
    b"PAR1" * 8,
    b"PAR1" + bytes(200) + b"\xff\xff\xff\x7fPAR1",
    b"PAR1" + b"\x1c" * 5000 + b"\x88\x13\0\0PAR1",
]
RAW += [b"\x89PNG\r\n\x1a\n", b"PK\x03\x04", b"\xff\xfe\x00{", b'{"about": {"format": 1}}\n', b"seed,obs\n1,2\n"]


@pytest.mark.parametrize("form", [JSONL, PARQUET])
@pytest.mark.parametrize("content", RAW, ids=range(len(RAW)))
def test_what_is_no_table_is_refused(form, content, tmp_path, capsys):
    (tmp_path / form).write_bytes(content)
    before = (tmp_path / form).read_bytes()
    assert main(["labels", "inspect", str(tmp_path)]) == 2
    told = capsys.readouterr().err
    assert told.splitlines()[-1].startswith("error: ")
    assert "Traceback" not in told
    assert (tmp_path / form).read_bytes() == before


def test_a_deep_head_of_parquet_is_refused(tmp_path, capsys):
    folder = seal(tmp_path / "labels", PARQUET, HEAD, ROWS)
    table = tables.read(folder / PARQUET, SCHEMA)
    for told in (DEEP, b"\xff", b"{", b"1" * 5000):
        seals = {tables.META: told, tables.DIGEST: tables.digest(table, told).encode()}
        sealed = table.replace_schema_metadata(seals)
        tables.pq.write_table(sealed, folder / PARQUET, write_page_checksum=True)
        refused(folder, capsys)


def test_text_of_a_file_does_nothing_to_a_terminal(tmp_path, capsys):
    rows = copy.deepcopy(ROWS)
    for row in rows:
        row["who"] = "Ada\x1b[2J\x1b]0;owned\x07"
    assert main(["labels", "inspect", str(seal(tmp_path / "labels", JSONL, HEAD, rows))]) == 0
    shown = capsys.readouterr().out
    assert "\x1b" not in shown
    assert "\\x1b[2J" in shown


def test_merging_a_file_with_itself_keeps_each_label_once(tmp_path, capsys):
    mine, both = seal(tmp_path / "labels", JSONL, HEAD, ROWS), tmp_path / "new" / "both.parquet"
    assert main(["labels", "merge", str(mine), str(mine), "--out", str(both)]) == 0
    assert "wrote 3 labels of 2 files" in (said := capsys.readouterr().out)
    assert "; 3 duplicates of an earlier file's labels were left out" in said
    np.testing.assert_array_equal(label_files.read(both).labels.answer[:, 0], [1.0, 0.0, -1.0])
