"""The pool plays one environment in this process or in several: a call's rows are divided among them.

Run as a program (`main`), this module is such a process. It reads calls from a socket until the socket is closed. It is
not forked, since a fork of a process with threads may hang, and does not run the user's script a second time.
"""

from __future__ import annotations

import atexit
import contextlib
import os
import pickle
import signal
import socket
import subprocess
import sys
import threading
from collections import OrderedDict
from collections.abc import Mapping
from ctypes.util import find_library
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import numpy as np

from cuelearner_jax.bridges.gymnasium.instances import Instances, Request, Went
from cuelearner_jax.bridges.gymnasium.source import Source
from cuelearner_jax.errors import UserError, user_code_error

PACKAGES = Path(__file__).parents[3]  # folder that this package is imported from
MOST_POOLS = 4  # with instances at one time


class Process:
    """Instances in a process of their own."""

    def __init__(self, source: Source) -> None:
        """Start the process. Raises UserError for code that cannot be sent to it."""
        import cloudpickle  # with code of `__main__` and local functions; Gymnasium needs it too

        self.name, self.is_gone = source.name, False
        try:
            sent = cloudpickle.dumps((source.make, source.name, source.max_steps, source.size))
        except Exception as error:
            advice = "give a function or class of a module, or processes 1"
            raise UserError(f"environment {self.name} cannot be sent to another process ({error}): {advice}") from error
        ours, theirs = socket.socketpair()
        command = [sys.executable, "-m", "cuelearner_jax.bridges.gymnasium.pool", str(theirs.fileno())]
        paths = os.pathsep.join([str(PACKAGES), *filter(None, [os.environ.get("PYTHONPATH")])])
        environ = {**os.environ, "PYTHONPATH": paths, **(drawing_variables() if source.draws else {})}
        # An environment's prints must not mix with our output.
        self.child = subprocess.Popen(
            command, pass_fds=(theirs.fileno(),), stdin=subprocess.DEVNULL, stdout=2, env=environ
        )
        theirs.close()
        self.link = Connection(ours.detach())
        self.link.send([entry or os.getcwd() for entry in sys.path])
        self.link.send_bytes(sent)

    def send(self, method: str, *arguments: Any) -> None:
        """Call a method of the instances; `receive` returns its result."""
        with contextlib.suppress(OSError):  # `receive` reports it
            self.link.send_bytes(pickle.dumps((method, *arguments), pickle.HIGHEST_PROTOCOL))

    def receive(self) -> Any:
        """Return the result of a call, or the words of an error."""
        try:
            return pickle.loads(self.link.recv_bytes())
        except (EOFError, OSError):
            self.close()
            self.is_gone = True
            return (
                f"environment {self.name}: a process that played it ended (exit status {self.child.returncode}): see "
                "what it wrote on standard error, or give processes 1 to have it played in this process"
            )

    def close(self) -> None:
        """End the process."""
        self.link.close()
        try:
            self.child.wait(2)
        except subprocess.TimeoutExpired:
            self.child.kill()
            self.child.wait()


class Here:
    """Instances in this process."""

    is_gone = False

    def __init__(self, source: Source) -> None:
        self.instances, self.result = Instances(source.make, source.name, source.max_steps, source.size), None
        self.close = self.instances.close

    def send(self, method: str, *arguments: Any) -> None:
        """Call a method of the instances."""
        self.result = getattr(self.instances, method)(*arguments)

    def receive(self) -> Any:
        """Return the result of the call."""
        return self.result


class Pool:
    """Instances of one source, in this process or in several."""

    def __init__(self, source: Source) -> None:
        from cuelearner_jax.devices import CORES  # loads JAX, which the processes do not need

        self.source, self.spec, self.lock = source, None, threading.RLock()  # `spec`: of its instances
        self.count = 1 if source.draws else source.processes or CORES
        self.hosts: dict[int, Process | Here] = {}

    def carry_out(self, requests: Mapping[int, Request]) -> list[Went]:
        """Carry out the rows of a call, each by its number. Raises UserError where one fails."""
        rows: dict[int, list[int]] = {}
        for row in requests:
            rows.setdefault(row % self.count, []).append(row)
        calls = {number: ([requests[row] for row in own],) for number, own in rows.items()}
        results: dict[int, Any] = dict.fromkeys(requests)
        for own, answers in zip(rows.values(), self._call("carry_out", calls), strict=True):
            results.update(zip(own, answers, strict=True))
        return list(results.values())

    def _call(self, method: str, calls: Mapping[int, tuple[Any, ...]]) -> list[Any]:
        """Call a method of hosts, each with its arguments. Raises UserError with the words of the first error."""
        with self.lock:
            try:
                for number, arguments in calls.items():
                    if number not in self.hosts or self.hosts[number].is_gone:
                        # Drawn instances need a process of their own: OpenGL does not work across threads.
                        self.hosts[number] = (Process if self.source.draws or self.count > 1 else Here)(self.source)
                    self.hosts[number].send(method, *arguments)
                answers = [self.hosts[number].receive() for number in calls]
            except BaseException:  # such as an interrupt, after which answers would stay unread
                self.close()
                raise
        if fault := next((one for one in answers if isinstance(one, str)), None):
            raise UserError(fault)
        return answers

    def film(self, request: Request, actions: np.ndarray) -> list[np.ndarray]:
        """Return pictures of a place and after each action. Raises UserError if there are none."""
        return self._call("film", {0: (request, actions)})[0]

    def close(self) -> None:
        """End all processes and close all instances."""
        with self.lock:
            while self.hosts:
                self.hosts.popitem()[1].close()


def drawing_variables() -> dict[str, str]:
    """Return the environment variables by which MuJoCo draws without a screen; none where a user set them."""
    if "MUJOCO_GL" in os.environ or "DISPLAY" in os.environ or sys.platform != "linux":
        return {}
    return {"MUJOCO_GL": "osmesa" if find_library("OSMesa") else "egl"}


_pools: OrderedDict[Source, Pool] = OrderedDict()  # the one used last at the end


def pool_of(source: Source) -> Pool:
    """Return the pool of a source, whose processes start when they are needed; close the pools unused for longest."""
    pool = _pools.setdefault(source, Pool(source))  # other threads may ask too: no step leaves it out
    _pools.move_to_end(source)
    while len(_pools) > MOST_POOLS:
        _pools.popitem(last=False)[1].close()
    before, pool.spec = pool.spec, source.spec
    if before is not None and before is not pool.spec:  # the id is registered anew
        pool.close()
    return pool


@atexit.register
def close_all() -> None:
    """Close all pools; one that is used again opens again."""
    while _pools:
        _pools.popitem()[1].close()


def main(descriptor: int) -> None:
    """Serve instances until the pool closes its end, or its process is gone."""
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):  # the parent handles them, and ends this process
        signal.signal(number, signal.SIG_IGN)
    link, instances, fault = Connection(descriptor), None, ""
    with contextlib.suppress(EOFError, OSError):
        sys.path[:] = link.recv()
        sent = link.recv_bytes()
        try:
            instances = Instances(*pickle.loads(sent))
        except Exception as error:
            fault = str(user_code_error("the environment's code, when loaded,", error))
        while True:
            method, *arguments = link.recv()
            answer = getattr(instances, method)(*arguments) if instances else fault
            link.send_bytes(pickle.dumps(answer, pickle.HIGHEST_PROTOCOL))
    if instances is not None:
        instances.close()


if __name__ == "__main__":
    main(int(sys.argv[1]))
