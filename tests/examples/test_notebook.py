"""The notebooks, executed as a reader does, with less of everything."""

import re
from pathlib import Path

import nbclient
import nbformat
import pytest

EXAMPLES = Path(__file__).resolve().parents[2] / "examples"
QUICKSTART = """KINDS = ("relative",)
SEEDS, LABELS, STEPS = 1, 10, 200
NETWORKS = {"feedback_layers": (8,), "fit_steps": 20}
AGENT = {"q_layers": (8,), "directions": 36, "coarse_directions": 0}"""
FETCH_PUSH = """ROLL_OUTS, GRADIENT_STEPS = 4, 50
LABELS, MEASURED = 20, 2"""
FILES = "'contract.json', 'decide.py', 'decision.npz', 'golden.npz'"


@pytest.mark.long
@pytest.mark.parametrize(
    ("name", "needs", "less", "words"),
    [  # three evaluations: at steps 0, 100 and 200
        ("quickstart", (), QUICKSTART, ["cue ball: place", "3 evaluations", "of at most 2", FILES]),
        (
            "sb3_fetch_push",
            ("torch", "stable_baselines3", "gymnasium_robotics"),
            FETCH_PUSH,
            ["200 situations", "success with .* displaced: [01]", "rewarded steps: 0", "success after 20 answers: "],
        ),
    ],
)
def test_a_notebook_runs_from_top_to_bottom(tmp_path, name, needs, less, words):
    for needed in needs:
        pytest.importorskip(needed)
    notebook = nbformat.read(EXAMPLES / f"{name}.ipynb", as_version=4)
    cells = [cell for cell in notebook.cells if cell.cell_type == "code"]
    assert all(not cell.outputs for cell in cells), "it is kept without what it printed here"
    assert cells[0].source.split(" = ")[0] == less.split(" = ")[0]
    cells[0].source = less
    nbclient.NotebookClient(notebook, timeout=900, resources={"metadata": {"path": str(tmp_path)}}).execute()
    told = "".join(output.get("text", "") for cell in cells for output in cell.outputs)
    assert all(re.search(word, told) for word in words)
