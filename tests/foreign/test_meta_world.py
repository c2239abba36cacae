"""A task of Meta-World, whose script is corrected after its camera was moved."""

import sys

import pytest


def test_a_reach_is_corrected(tmp_path, monkeypatch):
    pytest.importorskip("metaworld")
    import scripted_arms as study

    monkeypatch.setattr(study, "REPORTED", 5)
    study.main(["--robots", "reach", "--changes", "camera 5 cm aside", "--seeds", "1", "--out", str(tmp_path)])
    row = sys.modules["pyarrow.parquet"].read_table(tmp_path / "reach.parquet").to_pylist()[0]
    assert row["before"] < 0.2
    assert row["after"] > 0.8
