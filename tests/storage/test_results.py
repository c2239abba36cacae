"""The results of several runs as one table: what is found where, says of its origin, and is refused in one line."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from cuelearner_jax.errors import UserError
from cuelearner_jax.storage import results
from cuelearner_jax.storage.provenance import provenance
from cuelearner_jax.storage.table import TableWriter, finish

ROOT = Path(__file__).parents[2]
CONSTANTS = {"run": "a", "task": "one_ball", "guidance": "relative", "config_hash": "0f", "hardware": "1 x cpu"}
SEEDS, LABELS = np.array([3, 4]), np.array([100, 500])


def write(folder, **constants):
    with TableWriter(folder, results.SCHEMA, CONSTANTS | constants) as writer:
        for step in (0, 10, 20):
            reward = np.array([step / 100, step / 50])
            writer.append(step=step, split="validation", seed=SEEDS, labels=LABELS, reward=reward, wall_s=1.5)


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
    assert table["seed"].to_pylist()[:6] == [3, 4] * 3
    assert table["step"].type == pa.int64()
    assert len(set(table["folder"].to_pylist())) == 2
    assert results.metrics(table) == ["reward", "success"]
    # The same run given twice, once through the folder above it, counts once.
    assert results.read([tmp_path, tmp_path / "going" / results.JSONL]).num_rows == 13


def test_every_column_has_its_meaning_in_the_file_and_on_the_page(tmp_path):
    write(tmp_path)
    with pq.ParquetFile(finish(tmp_path, results.SCHEMA)) as file:
        meanings = {field.name: field.metadata[b"description"].decode() for field in file.schema_arrow}
    assert meanings["seed"] == results.MEANINGS["seed"]
    assert meanings["reward"] == results.MEANINGS["*"]
    page = (ROOT / "docs/reference/columns.md").read_text(encoding="utf-8")
    rows = (line.strip("| ").split(" | ") for line in page.splitlines() if line.startswith("| `"))
    assert {name.strip("`"): meaning for name, meaning in rows} == results.MEANINGS


def test_errors_are_one_clear_line(tmp_path):
    def message(folder):
        with pytest.raises(UserError) as caught:
            results.read(folder)
        assert "\n" not in str(caught.value)
        return str(caught.value)

    assert "no results at or below" in message(tmp_path / "nowhere")
    TableWriter(tmp_path / "empty", results.SCHEMA, CONSTANTS).close()
    assert "no rows yet" in message(tmp_path / "empty")
    TableWriter(tmp_path / "empty", results.GUIDES, CONSTANTS).close()
    assert results.read_guides([tmp_path]) is None  # the first kind is being labelled
    write(tmp_path / "a")
    write(tmp_path / "b", task="easy")
    assert set(results.read(tmp_path)["task"].to_pylist()) == {"easy", "one_ball"}  # no error: the rows tell them apart


def test_the_command_can_be_given_again(monkeypatch):
    monkeypatch.setattr(sys, "argv", ["/some/where/cuelearner", "sweep", "a task", "--seeds", "2"])
    columns = provenance()
    assert columns["command"] == "cuelearner sweep 'a task' --seeds 2"
    assert columns["versions"].startswith(f"python {sys.version.split()[0]}, ")
    assert "jax 0." in columns["versions"]
    assert columns["hardware"]


def test_the_commit_is_that_of_the_checkout_or_empty():
    git = ["git", "-C", ROOT, "rev-parse", "HEAD"]
    head = subprocess.run(git, capture_output=True, text=True, check=True).stdout if (ROOT / ".git").exists() else ""
    assert provenance()["commit"].removesuffix("-dirty") == head[:12]
