import signal
import subprocess
import sys
import time
from pathlib import Path

from small_runs import BANDIT, rows

from cuelearner_jax.cli import main

ENTRY = [str(Path(sys.executable).with_name("cuelearner"))]
STEPS = 4000
COMMAND = ["sweep", BANDIT, "--schedule.total-steps", str(STEPS), "--guidance", "none", "--seeds", "2"]
TESTS = str(Path(__file__).resolve().parents[1])


def start_and_wait_for(folder, step):
    command = [*ENTRY, *COMMAND, "--out", str(folder)]
    process = subprocess.Popen(command, cwd=TESTS, stderr=subprocess.PIPE, text=True)
    for _ in range(1200):
        file = folder / "none" / "results.jsonl"
        if file.exists() and f'"step": {step}' in file.read_text():
            return process
        if process.poll() is not None:
            break
        time.sleep(0.1)
    raise AssertionError(process.communicate()[1])


def test_ctrl_c_saves_and_resume_goes_on(tmp_path):
    """To the bits of a run that was never stopped: tests/runs/test_resume.py and tests/test_frozen.py."""
    folder = tmp_path / "run"
    process = start_and_wait_for(folder, 200)
    process.send_signal(signal.SIGINT)
    told = process.communicate(timeout=120)[1]
    assert process.returncode == 128 + signal.SIGINT
    assert "--resume" in told.splitlines()[-1]
    reached = max(row["step"] for row in rows(folder))
    assert str(reached) in {path.name for path in (folder / "none" / "checkpoints").iterdir()}
    assert reached < STEPS
    assert main([*COMMAND, "--out", str(folder), "--resume"]) == 0
    steps = [row["step"] for row in rows(folder)]
    assert steps == 2 * list(range(0, STEPS + 1, 100))


def test_a_reader_that_has_gone_is_told_by_the_status():
    script = ["bash", "-c", '"$@" | head -0; exit ${PIPESTATUS[0]}', "bash", *ENTRY, "--help"]
    done = subprocess.run(script, capture_output=True, text=True, check=False, timeout=120)
    assert (done.returncode, done.stderr) == (141, "")
