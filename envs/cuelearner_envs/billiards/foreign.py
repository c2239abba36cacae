"""Billiards whose shots another engine plays, shared out over processes: nothing of them runs in JAX."""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from functools import lru_cache, partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Float

from cuelearner_envs.billiards.environment import Balls, Billiards
from cuelearner_envs.billiards.physics import Shot
from cuelearner_envs.billiards.table import parking

PORTIONS = 4  # of the shots for each process, so that a long one holds up few


class Played(NamedTuple):
    """Outcomes of shots."""

    positions: np.ndarray  # (shots, balls, 2) at rest; of a pocketed ball without meaning [m]
    pocketed: np.ndarray  # (shots, balls) bool, those from before included
    duration: np.ndarray  # (shots,) [s]
    events: np.ndarray  # (shots,) int
    exhausted: np.ndarray  # (shots,) bool: halted before the balls rested


# Plays shots one after another: positions (shots, balls, 2) [m], pocketed (shots, balls) bool, angles (shots,) [rad] ->
# outcomes. A value that can be pickled, compared and hashed.
Engine = Callable[[np.ndarray, np.ndarray, np.ndarray], Played]


class ForeignBilliards(Billiards, kw_only=True):
    """The environment (`cuelearner_jax.environment.Environment`), with the interface of `Billiards`.

    A shot leaves the compiled program (`jax.pure_callback`) and is played in other processes. Of the table's constants
    those count that the engine has.
    """

    engine: Engine = struct.field(pytree_node=False)
    processes: int = struct.field(pytree_node=False, default=0)  # that play; 0: one for each processor

    def shot(self, balls: Balls, angle: Float[Array, ""]) -> Shot:
        """Play one shot; batches are distributed among processes."""
        count = self.table.balls
        shapes = (
            jax.ShapeDtypeStruct((count, 2), jnp.float32),
            jax.ShapeDtypeStruct((count,), jnp.bool_),
            jax.ShapeDtypeStruct((), jnp.float32),
            jax.ShapeDtypeStruct((), jnp.int32),
            jax.ShapeDtypeStruct((), jnp.bool_),
        )
        call = partial(_played, self.engine, self.processes)
        positions, *rest = jax.pure_callback(
            call, shapes, balls.positions, balls.pocketed, angle, vmap_method="broadcast_all"
        )
        places = jnp.where(rest[0][:, None], parking(self.table), positions)
        return Shot(places.astype(jnp.float32), *rest)


def _played(engine: Engine, processes: int, positions: Array, pocketed: Array, angle: Array) -> tuple[np.ndarray, ...]:
    """Shots with any leading axes."""
    leading, balls = np.shape(angle), np.shape(pocketed)[-1]
    shapes = (positions, (-1, balls, 2)), (pocketed, (-1, balls)), (angle, -1)
    found = play_many(engine, *(np.asarray(column).reshape(shape) for column, shape in shapes), processes=processes)
    return tuple(column.reshape((*leading, *column.shape[1:])) for column in found)


def cores() -> int:
    """Processors that this process may use."""
    affinity = getattr(os, "sched_getaffinity", None)
    return len(affinity(0)) if affinity else os.cpu_count() or 1


def play_many(
    engine: Engine, positions: np.ndarray, pocketed: np.ndarray, angles: np.ndarray, processes: int
) -> Played:
    """Any number of an engine's shots; the same whatever the number of processes (0: one for each processor)."""
    count = processes or cores()
    if count == 1:
        return engine(positions, pocketed, angles)
    pieces = min(len(angles), PORTIONS * count)
    shares = (np.array_split(column, pieces) for column in (positions, pocketed, angles))
    found = list(_pool(count).map(engine, *shares))
    return Played(*(np.concatenate(column) for column in zip(*found, strict=True)))


@lru_cache(maxsize=1)
def _pool(count: int) -> ProcessPoolExecutor:
    """Processes that wait for shots until this one ends. They are begun anew: a copy of one with threads may hang."""
    return ProcessPoolExecutor(count, multiprocessing.get_context("spawn"), _attend)


def _attend() -> None:
    """An interrupt is for the process that waits, which then ends these; none of them outlives it or takes its GPU."""
    jax.config.update("jax_platforms", "cpu")
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    assert parent is not None  # it was begun by one
    parent.join()
    os._exit(1)
