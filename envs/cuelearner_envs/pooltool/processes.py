"""Shots shared out over processes: one of pooltool's takes some 10 ms of one core, and nothing of it runs in JAX."""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
from concurrent.futures import ProcessPoolExecutor
from functools import lru_cache

import numpy as np

from cuelearner_envs.pooltool.outline import Outline, Played

PORTIONS = 4  # of the shots for each process, so that a long one holds up few


def cores() -> int:
    """Processors that this process may use."""
    affinity = getattr(os, "sched_getaffinity", None)
    return len(affinity(0)) if affinity else os.cpu_count() or 1


def play_many(
    outline: Outline, positions: np.ndarray, pocketed: np.ndarray, angles: np.ndarray, processes: int
) -> Played:
    """`game.play` of any number of shots; the same whatever the number of processes (0: one for each processor)."""
    count = processes or cores()
    if count == 1:
        return _play(outline, positions, pocketed, angles)
    pieces = min(len(angles), PORTIONS * count)
    shares = (np.array_split(column, pieces) for column in (positions, pocketed, angles))
    found = list(_pool(count).map(_play, [outline] * pieces, *shares))
    return Played(*(np.concatenate(column) for column in zip(*found, strict=True)))


def _play(outline: Outline, positions: np.ndarray, pocketed: np.ndarray, angles: np.ndarray) -> Played:
    from cuelearner_envs.pooltool.game import play  # seconds to load: not where others play

    return play(outline, positions, pocketed, angles)


@lru_cache(maxsize=1)
def _pool(count: int) -> ProcessPoolExecutor:
    """Processes that wait for shots until this one ends. They are begun anew: a copy of one with threads may hang."""
    return ProcessPoolExecutor(count, multiprocessing.get_context("spawn"), _attend)


def _attend() -> None:
    """An interrupt is for the process that waits, which then ends these; and none of them outlives it."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    assert parent is not None  # it was begun by one
    parent.join()
    os._exit(1)
