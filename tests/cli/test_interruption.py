import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from small_runs import SMALL

from cuelearner_jax.records import results

ENTRY = [str(Path(sys.executable).with_name("cuelearner"))]
STEPS = 2000
LONG = [*SMALL, "--schedule.total-steps", str(STEPS), "--guidance", "none", "--seeds", "2"]
COMMAND = [*ENTRY, "sweep", "billiards", "--preset", "quickstart", *LONG]


def rows(folder):
    table = results.read(folder).to_pylist()
    return [{name: row[name] for name in ("seed", "step", "labels", "reward", "scored", "train_loss")} for row in table]


def start_and_wait_for(folder, step):
    process = subprocess.Popen([*COMMAND, "--out", str(folder)], stderr=subprocess.PIPE, text=True)
    for _ in range(1200):
        file = folder / "none" / "results.jsonl"
        if file.exists() and f'"step": {step}' in file.read_text():
            return process
        if process.poll() is not None:
            break
        time.sleep(0.1)
    raise AssertionError(process.communicate()[1])


@pytest.fixture(scope="module")
def uninterrupted(tmp_path_factory):
    folder = tmp_path_factory.mktemp("whole") / "run"
    subprocess.run([*COMMAND, "--out", str(folder)], check=True, capture_output=True, timeout=300)
    return rows(folder)


def test_ctrl_c_saves_and_resume_goes_on_as_if_never_stopped(tmp_path, uninterrupted):
    folder = tmp_path / "run"
    process = start_and_wait_for(folder, 200)
    process.send_signal(signal.SIGINT)
    told = process.communicate(timeout=120)[1]
    assert process.returncode == 130
    assert "--resume" in told.splitlines()[-1]
    reached = max(row["step"] for row in rows(folder))
    assert reached < STEPS
    subprocess.run([*COMMAND, "--out", str(folder), "--resume"], check=True, capture_output=True, timeout=300)
    assert rows(folder) == uninterrupted


def test_kill_loses_one_stretch_at_most_and_resume_goes_on(tmp_path, uninterrupted):
    folder = tmp_path / "run"
    process = start_and_wait_for(folder, 300)
    process.kill()
    process.communicate(timeout=60)
    resumed = subprocess.run(
        [*COMMAND, "--out", str(folder), "--resume"], check=False, capture_output=True, timeout=300
    )
    assert resumed.returncode == 0
    assert rows(folder) == uninterrupted
    saved = sorted(int(path.name) for path in (folder / "none" / "checkpoints").iterdir() if path.name.isdigit())
    assert saved[-1] == STEPS
