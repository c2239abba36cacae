"""The append-only table: columns of every type, what a table says of itself, and what a crash leaves."""

import os
import resource
from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest

from cuelearner_jax.errors import UserError
from cuelearner_jax.storage import label_files, results
from cuelearner_jax.storage import table as tables

ROOT = Path(__file__).parents[2]
SCHEMA = tables.Schema(
    stem="catches",
    required=("fish", "weights"),
    strings=("fish",),
    integers=("count",),
    lists=("weights",),
    remedy="is wet: dry it",
)
ABOUT = {"lake": "Como", "depth": None}


def written(folder, *fish, about=ABOUT, **constants):
    with tables.TableWriter(folder, SCHEMA, constants or None, about) as writer:
        for index, name in enumerate(fish):
            writer.append(fish=name, weights=[index, 0.1], count=index, length=0.5)
    return folder / SCHEMA.jsonl


def read(folder):
    return tables.read(folder / SCHEMA.jsonl, SCHEMA)


def test_rows_have_the_types_of_their_columns_and_come_back_bit_by_bit(tmp_path):
    values = np.random.default_rng(0).normal(size=(4, 2)).astype(np.float32)
    with tables.TableWriter(tmp_path, SCHEMA) as writer:
        writer.append(fish=["pike", "eel"], weights=values[:2], spots=[1.0, float("inf")], count=[0, 1])
        writer.append(fish=["carp", "perch"], weights=[5.0, float("nan")])  # one list for all rows
        with pytest.raises(ValueError, match="too many values"):
            writer.append(fish=["pike", "eel"], weights=np.zeros((3, 2)))
    growing = read(tmp_path)
    finished = tables.read(tables.finish(tmp_path, SCHEMA), SCHEMA)
    for table in (growing, finished):
        assert {field.name: field.type for field in table.schema} == {
            "fish": pa.string(),
            "weights": pa.list_(pa.float32()),
            "spots": pa.float64(),
            "count": pa.int64(),
        }
        assert table["weights"].to_pylist() == [*values[:2].tolist(), [5.0, None], [5.0, None]]
        assert table["spots"].to_pylist() == [1.0, None, None, None]
        assert table["count"].to_pylist() == [0, 1, None, None]


def test_a_description_stays_with_a_table_through_every_change(tmp_path):
    written(tmp_path, "pike")
    assert tables.about_of(read(tmp_path)) == ABOUT
    written(tmp_path, "eel", about={"lake": "Garda"})  # a table that exists keeps its own
    tables.truncate(tmp_path, SCHEMA, keep=lambda row: row["fish"] != "pike")
    path = tables.finish(tmp_path, SCHEMA)
    table = tables.read(path, SCHEMA)
    assert (tables.about_of(table), table["fish"].to_pylist()) == (ABOUT, ["eel"])
    written(tmp_path, "carp")
    assert not path.exists()
    assert (tables.about_of(read(tmp_path)), read(tmp_path)["fish"].to_pylist()) == (ABOUT, ["eel", "carp"])
    assert (tmp_path / SCHEMA.jsonl).read_text().count("about") == 1


@pytest.mark.parametrize("torn", [b'{"fish": "ca', b"\x00\x00", b'{"fish": "\xc3'])
def test_a_torn_last_line_is_dropped_by_whoever_continues(tmp_path, torn):
    with written(tmp_path, "pike", "eel").open("ab") as file:
        file.write(torn)
    assert read(tmp_path)["fish"].to_pylist() == ["pike", "eel"]
    written(tmp_path, "carp")
    assert read(tmp_path)["fish"].to_pylist() == ["pike", "eel", "carp"]


def test_a_line_is_on_the_disk_before_append_returns(tmp_path, monkeypatch):
    written(tmp_path)
    synced, usual = [], os.fsync

    def fsync(descriptor):
        synced.append((tmp_path / SCHEMA.jsonl).read_text().count("\n"))
        usual(descriptor)

    with tables.TableWriter(tmp_path, SCHEMA) as writer:
        monkeypatch.setattr(os, "fsync", fsync)
        writer.append(fish="pike", weights=[1.0])
    assert synced == [2]  # the description, and the row


def test_a_full_disk_leaves_no_row_behind_and_takes_the_next_one(tmp_path):
    with tables.TableWriter(tmp_path, SCHEMA, about=ABOUT) as writer:
        writer.append(fish="pike", weights=[1.0])
        before = (tmp_path / SCHEMA.jsonl).read_bytes()
        limits = resource.getrlimit(resource.RLIMIT_FSIZE)
        resource.setrlimit(resource.RLIMIT_FSIZE, (len(before) + 10, limits[1]))  # room for a part of a line
        try:
            for _ in range(2):
                with pytest.raises(OSError, match="too large"):
                    writer.append(fish="eel", weights=[2.0])
                assert (tmp_path / SCHEMA.jsonl).read_bytes() == before
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, limits)
        writer.append(fish="carp", weights=[3.0])
    assert read(tmp_path)["fish"].to_pylist() == ["pike", "carp"]


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ('{\n{"fish": "pike", "weights": [1.0]}\n', "is wet: dry it"),
        ('{"bird": 1}\n', "lacks the columns fish, weights: it is not a table of catches"),
        ('{"about": {}}\n{"constants": 3}\n{"fish": "pike"}\n', "is wet: dry it"),
    ],
)
def test_what_cannot_be_read_is_said_in_one_line(tmp_path, text, says):
    (tmp_path / SCHEMA.jsonl).write_text(text)
    with pytest.raises(UserError) as caught:
        read(tmp_path)
    assert says in str(caught.value)
    assert "\n" not in str(caught.value)


def test_every_recorded_table_is_read():
    files = [path for ending in ("jsonl", "parquet") for path in (ROOT / "docs" / "data").rglob(f"results.{ending}")]
    assert len(files) > 5
    for path in files:
        assert results.read(path).num_rows
    assert len(label_files.read(ROOT / "docs" / "data" / "labelling" / "navigation").seeds) == 500
