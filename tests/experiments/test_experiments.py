"""The files of `experiments/` explain themselves."""

import ast
import runpy
import sys
from pathlib import Path

import pytest

FOLDER = Path(__file__).parents[2] / "experiments"


@pytest.mark.parametrize("file", sorted(FOLDER.glob("[!_]*.py")), ids=lambda file: file.stem)
def test_an_experiment_has_a_help_of_its_own(file, monkeypatch, capsys):
    if "lerobot" in file.stem:  # it needs an environment of its own
        pytest.importorskip("lerobot")
    monkeypatch.setattr(sys, "argv", [str(file), "--help"])
    with pytest.raises(SystemExit) as stopped:
        runpy.run_path(str(file), run_name="__main__")
    assert not stopped.value.code
    told = capsys.readouterr().out
    assert told.startswith(f"usage: {file.name}")
    about = ast.get_docstring(ast.parse(file.read_text(encoding="utf-8")))
    assert about
    assert about.splitlines()[0] in told
