"""Tiny runs: their arguments and a task that compiles fast; what lies in a folder."""

import dataclasses
import re
import shlex
import threading
from contextlib import contextmanager

import page_task
import probes
import pytest

from cuelearner_jax.storage import results
from cuelearner_jax.studies import train
from cuelearner_jax.task import Preset

SMALL = [
    *("--agent.q-layers", "16", "--sizes.feedback-layers", "16", "--agent.directions", "36"),
    *("--sizes.fit-steps", "20", "--task.search-directions", "90"),
    *("--sizes.lanes-per-block", "1"),
    *("--schedule.total-steps", "200", "--schedule.eval-every", "100", "--schedule.checkpoint-every", "100"),
]
CONFIG = probes.config(
    sizes={"feedback_layers": (16,), "fit_steps": 20, "lanes_per_block": 1},
    schedule={"total_steps": 200, "eval_every": 100, "checkpoint_every": 100, "eval_envs": 40, "eval_steps": 400},
    agent={"q_layers": (16,)},
)
TASK = dataclasses.replace(
    page_task.TASK, name="bandit", presets={"quickstart": Preset("tiny", CONFIG, first_seed=2000)}
)
BANDIT = "small_runs:TASK"  # as commands name it
SWEEP = ["sweep", BANDIT, "--seeds", "2", "--labels", "10", "20", "--guidance", "none", "relative"]


def rows(*folders):
    """Return the results and parameters of runs, lane by lane and step by step."""
    names = ("guidance", "labels", "seed", "step", "reward", "train_loss", "guide_reward")
    found = [{name: row.get(name) for name in names} for row in results.read(folders).to_pylist()]
    return sorted(found, key=lambda row: tuple(str(row[name]).zfill(6) for name in names[:4]))


def listing(folder):
    """Every file below a folder with its size and time of change, but for the mark of who wrote last."""
    files = (path for path in folder.rglob("*") if path.is_file() and path.name != ".lock")
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
