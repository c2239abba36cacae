"""Frozen behaviour at the public face: what trainings, files, exports and corrections hold while the code moves.

Numbers stand in `frozen.json`, with room for another processor's rounding. After a change of results that is meant:
`FREEZE=1 python -m pytest tests/test_frozen.py` writes them anew. Nothing here looks inside the packages: commands,
`cuelearner_jax`'s public names and files are all that is used, but for the two tasks.
"""

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import frozen_worlds
import numpy as np
import orbax.checkpoint as ocp
import pyarrow.parquet as pq
import pytest
from frozen_worlds import straight

import cuelearner_jax as cl
from cuelearner_jax.cli import main
from cuelearner_jax.config import GuideSizes
from cuelearner_jax.errors import UserError

ENTRY = str(Path(sys.executable).with_name("cuelearner"))
STORED = Path(__file__).with_name("frozen.json")
NUMBERS = json.loads(STORED.read_text()) if STORED.exists() else {}


def check(name, found, rtol=1e-4):
    """Compare numbers with those stored under a name, or store them."""
    found = [float(value) for value in found]
    if os.environ.get("FREEZE"):
        NUMBERS[name] = [float(f"{value:.8g}") for value in found]
        STORED.write_text(json.dumps(NUMBERS, indent=1) + "\n")
    np.testing.assert_allclose(found, NUMBERS[name], rtol=rtol, atol=1e-6, err_msg=name)


def sums(arrays):
    """Return how many numbers arrays hold, and the sums of the positive ones, of the negative ones and of squares."""
    flat = np.concatenate([np.asarray(array, np.float64).ravel() for array in arrays])
    return len(flat), flat[flat > 0].sum(), flat[flat < 0].sum(), (flat**2).sum()


KINDS = {  # those for whose parts no other kind stands
    "flat": ["none", "relative", "scalar", "dcoach", "bdcoach", "intent"],
    "boxed": ["none", "relative", "demonstration", "clic"],
}
ANGLES = np.linspace(0, 6, 40, dtype=np.float32)
SEEN = np.stack([np.cos(ANGLES), np.sin(ANGLES)], -1)
USED = ("flat", "relative")  # by the test of label files
SHORT = USED, ("boxed", "demonstration"), ("billiards", "relative")  # tests/guides/ holds how the others differ
ALL = [(world, kind) for world, kinds in {**KINDS, "billiards": ["relative"]}.items() for kind in kinds]
CASES = [pytest.param(*case, marks=[] if case in SHORT else [pytest.mark.long]) for case in ALL]


def checkpoint(folder, item):
    """Return the arrays of a kind's newest checkpoint by name."""
    newest = max(int(path.name) for path in (folder / "checkpoints").iterdir() if path.name.isdigit())
    return ocp.PyTreeCheckpointer().restore(folder / "checkpoints" / str(newest) / item)


def rows(folder):
    """Return the rows of a kind's results without those columns that another run of it has otherwise."""
    table = pq.read_table(folder / "results.parquet")
    return table.drop_columns(["run", "wall_s", "commit", "command", "config_hash"]).to_pylist()


def assert_same_arrays(folder, other):
    """Of two runs the newest checkpoints hold the same bits."""
    for item in ("policy", "rest"):
        mine, its = checkpoint(folder, item), checkpoint(other, item)
        assert mine.keys() == its.keys()
        assert all(np.asarray(mine[name]).tobytes() == np.asarray(its[name]).tobytes() for name in mine)


def run(*command):
    """Run a command, which must succeed."""
    assert main([str(word) for word in command]) == 0


@pytest.fixture(scope="module")
def runs(request, tmp_path_factory):
    """Every kind of guidance of the chosen tests, on both worlds."""
    home = tmp_path_factory.mktemp("frozen")
    params = [getattr(getattr(item, "callspec", None), "params", {}) for item in request.session.items]
    chosen = {USED, *((one.get("world"), one.get("kind")) for one in params)}
    for name, all_kinds in KINDS.items():
        if kinds := [kind for kind in all_kinds if (name, kind) in chosen]:
            run("sweep", f"frozen_worlds:{name.upper()}", "--seeds", 1, "--guidance", *kinds, "--out", home / name)
    small = ["--agent.q-layers", 16, "--agent.directions", 36, "--task.search-directions", 90, "--labels", 20]
    small += ["--sizes.feedback-layers", 16, "--sizes.fit-steps", 20, "--schedule.total-steps", 200]
    small += ["--schedule.eval-every", 200, "--schedule.checkpoint-every", 200, "--task.table", "easy", "--seed", 3]
    run("train", "billiards", *small, "--guidance", "relative", "--out", home / "billiards")
    return home


@pytest.mark.filterwarnings("ignore:Sharding info")
@pytest.mark.parametrize(("world", "kind"), CASES)
def test_a_training_ends_with_the_stored_parameters_replay_and_rows(runs, world, kind):
    folder = runs / world / kind
    (replay,) = [leaf for name, leaf in checkpoint(folder, "rest").items() if name.endswith(".agent.replay")]
    rtol = 2e-2 if kind.startswith("clic") else 1e-4  # its search carries another processor's rounding far
    check(f"{world} {kind} policy", sums(checkpoint(folder, "policy").values()), rtol)
    check(f"{world} {kind} replay", sums([replay]), rtol)
    last = rows(folder)[-1]
    check(f"{world} {kind} row", [last[name] for name in ("step", "reward", "train_loss", "train_reward")], rtol)


@pytest.mark.filterwarnings("ignore:Sharding info")
def test_a_killed_sweep_goes_on_to_the_same_bits(tmp_path):
    sweep = ["sweep", "frozen_worlds:FLAT", "--guidance", "relative", "--seeds", 2, "--labels", 20]
    sweep += ["--schedule.total-steps", 2400, "--schedule.guidance-until", 1200, "--schedule.checkpoint-every", 480]
    run(*sweep, "--out", tmp_path / "whole")
    killed = tmp_path / "killed"
    command = [ENTRY, *map(str, sweep), "--out", killed]
    process = subprocess.Popen(command, cwd=Path(__file__).parent, stderr=subprocess.DEVNULL)
    growing = killed / "relative" / "results.jsonl"
    while process.poll() is None and not (growing.exists() and '"step": 960' in growing.read_text()):
        time.sleep(0.02)
    process.send_signal(signal.SIGKILL)
    assert process.wait() == -signal.SIGKILL
    run(*sweep, "--out", killed, "--resume")
    assert rows(killed / "relative") == rows(tmp_path / "whole" / "relative")
    assert_same_arrays(killed / "relative", tmp_path / "whole" / "relative")


def test_a_label_file_has_its_stored_form(runs):
    table = pq.read_table(runs / "flat" / "relative" / "labels.parquet")
    told = json.loads(table.schema.metadata[b"cuelearner"])
    assert table.schema.names == ["seed", "obs", "action", "answer"]
    assert (told["format"], told["task"]["name"], told["answers"], told["eps"]) == (1, "flat", "relative", 20.0)
    check("labels", sums(table[name].combine_chunks().flatten() for name in ("obs", "action", "answer")))


def test_an_exported_agent_decides_the_stored_golden_cases(runs, tmp_path):
    run("export", runs / "billiards", "--format", "numpy", "--out", tmp_path / "agent")
    decide = cl.load_exported(tmp_path / "agent")  # replays the golden cases
    with np.load(tmp_path / "agent" / "golden.npz") as golden:
        check("golden cases", [*sums([golden["obs"]]), *sums([golden["actions"]])])
        np.testing.assert_allclose(decide(golden["obs"]), golden["actions"], atol=1e-5)


FIT = ["--sizes.feedback-layers", 16, "--sizes.fit-steps", 40, "--sizes.fit-batch-size", 16, "--guidance"]
SIZES = GuideSizes(feedback_layers=(16,), fit_steps=40, fit_batch_size=16)


@pytest.mark.filterwarnings("ignore:.*not shown to be better")
def test_python_adapts_and_measures_as_the_commands_do(tmp_path):
    command = ["adapt", "frozen_worlds:straight", "--task", "frozen_worlds:FLAT", "--labels", 20, "--judge-by", "hit"]
    run(*command, *FIT, "relative", "--judge-episodes", 20, "--out", tmp_path / "command")
    world = cl.make("frozen_worlds:FLAT")
    how = {"guidance": "relative", "labels": 20, "judge_by": "hit", "judge_episodes": 20}
    better = cl.adapt(straight, world, cl.teacher_of(world), sizes=SIZES, **how)
    better.save(tmp_path / "python")
    command, python = (json.loads((tmp_path / name / "policy.json").read_text()) for name in ("command", "python"))
    for values in (command, python):  # what was typed, and the digest of all
        del values["command"], values["digest"]
    assert command == python  # with the digest of all arrays
    check("adapted", [*better.judged[1:], *sums([better(SEEN)])])
    evaluate = ["evaluate", tmp_path / "command", "--task", "frozen_worlds:FLAT", "--base", "frozen_worlds:straight"]
    run(*evaluate, "--steps", 400, "--envs", 20, "--out", tmp_path / "rows.json")
    (row,) = json.loads((tmp_path / "rows.json").read_text())["rows"]
    found = cl.measure(better, world, steps=400, envs=20).metrics
    assert {name: values.tolist() for name, values in found.items()} == {name: row[name] for name in found}


@pytest.mark.parametrize("kind", ["relative", pytest.param("reading", marks=pytest.mark.long)])
def test_python_corrects_by_a_label_file_as_the_command_does(tmp_path, kind):
    file = frozen_worlds.recorded_labels(tmp_path)
    run("adapt", "frozen_worlds:straight", "--labels-from", file, "--guidance", kind, "--out", tmp_path / "command")
    better = cl.correct(straight, file, guidance=kind)
    np.testing.assert_array_equal(cl.load_policy(tmp_path / "command", base=straight)(SEEN), better(SEEN))
    with pytest.raises(UserError, match="corrects frozen_worlds:straight, but the base given acts otherwise"):
        cl.load_policy(tmp_path / "command", base=lambda obs: obs[:, ::-1])
    # Adam amplifies the rounding of what the evidence does not decide: by 4% between processors
    check(f"corrected {kind}", [*better.judged[1:], *sums([better(SEEN)])], 0.05 if kind == "reading" else 1e-4)
