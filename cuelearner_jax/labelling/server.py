"""Serving a session's page on this machine, until it is finished or stopped."""

from __future__ import annotations

import contextlib
import secrets
import socket
import threading
from collections.abc import Callable, Iterator

import uvicorn
from fastapi import FastAPI
from nicegui import ui

from cuelearner_jax.errors import UserError
from cuelearner_jax.labelling.gate import Gate
from cuelearner_jax.labelling.page import Page
from cuelearner_jax.labelling.session import Session

HOST = "127.0.0.1"
RECONNECT = 60.0  # for which a page whose connection broke is kept [s]


def bound(port: int) -> socket.socket:
    """A socket of this machine alone (port 0: any that is free). Raises UserError if the port is taken."""
    found = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
    found.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    try:
        found.bind((HOST, port))
        found.listen()  # from now on a browser waits for the page instead of being refused
    except OSError as error:
        found.close()
        raise UserError(f"port {port} of {HOST} cannot be had ({error.strerror}): give another --port") from error
    return found


class _Server(uvicorn.Server):
    """Ends when an event is set; signals are the command's."""

    ends: threading.Event

    @contextlib.contextmanager
    def capture_signals(self) -> Iterator[None]:
        """Leaves them alone."""
        yield

    async def on_tick(self, counter: int) -> bool:
        """Is it over?"""
        return await super().on_tick(counter) or self.ends.is_set()


def serve(session: Session, taken: socket.socket, stopping: threading.Event, tell: Callable[[str], None]) -> bool:
    """Serves the page; `tell` is given its address once it can be opened.

    Args:
        session: whose page it is.
        taken: from `bound`.
        stopping: ends it when set.
        tell: called with the address, whose token nobody else knows.

    Returns:
        Whether a person finished, rather than `stopping` having been set.
    """
    token, port = secrets.token_urlsafe(18), taken.getsockname()[1]
    finished, pages = threading.Event(), set()
    app = FastAPI(docs_url=None, redoc_url=None, openapi_url=None)

    def finish() -> None:
        finished.set()
        stopping.set()

    title = f"label {session.plan.task.name}"
    ui.run_with(
        app,
        root=lambda: Page(session, pages, finish) and None,
        title=title,
        dark=None,
        reconnect_timeout=RECONNECT,
        show_welcome_message=False,
    )
    # uvloop would take the signals' wake-up from the thread of `signals` that hears them.
    how = {"log_level": "warning", "ws": "wsproto", "loop": "asyncio", "timeout_graceful_shutdown": 1}
    settings = uvicorn.Config(Gate(app, port, token), **how)
    server = _Server(settings)
    server.ends = stopping
    tell(f"http://{HOST}:{port}/?token={token}")
    server.run(sockets=[taken])
    return finished.is_set()
