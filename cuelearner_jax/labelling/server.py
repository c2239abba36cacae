"""Serving a session's page on this machine, until it is finished or stopped."""

from __future__ import annotations

import asyncio
import contextlib
import secrets
import socket
import threading
from collections.abc import Callable, Iterator

import uvicorn
from fastapi import FastAPI
from fastapi.responses import HTMLResponse
from nicegui import run, ui

from cuelearner_jax.errors import UserError
from cuelearner_jax.labelling import ending
from cuelearner_jax.labelling.ending import Commands, Ending
from cuelearner_jax.labelling.gate import Gate
from cuelearner_jax.labelling.page import Page
from cuelearner_jax.labelling.session import Session

HOST = "127.0.0.1"
SHOWN_WITHIN = 10.0  # of the end every browser should have shown the last page; nobody waits longer [s]
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


class _Last:
    """The end of the work: finishes the session, sends every browser to the last page, and stops once it is shown."""

    def __init__(self, session: Session, pages: set[Page], stopping: threading.Event, commands: Commands) -> None:
        self.told: Ending | None = None
        self._session, self._pages, self._stopping, self._commands = session, pages, stopping, commands
        self._waited_for = 0

    async def finish(self) -> None:
        """Raises UserError if the work cannot be finished; the page then goes on."""
        file = await run.io_bound(self._session.finish)
        if file is None or self.told is not None:  # the program ends, or another page was first
            return
        self.told = ending.ending(file, self._session.status(), self._commands)
        asyncio.get_running_loop().call_later(SHOWN_WITHIN, self._stopping.set)
        self._waited_for = len(self._pages)
        for page in list(self._pages):
            page.goto(ending.ADDRESS)

    def routes(self, app: FastAPI) -> None:
        """The last page, and where it says that it is shown."""

        @app.get(ending.ADDRESS)
        def show() -> HTMLResponse:
            if self.told is None:
                return HTMLResponse("nothing is finished yet", 404)
            return HTMLResponse(ending.page(self.told))

        @app.post(ending.SEEN)
        def seen() -> None:
            if self.told is None:
                return
            self._waited_for -= 1
            if self._waited_for <= 0:
                self._stopping.set()


def serve(
    session: Session,
    taken: socket.socket,
    stopping: threading.Event,
    tell: Callable[[str], None],
    commands: Commands,
) -> Ending | None:
    """Serves the page; `tell` is given its address once it can be opened.

    Args:
        session: whose page it is.
        taken: from `bound`.
        stopping: ends it when set.
        tell: called with the address, whose token nobody else knows.
        commands: what a person may type afterwards.

    Returns:
        How a person finished; None: `stopping` was set before.
    """
    token, port = secrets.token_urlsafe(18), taken.getsockname()[1]
    pages: set[Page] = set()
    app = FastAPI(docs_url=None, redoc_url=None, openapi_url=None)
    last = _Last(session, pages, stopping, commands)
    last.routes(app)
    title = f"label {session.plan.task.name}"
    ui.run_with(
        app,
        root=lambda: Page(session, pages, last.finish, commands.again) and None,
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
    return last.told
