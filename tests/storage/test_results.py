"""The results table: what is appended is there, what is torn is dropped, what is wrong is said in one line."""

import numpy as np
import pyarrow as pa
import pytest

from cuelearner_jax.errors import UserError
from cuelearner_jax.storage import results
from cuelearner_jax.storage.table import TableWriter, finish, truncate

CONSTANTS = {"run": "a", "task": "one_ball", "guidance": "relative", "config_hash": "0f", "hardware": "1 x cpu"}
SEEDS, LABELS = np.array([3, 4]), np.array([100, 500])


def write(folder, steps=(0, 10, 20), **constants):
    with TableWriter(folder, results.SCHEMA, CONSTANTS | constants) as writer:
        for step in steps:
            reward = np.array([step / 100, step / 50])
            writer.append(step=step, split="validation", seed=SEEDS, labels=LABELS, reward=reward, wall_s=1.5)


def rows(folder):
    return results.read(folder).drop_columns("folder").to_pylist()


def test_a_row_for_each_lane_with_its_types(tmp_path):
    write(tmp_path)
    table = results.read(tmp_path)
    assert table.num_rows == 6
    assert table["seed"].to_pylist() == [3, 4] * 3
    assert table["labels"].to_pylist() == [100, 500] * 3
    assert table["step"].type == pa.int64()
    assert table["reward"].to_pylist() == [0.0, 0.0, 0.1, 0.2, 0.2, 0.4]
    assert set(table["hardware"].to_pylist()) == {"1 x cpu"}
    assert results.metrics(table) == ["reward"]


def test_truncation_and_a_resumed_writer_give_the_uninterrupted_table(tmp_path):
    write(tmp_path / "whole", steps=[0, 10, 20, 30])
    write(tmp_path / "resumed", steps=[0, 10, 20])
    with (tmp_path / "resumed" / results.JSONL).open("a") as file:
        file.write('{"step": 20, "torn')
    truncate(tmp_path / "resumed", results.SCHEMA, lambda row: row["step"] <= 10)
    assert {row["step"] for row in rows(tmp_path / "resumed")} == {0, 10}
    write(tmp_path / "resumed", steps=[20, 30])
    assert (tmp_path / "resumed" / results.JSONL).read_bytes() == (tmp_path / "whole" / results.JSONL).read_bytes()


def test_a_finished_run_can_be_continued(tmp_path):
    write(tmp_path, steps=[0, 10])
    finish(tmp_path, results.SCHEMA)
    truncate(tmp_path, results.SCHEMA, lambda row: row["step"] <= 0)
    write(tmp_path, steps=[10, 20])
    assert [file.name for file in tmp_path.iterdir()] == [results.JSONL]
    assert [row["step"] for row in rows(tmp_path)] == [0, 0, 10, 10, 20, 20]
    assert rows(tmp_path)[0]["hardware"] == "1 x cpu"


def test_a_crash_between_parquet_and_removal_does_not_double_rows(tmp_path):
    write(tmp_path)
    text = (tmp_path / results.JSONL).read_bytes()
    finish(tmp_path, results.SCHEMA)
    (tmp_path / results.JSONL).write_bytes(text)
    assert results.read(tmp_path).num_rows == 6


def test_reads_runs_at_any_depth_done_or_not_with_their_own_metrics(tmp_path):
    write(tmp_path / "x" / "done")
    finish(tmp_path / "x" / "done", results.SCHEMA)
    write(tmp_path / "going", guidance="none", run="b")
    with TableWriter(tmp_path / "going", results.SCHEMA, CONSTANTS) as writer:
        writer.append(step=30, split="training", seed=0, labels=0, success=0.5)
    TableWriter(tmp_path / "just_begun", results.SCHEMA, CONSTANTS).close()
    table = results.read(tmp_path)
    assert table.num_rows == 13
    assert len(set(table["folder"].to_pylist())) == 2
    assert results.metrics(table) == ["reward", "success"]
    # The same run given twice, once through the folder above it, counts once.
    assert results.read([tmp_path, tmp_path / "going" / results.JSONL]).num_rows == 13


def test_errors_are_one_clear_line(tmp_path):
    def message(*args, **options):
        with pytest.raises(UserError) as caught:
            results.read(*args, **options)
        assert "\n" not in str(caught.value)
        return str(caught.value)

    assert "no results at or below" in message(tmp_path / "nowhere")
    TableWriter(tmp_path / "empty", results.SCHEMA, CONSTANTS).close()
    assert "no rows yet" in message(tmp_path / "empty")
    write(tmp_path / "a")
    write(tmp_path / "b", task="easy")
    assert "easy, one_ball" in message(tmp_path)
    assert set(results.read(tmp_path, task="easy")["task"].to_pylist()) == {"easy"}
    assert "'hard'" in message(tmp_path, task="hard")
