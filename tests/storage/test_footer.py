"""What Parquet files declare: small files that would eat the machine are refused before any of them is read."""

import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from cuelearner_jax.errors import UserError
from cuelearner_jax.storage import footer, room
from cuelearner_jax.storage import table as tables
from cuelearner_jax.storage.label_files import SCHEMA

ROWS, WIDTH = 100_000, 50


@pytest.fixture(scope="module")
def small(tmp_path_factory):
    """Files of few bytes and many values, by what there is much of."""
    folder = tmp_path_factory.mktemp("small")
    repeated = {
        "rows": {"seed": pa.array([7] * ROWS)},
        "lists": {"obs": pa.array([[0.5] * WIDTH] * (ROWS // WIDTH), pa.list_(pa.float32()))},
        "texts": {"who": pa.array(["Ada" * 1000] * 1000).dictionary_encode()},
    }
    for name, columns in repeated.items():
        pq.write_table(pa.table(columns), folder / name, compression="zstd", write_page_checksum=True)
        assert (folder / name).stat().st_size < 20_000
    return folder


def test_a_file_declares_its_rows_values_and_pages(small):
    assert footer.read_declared(small / "rows")[:2] == (ROWS, ROWS)
    assert footer.read_declared(small / "lists")[:2] == (ROWS // WIDTH, ROWS)
    assert footer.read_declared(small / "texts").strings == ("who",)
    pq.write_table(pa.table({"seed": range(ROWS)}), small / "plain", use_dictionary=False, compression="zstd")
    assert footer.read_declared(small / "plain").page_bytes > 8 * ROWS


@pytest.mark.parametrize("much", ["rows", "lists"])
def test_more_than_memory_holds_is_refused_before_it_is_read(small, much, monkeypatch):
    monkeypatch.setattr(room, "_host_bytes", lambda: 1_000_000)
    monkeypatch.setattr(pq, "read_table", lambda *_, **__: pytest.fail("it was read"))
    says = r"declares [0-9,]+ rows with 100,000 values, which needs [0-9.]+ GB of memory, 0.0 GB are free: it is not a"
    with pytest.raises(UserError, match=says):
        tables.read(small / much, SCHEMA)


def test_texts_that_stand_once_in_the_file_are_counted_as_often_as_they_hold(small, monkeypatch):
    monkeypatch.setattr(room, "_host_bytes", lambda: 5_000_000)  # 1,000 times 3,000 letters
    with pytest.raises(UserError, match="declares 1,000 rows with 1,000 values, which needs"):
        tables.read(small / "texts", SCHEMA)


def test_a_footer_that_says_less_than_its_pages_is_not_believed(small, monkeypatch):
    real = footer._Reader.struct

    def lies(self):
        found = real(self)
        if isinstance(groups := found.get(footer.GROUPS), list) and groups and footer.COLUMNS in groups[0]:
            groups[0][footer.COLUMNS][0][footer.META][footer.VALUES] = 3
        return found

    monkeypatch.setattr(footer._Reader, "struct", lies)
    assert footer.read_declared(small / "lists").values >= ROWS


@pytest.mark.parametrize("column", [pa.array([["Ada"]]), pa.array([b"12"], pa.binary(2)), pa.array([{"a": "b"}])])
def test_columns_that_this_program_does_not_write_are_refused(column, tmp_path):
    pq.write_table(pa.table({"who": column}), tmp_path / "x")
    with pytest.raises(ValueError, match="has a type that this program does not write"):
        footer.read_declared(tmp_path / "x")


def test_constants_that_hold_for_many_rows_are_counted_for_each(tmp_path, monkeypatch):
    with tables.TableWriter(tmp_path, SCHEMA, {"note": "n" * 10_000}) as writer:
        writer.append(seed=[0] * 500, obs=[1.0], action=[1.0])
    monkeypatch.setattr(room, "_host_bytes", lambda: 5_000_000)
    with pytest.raises(UserError, match=r"holds 501 lines, which needs 0.0 GB of memory"):
        tables.read(tmp_path / SCHEMA.jsonl, SCHEMA)
