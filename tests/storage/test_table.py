"""The append-only table: columns of every type, what a table says of itself, and what a crash leaves."""

import os
import resource
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from cuelearner_jax.errors import UserError
from cuelearner_jax.storage import label_files, results
from cuelearner_jax.storage import table as tables

ROOT = Path(__file__).parents[2]
SCHEMA = tables.Schema(
    stem="catches",
    mark="fish",
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


def test_columns_have_their_types(tmp_path):
    written(tmp_path, "pike", "eel")
    table = read(tmp_path)
    assert {field.name: field.type for field in table.schema} == {
        "fish": pa.string(),
        "weights": pa.list_(pa.float32()),
        "count": pa.int64(),
        "length": pa.float64(),
    }
    assert table["weights"].to_pylist() == [[0.0, np.float32(0.1)], [1.0, np.float32(0.1)]]
    assert table["count"].to_pylist() == [0, 1]


def test_one_list_holds_for_all_rows_and_an_array_has_one_a_row(tmp_path):
    with tables.TableWriter(tmp_path, SCHEMA) as writer:
        writer.append(fish=["pike", "eel"], weights=np.arange(4.0).reshape(2, 2), spots=[1.0, float("inf")])
        writer.append(fish=["carp", "perch"], weights=[5.0, float("nan")])
        with pytest.raises(ValueError, match="one length"):
            writer.append(fish=["pike", "eel"], weights=np.zeros((3, 2)))
        with pytest.raises(ValueError, match="a row of catches needs the columns weights"):
            writer.append(fish="pike")
    table = read(tmp_path)
    assert table["weights"].to_pylist() == [[0.0, 1.0], [2.0, 3.0], [5.0, None], [5.0, None]]
    assert table["spots"].to_pylist() == [1.0, None, None, None]


def test_a_32_bit_float_comes_back_bit_by_bit(tmp_path):
    values = np.random.default_rng(0).normal(size=(50, 3)).astype(np.float32)
    with tables.TableWriter(tmp_path, SCHEMA) as writer:
        writer.append(fish=["pike"] * 50, weights=values)
    np.testing.assert_array_equal(np.array(read(tmp_path)["weights"].to_pylist(), np.float32), values)
    tables.finish(tmp_path, SCHEMA)
    whole = tables.read(tmp_path / SCHEMA.parquet, SCHEMA)
    np.testing.assert_array_equal(np.array(whole["weights"].to_pylist(), np.float32), values)


def test_what_a_table_is_stays_with_it_through_every_change(tmp_path):
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


def test_a_table_that_says_nothing_of_itself(tmp_path):
    written(tmp_path, "pike", about=None)
    assert tables.about_of(read(tmp_path)) is None
    assert tables.about_of(tables.read(tables.finish(tmp_path, SCHEMA), SCHEMA)) is None


def test_constants_hold_until_the_next_ones(tmp_path):
    written(tmp_path, "pike", boat=1.0)
    written(tmp_path, "eel", boat=1.0)
    written(tmp_path, "carp", boat=2.0)
    assert read(tmp_path)["boat"].to_pylist() == [1.0, 1.0, 2.0]
    assert (tmp_path / SCHEMA.jsonl).read_text().count("constants") == 2


@pytest.mark.parametrize("torn", [b'{"fish": "ca', b"\x00\x00", b'{"fish": "\xc3'])
def test_a_torn_last_line_is_dropped_by_whoever_continues(tmp_path, torn):
    path = written(tmp_path, "pike", "eel")
    with path.open("ab") as file:
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
    assert synced == [2]  # what the table is, and the row


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


def test_a_failed_write_leaves_the_file_before(tmp_path, monkeypatch):
    path = tmp_path / "whole.parquet"
    tables.write(path, pa.table({"fish": ["pike"], "weights": [[1.0]]}), SCHEMA)
    before = path.read_bytes()

    def full(*_, **__):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(pq, "write_table", full)
    with pytest.raises(OSError, match="No space"):
        tables.write(path, pa.table({"fish": ["eel"], "weights": [[1.0]]}), SCHEMA)
    assert path.read_bytes() == before


def test_no_changed_bit_of_a_finished_table_goes_unnoticed(tmp_path):
    rng = np.random.default_rng(0)
    columns = {"fish": ["pike", "eel"] * 100, "weights": rng.normal(size=(200, 2)).tolist(), "length": rng.random(200)}
    path = tmp_path / "whole.parquet"
    tables.write(path, pa.table(columns), SCHEMA, about=ABOUT)
    written, whole = tables.read(path, SCHEMA), path.read_bytes()
    refused = 0
    for bit in rng.integers(0, 8 * len(whole), 100):
        spoilt = bytearray(whole)
        spoilt[bit // 8] ^= 1 << bit % 8
        path.write_bytes(spoilt)
        try:
            found = tables.read(path, SCHEMA)
        except UserError as error:
            assert "is wet: dry it" in str(error)
            refused += 1
        else:
            assert found.equals(written)
            assert tables.about_of(found) == ABOUT
    assert refused > 75


def test_a_table_that_was_written_anew_by_others_is_not_ours(tmp_path):
    path = tmp_path / "whole.parquet"
    tables.write(path, pa.table({"fish": ["pike", "eel"], "weights": [[1.0], [2.0]]}), SCHEMA)
    pq.write_table(pq.read_table(path).slice(0, 1), path)  # keeps the digest
    with pytest.raises(UserError, match="not those that were written"):
        tables.read(path, SCHEMA)
    pq.write_table(pq.read_table(path).replace_schema_metadata(None), path)
    with pytest.raises(UserError, match="not those that were written"):
        tables.read(path, SCHEMA)


def test_tables_of_earlier_versions_are_read_and_continued(tmp_path):
    """Their lines end in checksums, and a closing line stands at the end."""
    old = ['{"about": {"lake": "Como"}, "crc": "0123abcd"}', '{"fish": "pike", "weights": [1.0], "crc": "0123abcd"}']
    (tmp_path / SCHEMA.jsonl).write_text("\n".join([*old, '{"end": 2, "crc": "0123abcd"}\n']))
    written(tmp_path, "eel")
    assert read(tmp_path)["fish"].to_pylist() == ["pike", "eel"]
    assert tables.about_of(read(tmp_path)) == {"lake": "Como"}


def test_a_table_that_may_not_be_read_is_not_called_damaged(tmp_path, monkeypatch):
    written(tmp_path, "pike")
    path = tables.finish(tmp_path, SCHEMA)

    def forbidden(*_, **__):
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(pq, "ParquetFile", forbidden)
    with pytest.raises(UserError, match=r"cannot be read \(Permission denied\): check its permissions"):
        tables.read(path, SCHEMA)


def test_files_are_told_apart_by_name_or_by_their_first_bytes(tmp_path):
    path = written(tmp_path, "pike")
    copy = tmp_path / "copy"
    copy.write_bytes(path.read_bytes())
    assert tables.read(copy, SCHEMA)["fish"].to_pylist() == ["pike"]
    copy.write_bytes(tables.finish(tmp_path, SCHEMA).read_bytes())
    assert tables.read(copy, SCHEMA)["fish"].to_pylist() == ["pike"]
    # A table that was finished since its file was found.
    assert tables.read(path, SCHEMA)["fish"].to_pylist() == ["pike"]


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ('{\n{"fish": "pike", "weights": [1.0]}\n', "(line 1: it is not a JSON object)"),
        ("[]\n", "(line 1: it is not a JSON object)"),
        ('{"bird": 1}\n', "(line 1: it is not a row of catches)"),
        ('{"about": {}}\n{"constants": 3}\n{"fish": "pike"}\n', "is wet: dry it"),
        ('{"fish": "pike", "weights": 3}\n', "is wet: dry it"),
        ('{"fish": "pike"}\n', "lacks the columns weights"),
        ("PAR1 and then rubbish", "is wet: dry it"),
    ],
)
def test_what_cannot_be_read_is_said_in_one_line(tmp_path, text, says):
    (tmp_path / SCHEMA.jsonl).write_text(text)
    with pytest.raises(UserError) as caught:
        read(tmp_path)
    assert says in str(caught.value)
    assert "\n" not in str(caught.value)


def test_an_empty_table_cannot_be_finished_and_a_missing_one_neither(tmp_path):
    with pytest.raises(UserError, match=r"no catches in .*: expected catches.jsonl or catches.parquet"):
        tables.finish(tmp_path, SCHEMA)
    written(tmp_path)
    with pytest.raises(UserError, match="no rows"):
        tables.finish(tmp_path, SCHEMA)
    assert [file.name for file in tmp_path.iterdir()] == [SCHEMA.jsonl]


def test_every_recorded_table_is_read():
    for path in sorted((ROOT / "docs" / "data").rglob("*.jsonl")):
        assert results.read(path).num_rows
    files = sorted((ROOT / "docs" / "data").glob("*/**/*.parquet"))
    assert len(files) > 20
    for path in files:
        assert tables.DIGEST in (pq.read_schema(path).metadata or {}), path
    assert len(label_files.read(ROOT / "docs" / "data" / "labelling" / "navigation").seeds) == 500
