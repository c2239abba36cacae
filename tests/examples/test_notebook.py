"""The notebook of the quickstart, executed as a reader does, with less of everything."""

from pathlib import Path

import nbclient
import nbformat
import pytest

NOTEBOOK = Path(__file__).resolve().parents[2] / "examples" / "quickstart.ipynb"
LESS = """KINDS = ("relative",)
SEEDS, LABELS, STEPS = 1, 10, 200
NETWORKS = {"feedback_layers": (8,), "fit_steps": 20}
AGENT = {"q_layers": (8,), "directions": 36, "coarse_directions": 0}"""


@pytest.mark.long
def test_the_notebook_runs_from_top_to_bottom(tmp_path):
    notebook = nbformat.read(NOTEBOOK, as_version=4)
    cells = [cell for cell in notebook.cells if cell.cell_type == "code"]
    assert all(not cell.outputs for cell in cells), "it is kept without what it printed here"
    assert cells[0].source.startswith("KINDS = ")
    cells[0].source = LESS
    nbclient.NotebookClient(notebook, timeout=600, resources={"metadata": {"path": str(tmp_path)}}).execute()
    told = "".join(output.get("text", "") for cell in cells for output in cell.outputs)
    assert "cue ball: place" in told
    assert "3 evaluations" in told  # at steps 0, 100 and 200
    assert "of at most 2" in told
    assert "'contract.json', 'decide.py', 'decision.npz', 'golden.npz'" in told
