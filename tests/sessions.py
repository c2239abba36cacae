"""Sessions on the bandit, answered as its expert would."""

import contextlib
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import page_task
import probes

from cuelearner_jax import asking
from cuelearner_jax.guides import registry as guidances
from cuelearner_jax.labelling.plan import Base, SessionPlan, keys_of
from cuelearner_jax.policies import Uniform

TESTS = Path(__file__).resolve().parent
OWN = "page_task:TASK"  # as commands name it
ENV = page_task.TASK.environment(probes.CONFIG.task)


def plan(labels=20, kind="relative", base=None, config=probes.CONFIG, **others):
    """Return the plan of a session on the bandit."""
    guidance = guidances.make(kind, probes.SIZES, ENV)
    return SessionPlan(page_task.TASK, config, guidance, base or Base(Uniform(), "uniform"), labels, **others)


def expert(item, eps_deg=probes.SCALARS.eps_deg):
    """Return the expert's answer: the side of its best action, or 0 within half of eps (by angles)."""
    best = np.asarray(ENV.best(item.guide.obs), float)
    apart = np.degrees(np.arctan2(item.action[0] * best[1] - item.action[1] * best[0], item.action @ best))
    return np.array([0.0 if abs(apart) <= eps_deg / 2 else np.sign(apart)], np.float32)


def give(session, count, eps_deg=probes.SCALARS.eps_deg):
    """Answers so many questions; returns the items."""
    items = []
    for _ in range(count):
        items.append(session.item)
        assert session.answer(session.number, expert(session.item, eps_deg))
    return items


def taught(kind):
    """A kind of guidance, its guide at the start, and that after the first round of a simulated teacher."""
    guidance, keys = guidances.make(kind, probes.SIZES, ENV), keys_of(0)
    guide = asking.start(guidance, ENV, 20, 20, keys.model, keys.start)
    round_of = probes.label_rounds(guidance, probes.SIZES)
    return guidance, guide, round_of(ENV, probes.Expert(ENV), probes.SCALARS, Uniform(), guide, keys.session)


def settled(session, fits):
    """Wait until nothing is fitted any more; there are so many fits."""
    for thread in (session._fits, session._ahead):
        thread.submit(lambda: None).result()
    assert session.status().newest.number == fits
    return session.status()


@contextlib.contextmanager
def served(folder, *more, task=OWN):
    """The command in a process of its own, once it has told its address: the process and that."""
    paths = os.pathsep.join([str(TESTS), str(TESTS.parent), str(TESTS.parent / "envs")])
    env = {**os.environ, "PYTHONPATH": paths, "PYTHONUNBUFFERED": "1"}
    command = [sys.executable, "-m", "cuelearner_jax.cli", "label", task, "--out", str(folder), "--labels", "20", *more]
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    with subprocess.Popen(command, env=env, **pipes) as process:
        try:
            told = next((line for line in process.stdout if line.startswith("open ")), "")
            assert told, process.stderr.read()
            yield process, told.split()[1]
        finally:
            process.kill()
