"""A process that plays instances for the pool: it reads calls from a socket until the socket is closed.

The process is started as a program of its own, not forked: a fork of a process with threads may hang. The user's
script is not run a second time.
"""

from __future__ import annotations

import os
import pickle
import signal
import sys
import threading
import time
from multiprocessing.connection import Connection

LOOKED = 1.0  # time between two checks of the parent [s]


def main(descriptor: int, parent: int) -> None:
    """Serve until the pool closes its end, or its process is gone."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent handles an interrupt, and then ends this process
    threading.Thread(target=_end_with, args=(parent,), daemon=True).start()
    link = Connection(descriptor)
    instances, fault = None, ""
    try:
        sys.path[:] = link.recv()
        from cuelearner_jax.bridges.gymnasium.instances import Instances
        from cuelearner_jax.errors import user_code_error

        sent = link.recv_bytes()
        try:
            instances = Instances(*pickle.loads(sent))
        except Exception as error:
            fault = str(user_code_error("the environment's code, when loaded,", error))
        while True:
            method, *arguments = link.recv()
            answer = getattr(instances, method)(*arguments) if instances else fault
            link.send_bytes(pickle.dumps(answer, pickle.HIGHEST_PROTOCOL))
    except (EOFError, OSError):
        pass
    finally:
        if instances is not None:
            instances.close()


def _end_with(parent: int) -> None:
    """End this process once its parent is gone, even in the middle of a step."""
    while os.getppid() == parent:
        time.sleep(LOOKED)
    os._exit(1)


if __name__ == "__main__":
    main(int(sys.argv[1]), int(sys.argv[2]))
