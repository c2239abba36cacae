"""Serve a session's page on this machine, to those who know its address, until the session is finished or stopped."""

from __future__ import annotations

import asyncio
import contextlib
import html
import secrets
import socket
import threading
import time
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import uvicorn
from fastapi import FastAPI
from fastapi.requests import HTTPConnection
from fastapi.responses import HTMLResponse, PlainTextResponse
from nicegui import run, ui
from starlette.background import BackgroundTask
from starlette.websockets import WebSocketClose

from cuelearner_jax.errors import UserError
from cuelearner_jax.labelling.page import Page
from cuelearner_jax.labelling.session import Session

HOST = "127.0.0.1"
FINISHED = "/finished"  # address of the last page
SHOWN_WITHIN = 10.0  # time for all browsers to load the last page before the server stops [s]
RECONNECT = 60.0  # time for which the page of a broken connection is kept [s]
PAGE = """<!doctype html><html lang="en"><head><meta charset="utf-8"><title>{title}</title>
<meta name="viewport" content="width=device-width">{head}<style>:root {{ color-scheme: light dark; }}
body {{ font: 1.1rem/1.6 system-ui, sans-serif; max-width: 70rem; margin: 2rem auto; padding: 0 1rem; }}
pre {{ background: #80808022; padding: 0.8rem; white-space: pre-wrap; overflow-wrap: anywhere; }}
.films {{ display: flex; gap: 1rem; }} .films img {{ flex: 1; min-width: 0; }}
form {{ display: flex; gap: 1rem; margin-top: 1rem; }} button {{ flex: 1; font: inherit; padding: 0.6rem; }}
</style></head><body>{body}</body></html>"""
HEADERS = (
    (b"referrer-policy", b"same-origin"),  # the address contains the token; without any, forms have no origin
    (b"x-frame-options", b"DENY"),
    (b"x-content-type-options", b"nosniff"),
)


class Commands(NamedTuple):
    """Commands that the page shows for copying."""

    again: str  # opens this session again
    following: Callable[[int], str]  # number of labels -> the command that uses them


class Ending(NamedTuple):
    """Result of a finished session."""

    line: str  # what was saved, and where
    following: str  # the command that uses the labels
    again: str  # the command that continues the session

    @property
    def page(self) -> str:
        """The last page as HTML, which needs no server once shown."""
        line, following, again = map(html.escape, self)
        body = f"""<h1>Finished. Thank you.</h1><p class="saved">{line}</p>
<h2>What to type next</h2><pre id="next">{following}</pre>
<h2>To add labels later, with a larger --labels</h2><pre>{again}</pre>
<p>The command in the terminal ends by itself once the last fit is done. You may close this tab.</p>"""
        return PAGE.format(title="finished", head="", body=body)


def end_session(session: Session, commands: Commands) -> Ending:
    """Finish a session. Raises UserError if its labels cannot be saved; the session then continues."""
    file, status = session.finish().resolve(), session.status()
    also = f", and {status.unsure} questions without an answer" if status.unsure else ""
    minutes, seconds = divmod(round(status.seconds), 60)
    took = f"{minutes} min {seconds} s"
    line = f"{status.answered} of {status.labels} labels are saved{also}, in {file}; the answers took {took}"
    return Ending(line, commands.following(status.answered), commands.again)


def bind(port: int) -> socket.socket:
    """Return a socket bound to this machine only (port 0: any free port). Raises UserError if the port is taken."""
    listener = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
    listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    try:
        listener.bind((HOST, port))
        listener.listen()  # from now on a browser waits for the page, where it would have been refused
    except OSError as error:
        listener.close()
        raise UserError(f"port {port} of {HOST} is not available ({error.strerror}): give another --port") from error
    return listener


def guard(app: Any, port: int, token: str) -> Any:
    """Return an ASGI application that passes on connections to `127.0.0.1:port` that present the token.

    A page of another site can make a browser send requests to 127.0.0.1, and a domain name of that site can resolve to
    127.0.0.1 (DNS rebinding). So the host and origin headers are checked, and a secret token is required: first in the
    page's address, afterwards in a cookie.
    """
    cookie = f"cuelearner-{port}"  # browsers share cookies among ports
    hosts = {f"{name}:{port}" for name in (HOST, "localhost")}

    def refusal(request: HTTPConnection) -> str:
        if [host.lower() for host in request.headers.getlist("host")] not in [[host] for host in hosts]:
            return f"this page answers to {HOST} alone: open the address that the command printed"
        if not {origin.lower() for origin in request.headers.getlist("origin")} <= {f"http://{host}" for host in hosts}:
            return "this page answers no other site"
        tokens = [*request.query_params.getlist("token"), request.cookies.get(cookie, "")]
        if not any(secrets.compare_digest(each.encode(), token.encode()) for each in tokens):
            return "the token is missing or wrong: open the address that the command printed when it started last"
        return ""

    async def gate(scope: Any, receive: Any, send: Any) -> None:
        async def send_private(message: Any) -> None:
            if message["type"] == "http.response.start":
                message = {**message, "headers": [*message.get("headers", []), *HEADERS, *entry]}
            await send(message)

        if scope["type"] not in ("http", "websocket"):
            await app(scope, receive, send)
        elif why := refusal(request := HTTPConnection(scope)):
            response = PlainTextResponse(f"{why}\n", 403) if scope["type"] == "http" else WebSocketClose(1008, why)
            await response(scope, receive, send)
        else:
            value = f"{cookie}={token}; HttpOnly; SameSite=Strict; Path=/".encode()
            entry = [(b"set-cookie", value)] if "token" in request.query_params else []
            await app(scope, receive, send_private)

    return gate


@contextlib.contextmanager
def serving(app: Any, listening: socket.socket) -> Iterator[str]:
    """Serve an application in a thread, and yield its address, which contains a secret token, once it has started."""
    token, port = secrets.token_urlsafe(18), listening.getsockname()[1]
    # uvloop would take over the signal wake-up that the thread of `signals` waits for.
    how = {"log_level": "warning", "ws": "wsproto", "loop": "asyncio", "timeout_graceful_shutdown": 1}
    server = uvicorn.Server(uvicorn.Config(guard(app, port, token), **how))
    thread = threading.Thread(target=server.run, kwargs={"sockets": [listening]}, daemon=True)
    thread.start()
    while not server.started:
        if not thread.is_alive():
            raise RuntimeError("the page's server did not start")
        time.sleep(0.01)
    try:
        yield f"http://{HOST}:{port}/?token={token}"
    finally:
        server.should_exit = True
        thread.join()


class Site:
    """The pages of a session, and its end: a last page in every browser, after which the server stops."""

    session: Session

    def __init__(self, commands: Commands, stopping: threading.Event) -> None:
        """Begin without a session; `stopping` is set once every browser shows the last page."""
        self.commands, self.stopping = commands, stopping
        self.pages: set[Page] = set()
        self.ending: Ending | None = None
        self._waiting = 0  # browsers that do not show the last page yet

    def show(self) -> None:
        """Build a page in NiceGUI's current client."""
        Page(self.session, self.pages, self.finish, self.commands.again)

    async def finish(self) -> None:
        """Finish the session. Raises UserError if its labels cannot be saved; the session then continues."""
        ending = await run.io_bound(end_session, self.session, self.commands)
        if ending is None or self.ending is not None:  # the program ends, or another page was first
            return
        self.ending, self._waiting = ending, len(self.pages)
        asyncio.get_running_loop().call_later(SHOWN_WITHIN, self.stopping.set)
        for page in list(self.pages):
            page.goto(FINISHED)

    def last_page(self, _: Any) -> HTMLResponse:
        """Answer a browser's request of the last page."""
        if self.ending is None:
            return HTMLResponse("nothing is finished yet", 404)
        return HTMLResponse(self.ending.page, background=BackgroundTask(self._count_down))

    def _count_down(self) -> None:
        self._waiting -= 1
        if self._waiting <= 0:
            self.stopping.set()


def serve(
    make: Callable[[], Session],
    title: str,
    listening: socket.socket,
    stopping: threading.Event,
    tell: Callable[[str], None],
    commands: Commands,
) -> Ending | None:
    """Serve a session's page until the session ends; close the session.

    `make` opens the session once the server has started: NiceGUI then lists every object that Python's garbage
    collector knows, also tuples that a session's threads are just building, which CPython refuses to finish (see the
    documentation of `gc.get_referrers`). `listening` is a socket of `bind`; setting `stopping` stops the server. `tell`
    gets the page's address, which contains a secret token. The last page shows `commands`.

    Returns how a person finished the session; None if `stopping` was set before. Raises what `make` raises.
    """
    app, site = FastAPI(docs_url=None, redoc_url=None, openapi_url=None), Site(commands, stopping)
    app.add_route(FINISHED, site.last_page)
    look = {"title": title, "dark": None, "reconnect_timeout": RECONNECT, "show_welcome_message": False}
    ui.run_with(app, root=site.show, **look)
    with contextlib.ExitStack() as end, serving(app, listening) as address:
        site.session = end.enter_context(make())
        tell(address)
        stopping.wait()
    return site.ending
