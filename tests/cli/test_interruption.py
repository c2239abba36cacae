import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

from small_runs import BANDIT, rows, stopping_at

from cuelearner_jax.cli import main

ENTRY = [str(Path(sys.executable).with_name("cuelearner"))]
STEPS = 4000
COMMAND = ["sweep", BANDIT, "--schedule.total-steps", str(STEPS), "--guidance", "none", "--seeds", "2"]


def interrupt_after(folder, step):
    """Send Ctrl-C to this process once a step is on the disk."""
    file = folder / "none" / "results.jsonl"
    while not (file.exists() and f'"step": {step}' in file.read_text()):
        time.sleep(0.02)
    os.kill(os.getpid(), signal.SIGINT)


def test_ctrl_c_saves_and_resume_goes_on(tmp_path, capsys):
    """To the bits of a run that was never stopped: tests/runs/test_resume.py and tests/test_frozen.py."""
    folder = tmp_path / "run"
    thread = threading.Thread(target=interrupt_after, args=(folder, 200), daemon=True)
    thread.start()
    assert main([*COMMAND, "--out", str(folder)]) == 128 + signal.SIGINT
    thread.join()
    assert "--resume" in capsys.readouterr().err.splitlines()[-1]
    reached = max(row["step"] for row in rows(folder))
    assert str(reached) in {path.name for path in (folder / "none" / "checkpoints").iterdir()}
    assert reached < STEPS
    with stopping_at(3):  # as far as it takes to see that it goes on
        assert main([*COMMAND, "--out", str(folder), "--resume"]) == 130
    assert max(row["step"] for row in rows(folder)) > reached


def test_a_reader_that_has_gone_is_told_by_the_status():
    script = ["bash", "-c", '"$@" | head -0; exit ${PIPESTATUS[0]}', "bash", *ENTRY, "--help"]
    done = subprocess.run(script, capture_output=True, text=True, check=False, timeout=120)
    assert (done.returncode, done.stderr) == (141, "")
