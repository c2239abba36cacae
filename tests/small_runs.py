"""The arguments of tiny runs, and what lies in a folder."""

import re
import shlex
import threading
from contextlib import contextmanager
from pathlib import Path

import pytest

from cuelearner_jax.storage import results
from cuelearner_jax.studies import train

SMALL = [
    *("--agent.q-layers", "16", "--sizes.feedback-layers", "16", "--agent.directions", "36"),
    *("--sizes.fit-steps", "20", "--task.search-directions", "90"),
    # However many seeds a test takes, its programs are those of one lane, which the compilation cache then has.
    *("--sizes.lanes-per-block", "1"),
    *("--schedule.total-steps", "200", "--schedule.eval-every", "100", "--schedule.checkpoint-every", "100"),
]
SWEEP = ["sweep", "billiards", "--preset", "quickstart", *SMALL, "--seeds", "2", "--labels", "10", "20"]
SWEEP += ["--guidance", "none", "relative"]


def rows(*folders):
    """Return the results and parameters of runs, lane by lane and step by step."""
    names = ("guidance", "labels", "seed", "step", "reward", "train_loss", "guide_reward")
    found = [{name: row.get(name) for name in names} for row in results.read(folders).to_pylist()]
    return sorted(found, key=lambda row: tuple(str(row[name]).zfill(6) for name in names[:4]))


def listing(folder: Path) -> dict[str, tuple[int, int]]:
    """Every file below a folder with its size and time of change, but for the mark of who wrote last."""
    files = (
        [path for path in sorted(folder.rglob("*")) if path.is_file() and path.name != ".lock"]
        if folder.exists()
        else []
    )
    return {str(path): (path.stat().st_size, path.stat().st_mtime_ns) for path in files}


@contextmanager
def stopping_at(when):
    """Ctrl-C at the given look at the event: each round of labels and each stretch of steps looks once."""

    class Event(threading.Event):
        looks = 0

        def is_set(self):
            Event.looks += 1
            return Event.looks == when

    @contextmanager
    def interruptible():
        yield Event()

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(train, "interruptible", interruptible)
        yield


def next_command(told: str) -> list[str]:
    """Return the command that the output of `cuelearner adapt` names, without its first word."""
    (command,) = re.findall(r"\(measure it with: cuelearner (.*)\)", told)
    return shlex.split(command)
