"""Serve a session's page on this machine until the session is finished or stopped."""

from __future__ import annotations

import asyncio
import contextlib
import html
import secrets
import socket
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple

import uvicorn
from fastapi import FastAPI
from fastapi.responses import HTMLResponse
from nicegui import run, ui
from starlette.background import BackgroundTask

from cuelearner_jax.errors import UserError
from cuelearner_jax.labelling.gate import Gate
from cuelearner_jax.labelling.page import Page
from cuelearner_jax.labelling.session import Session

HOST = "127.0.0.1"
SHOWN_WITHIN = 10.0  # time for all browsers to load the last page before the server stops [s]
RECONNECT = 60.0  # time for which the page of a broken connection is kept [s]


ADDRESS = "/finished"  # of the last page


class Commands(NamedTuple):
    """Commands that the page shows for copying."""

    again: str  # opens this session again
    following: Callable[[int], str]  # number of labels -> the command that uses them


class Ending(NamedTuple):
    """Result of a finished session."""

    file: Path
    labels: int
    unsure: int
    wanted: int
    following: str  # the command that uses the labels
    again: str  # the command that continues the session

    @property
    def line(self) -> str:
        """Return one line that says what was saved, and where."""
        also = f", and {self.unsure} questions without an answer" if self.unsure else ""
        return f"{self.labels} of {self.wanted} labels are saved{also}, in {self.file}"


def last_page(told: Ending) -> str:
    """Return the last page as HTML, which needs no server once shown."""
    line, following, again = (html.escape(text) for text in (told.line, told.following, told.again))
    return f"""<!doctype html><html lang="en"><head><meta charset="utf-8"><title>finished</title>
<meta name="viewport" content="width=device-width"><style>:root {{ color-scheme: light dark; }}
body {{ font: 1.1rem/1.6 system-ui, sans-serif; max-width: 46rem; margin: 3rem auto; padding: 0 1rem; }}
pre {{ background: #80808022; padding: 0.8rem; white-space: pre-wrap; overflow-wrap: anywhere; }}</style></head><body>
<h1>Finished. Thank you.</h1><p class="saved">{line}</p>
<h2>What to type next</h2><pre id="next">{following}</pre>
<h2>To add labels later</h2><pre>{again}</pre>
<p>The command in the terminal has ended by itself. You may close this tab.</p></body></html>"""


def bind(port: int) -> socket.socket:
    """Return a socket bound to this machine only (port 0: any free port). Raises UserError if the port is taken."""
    found = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
    found.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    try:
        found.bind((HOST, port))
        found.listen()  # from now on a browser waits for the page, where it would have been refused
    except OSError as error:
        found.close()
        raise UserError(f"port {port} of {HOST} is not available ({error.strerror}): give another --port") from error
    return found


class _Server(uvicorn.Server):
    """A server that stops when an event is set and leaves signals to the command."""

    ends: threading.Event
    after_startup: Callable[[], None]

    @contextlib.contextmanager
    def capture_signals(self) -> Iterator[None]:
        """Install no signal handlers."""
        yield

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        """Start, then call `after_startup` in a thread of its own: what it opens may need an event loop too."""
        await super().startup(sockets)
        await asyncio.to_thread(self.after_startup)

    async def on_tick(self, counter: int) -> bool:
        """Return whether the server should stop."""
        return await super().on_tick(counter) or self.ends.is_set()


class _Last:
    """Ends the session: saves its labels, sends every browser to the last page, stops the server once sent."""

    session: Session

    def __init__(self, pages: set[Page], stopping: threading.Event, commands: Commands) -> None:
        self.told: Ending | None = None
        self._pages, self._stopping, self._commands = pages, stopping, commands
        self._waited_for = 0

    async def finish(self) -> None:
        """Finish the session. Raises UserError if its labels cannot be saved; the session then continues."""
        file = await run.io_bound(self.session.finish)
        if file is None or self.told is not None:  # the program ends, or another page was first
            return
        status = self.session.status()
        counts, following = (status.answered, status.unsure, status.labels), self._commands.following(status.answered)
        self.told = Ending(file.resolve(), *counts, following, self._commands.again)
        asyncio.get_running_loop().call_later(SHOWN_WITHIN, self._stopping.set)
        self._waited_for = len(self._pages)
        for page in list(self._pages):
            page.goto(ADDRESS)

    def route(self, app: FastAPI) -> None:
        """Add the last page."""

        @app.get(ADDRESS)
        def show() -> HTMLResponse:
            if self.told is None:
                return HTMLResponse("nothing is finished yet", 404)
            return HTMLResponse(last_page(self.told), background=BackgroundTask(self._sent))

    def _sent(self) -> None:
        self._waited_for -= 1
        if self._waited_for <= 0:
            self._stopping.set()


def serve(
    make: Callable[[], Session],
    title: str,
    taken: socket.socket,
    stopping: threading.Event,
    tell: Callable[[str], None],
    commands: Commands,
) -> Ending | None:
    """Serve a session's page on a socket of `bind` until the session ends; close the session.

    Args:
        make: opens the session. It is called once the server has started: NiceGUI then lists every object that Python's
            garbage collector knows, also tuples that a session's threads are just building, which CPython refuses to
            finish (see the documentation of `gc.get_referrers`).
        title: of the page.
        taken: the socket to listen on.
        stopping: set it to stop the server.
        tell: called with the page's address, which contains a secret token.
        commands: what the last page shows for copying.

    Returns how a person finished the session; None if `stopping` was set before. Raises what `make` raises.
    """
    token, port = secrets.token_urlsafe(18), taken.getsockname()[1]
    pages: set[Page] = set()
    app = FastAPI(docs_url=None, redoc_url=None, openapi_url=None)
    last = _Last(pages, stopping, commands)
    last.route(app)
    with contextlib.ExitStack() as end:

        def opened() -> None:
            last.session = end.enter_context(make())
            tell(f"http://{HOST}:{port}/?token={token}")

        look = {"title": title, "dark": None, "reconnect_timeout": RECONNECT, "show_welcome_message": False}
        ui.run_with(app, root=lambda: Page(last.session, pages, last.finish, commands.again) and None, **look)
        # uvloop would take over the signal wake-up that the thread of `signals` waits for.
        how = {"log_level": "warning", "ws": "wsproto", "loop": "asyncio", "timeout_graceful_shutdown": 1}
        server = _Server(uvicorn.Config(Gate(app, port, token), **how))
        server.ends, server.after_startup = stopping, opened
        server.run(sockets=[taken])
        return last.told
