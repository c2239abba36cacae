"""The pool finds the instance at the place that a state names, or brings one there by replaying its actions."""

from __future__ import annotations

import atexit
import contextlib
import os
import pickle
import socket
import subprocess
import sys
import threading
from collections import OrderedDict
from collections.abc import Iterator, Mapping, Sequence
from ctypes.util import find_library
from dataclasses import dataclass, field
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import numpy as np

from cuelearner_jax.bridges.gymnasium.instances import Instances, Order, Shot, Went
from cuelearner_jax.bridges.gymnasium.source import Source
from cuelearner_jax.errors import UserError

WORKER = "cuelearner_jax.bridges.gymnasium.worker"
PACKAGES = Path(__file__).parents[3]  # folder that this package is imported from
MOST_POOLS = 8  # most pools open at once
MOST_INSTANCES = 1024  # spare instances of a pool, beyond those that one call needs
RECENT = 16  # an instance that was used within so many calls is kept


class Process:
    """Instances in a process of their own."""

    def __init__(self, sent: bytes, more: Mapping[str, str]) -> None:
        """Start the process.

        Args:
            sent: the arguments of `Instances`, pickled.
            more: variables of its environment beside ours.
        """
        ours, theirs = socket.socketpair()
        command = [sys.executable, "-m", WORKER, str(theirs.fileno()), str(os.getpid())]
        paths = os.pathsep.join([str(PACKAGES), *filter(None, [os.environ.get("PYTHONPATH")])])
        environ = {**os.environ, "PYTHONPATH": paths, **more}
        # An environment's prints must not mix with our output.
        self.child = subprocess.Popen(
            command, pass_fds=(theirs.fileno(),), stdin=subprocess.DEVNULL, stdout=2, env=environ
        )
        theirs.close()
        self.link = Connection(ours.detach())
        self.link.send([entry or os.getcwd() for entry in sys.path])
        self.link.send_bytes(sent)

    def send(self, orders: Sequence[Order | Shot]) -> None:
        """Give orders, to be answered by `receive`."""
        with contextlib.suppress(OSError):  # `receive` reports it
            self.link.send_bytes(pickle.dumps(orders, pickle.HIGHEST_PROTOCOL))

    def receive(self, count: int) -> list[Any] | None:
        """Return the results of the orders; None: the process is gone."""
        try:
            return pickle.loads(self.link.recv_bytes())
        except (EOFError, OSError):
            return None

    def close(self) -> None:
        """End the process."""
        self.link.close()
        try:
            self.child.wait(2)
        except subprocess.TimeoutExpired:
            self.child.kill()
            self.child.wait()


class LocalInstances:
    """Instances in this process."""

    def __init__(self, instances: Instances) -> None:
        """Make the instances of this process."""
        self.instances = instances
        self.found: list[Any] = []

    def send(self, orders: Sequence[Order | Shot]) -> None:
        """Carry out orders."""
        self.found = self.instances.carry_out(orders)

    def receive(self, count: int) -> list[Any] | None:
        """Return the results of the orders."""
        return self.found

    def close(self) -> None:
        """Close all instances."""
        self.instances.close()


@dataclass
class Slot:
    """An instance as the pool knows it."""

    number: int
    place: bytes = b""  # name of its place; empty: none
    used: int = -1 - RECENT  # the number of the call that used it last


@dataclass
class Request:
    """One row of a call."""

    seed: int
    place: bytes = b""  # name of the place that the state gives
    steps: int = 0
    history: np.ndarray | None = None  # (max_steps, action)
    action: np.ndarray | None = None  # None: begin an episode
    next_seed: int = 0


@dataclass
class Pool:
    """Instances of one source, in this process or in several."""

    source: Source
    slots: list[Slot] = field(default_factory=list)
    calls: int = 0
    lock: Any = field(default_factory=threading.RLock)
    hosts: dict[int, Process | LocalInstances] = field(default_factory=dict)
    replays: int = 0  # number of replayed steps
    _standing: dict[bytes, list[Slot]] = field(default_factory=dict)

    def carry_out(self, requests: Sequence[Request]) -> list[Went]:
        """Carry out the rows of a call. Raises UserError for the first that fails."""
        with self.lock:
            self.calls += 1
            chosen = self._chosen(requests)
            by_host: dict[int, list[int]] = {}
            for row, slot in enumerate(chosen):
                by_host.setdefault(slot.number % self.source.hosts, []).append(row)
            orders = [self._order(request, slot) for request, slot in zip(requests, chosen, strict=True)]
            for host, rows in by_host.items():
                self._host(host).send([orders[row] for row in rows])
            found: list[Went | str] = [""] * len(requests)
            for host, rows in by_host.items():
                answers = self._host(host).receive(len(rows))
                if answers is None:
                    answers = [self._lost(host)] * len(rows)
                for row, answer in zip(rows, answers, strict=True):
                    found[row] = answer
            went: list[Went] = []
            for slot, answer in zip(chosen, found, strict=True):
                self._stand(slot, b"" if isinstance(answer, str) else answer.place)
                if isinstance(answer, Went):
                    went.append(answer)
            for answer in found:
                if isinstance(answer, str):
                    raise UserError(answer)
            return went

    def _chosen(self, requests: Sequence[Request]) -> list[Slot]:
        """Return the instance for each row: one at the right place, a new one, or the least recently used one."""
        chosen: list[Slot | None] = []
        for request in requests:
            there = self._standing.get(request.place) if request.action is not None else None
            slot = there.pop() if there else None
            if slot is not None:
                slot.used = self.calls
            chosen.append(slot)
        free = iter(sorted((slot for slot in self.slots if slot.used < self.calls), key=lambda slot: slot.used))
        return [
            self._vacated(request, free) if slot is None else slot
            for request, slot in zip(requests, chosen, strict=True)
        ]

    def _vacated(self, request: Request, free: Iterator[Slot]) -> Slot:
        """Return the least recently used instance, or a new one where a state in use would be lost."""
        slot = next(free, None)
        wanted = slot is not None and slot.place and slot.used > self.calls - RECENT
        if slot is None or (wanted and request.steps and len(self.slots) < MOST_INSTANCES):
            slot = Slot(len(self.slots))
            self.slots.append(slot)
        slot.used = self.calls
        return slot

    def _order(self, request: Request, slot: Slot) -> Order:
        replay = None
        if request.action is not None and slot.place != request.place:
            assert request.history is not None
            replay = np.array(request.history[: request.steps])
            self.replays += request.steps
        return Order(slot.number, request.seed, request.place, request.action, request.next_seed, replay, request.steps)

    def _stand(self, slot: Slot, place: bytes) -> None:
        before = self._standing.get(slot.place)
        if before and slot in before:
            before.remove(slot)
        if not before:
            self._standing.pop(slot.place, None)
        slot.place = place
        if place:
            self._standing.setdefault(place, []).append(slot)

    def _host(self, number: int) -> Process | LocalInstances:
        if number not in self.hosts:
            arguments = self.source.arguments_of_instances()
            if self.source.plays_here:
                self.hosts[number] = LocalInstances(Instances(*arguments))
            else:
                drawing = drawing_variables() if self.source.drawn else {}
                self.hosts[number] = Process(self.source.pickled(arguments), drawing)
        return self.hosts[number]

    def _lost(self, number: int) -> str:
        """Forget a process that is gone with its instances; return the error message."""
        gone = self.hosts.pop(number)
        assert isinstance(gone, Process)
        gone.close()
        for slot in self.slots:
            if slot.number % self.source.hosts == number:
                self._stand(slot, b"")
        return (
            f"environment {self.source.name}: a process that played it ended (exit status {gone.child.returncode}): "
            "see what it wrote on standard error, or give processes 1 to have it played in this process"
        )

    def filmed(self, slot: int, seed: int, actions: np.ndarray, first: int) -> list[np.ndarray]:
        """Return pictures of an episode from step `first` on. Raises UserError if there are none."""
        with self.lock:
            host = self._host(0)
            host.send([Shot(slot, seed, np.asarray(actions, np.float32), first)])
            (found,) = host.receive(1) or [self._lost(0)]
            if isinstance(found, str):
                raise UserError(found)
            return found

    def close(self) -> None:
        """End all processes and close all instances."""
        with self.lock:
            for host in self.hosts.values():
                host.close()
            self.hosts, self.slots, self._standing = {}, [], {}


def drawing_variables() -> dict[str, str]:
    """Return the environment variables by which MuJoCo draws without a screen; none where a user set them."""
    if "MUJOCO_GL" in os.environ or "DISPLAY" in os.environ or sys.platform != "linux":
        return {}
    return {"MUJOCO_GL": "osmesa" if find_library("OSMesa") else "egl"}


_pools: OrderedDict[Source, Pool] = OrderedDict()
_opening = threading.Lock()


def pool_of(source: Source) -> Pool:
    """Return the pool of a source, opened when it is first asked for. Pools that were not used for long are closed."""
    with _opening:
        if source not in _pools:
            _pools[source] = Pool(source)
        _pools.move_to_end(source)
        while len(_pools) > MOST_POOLS:
            _, oldest = _pools.popitem(last=False)
            oldest.close()
        return _pools[source]


@atexit.register
def close_all() -> None:
    """Close all pools; one that is used again opens again."""
    with _opening:
        while _pools:
            _pools.popitem()[1].close()
