"""Ctrl-C and its like: heard at once in a process of the command's own, between two calls elsewhere."""

import os
import signal
import subprocess
import sys
import time

import pytest

from cuelearner_jax.signals import Interrupted, interruptible

# A call that keeps Python waiting for minutes, as compiled code does.
BUSY = "import hashlib; print('ready', flush=True); hashlib.pbkdf2_hmac('sha256', b'', b'', 10**9)"
LISTEN = "from cuelearner_jax import signals; signals.listen();"


@pytest.fixture
def started():
    """Starts a script and waits until it says that it is ready; none is left behind."""
    processes = []

    def start(script):
        pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
        process = subprocess.Popen([sys.executable, "-c", script], text=True, **pipes)
        processes.append(process)
        assert process.stdout is not None
        assert process.stdout.readline() == "ready\n"
        return process

    yield start
    for process in processes:
        process.kill()


@pytest.mark.parametrize(("number", "status"), [(signal.SIGINT, 130), (signal.SIGTERM, 143), (signal.SIGHUP, 129)])
def test_a_command_with_nothing_to_save_ends_at_once_in_one_line(started, number, status):
    process = started(f"{LISTEN} {BUSY}")
    process.send_signal(number)
    told = process.communicate(timeout=20)[1]
    assert process.returncode == status
    assert told == "stopped at once; what was saved before is safe\n"


def test_the_first_signal_is_told_at_once_and_a_second_ctrl_c_ends_compiled_code(started):
    process = started(f"{LISTEN} guard = signals.interruptible(); guard.__enter__(); {BUSY}")
    process.send_signal(signal.SIGTERM)
    assert process.stderr is not None
    assert process.stderr.readline() == "stopping after this stretch of steps (Ctrl-C again: at once)\n"
    process.send_signal(signal.SIGTERM)  # schedulers repeat themselves
    time.sleep(0.3)
    assert process.poll() is None
    process.send_signal(signal.SIGINT)
    assert "stopped at once" in process.communicate(timeout=20)[1]
    assert process.returncode == 130


def test_elsewhere_a_second_ctrl_c_raises(capsys):
    before = signal.getsignal(signal.SIGTERM)
    with pytest.raises(KeyboardInterrupt), interruptible("this game") as stopping:  # noqa: PT012
        os.kill(os.getpid(), signal.SIGTERM)
        os.kill(os.getpid(), signal.SIGTERM)
        assert stopping.is_set()
        os.kill(os.getpid(), signal.SIGINT)
    assert capsys.readouterr().err == "stopping after this game (Ctrl-C again: at once)\n"
    assert signal.getsignal(signal.SIGTERM) == before


def test_an_interruption_has_the_status_of_its_signal():
    for number in (signal.SIGINT, signal.SIGTERM):
        with pytest.raises(Interrupted) as end, interruptible():  # noqa: PT012
            os.kill(os.getpid(), number)
            raise Interrupted("stopped")
        assert end.value.status == 128 + number
