"""A page that asks a person which of two films is better. The films have no names, and change sides by chance."""

from __future__ import annotations

import contextlib
import queue
import secrets
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple

import uvicorn
from fastapi import FastAPI
from fastapi.requests import Request
from fastapi.responses import FileResponse, HTMLResponse, PlainTextResponse, RedirectResponse, Response

from cuelearner_jax.labelling.server import HOST, bind, guard
from cuelearner_jax.signals import Interrupted, interruptible

WORDS = {"left": -1, "same": 0, "right": 1}  # answers, and what they say of the right film
BUTTONS = {"left": "Left is better", "same": "No difference", "right": "Right is better"}
SHOWN_WITHIN = 5.0  # time for the browser to load the last page before the server stops [s]
PAGE = """<!doctype html><html lang="en"><head><meta charset="utf-8"><title>which is better?</title>
<meta name="viewport" content="width=device-width">{head}<style>:root {{ color-scheme: light dark; }}
body {{ font: 1.1rem/1.6 system-ui, sans-serif; max-width: 70rem; margin: 2rem auto; padding: 0 1rem; }}
.films {{ display: flex; gap: 1rem; }} .films img {{ flex: 1; min-width: 0; }}
form {{ display: flex; gap: 1rem; margin-top: 1rem; }} button {{ flex: 1; font: inherit; padding: 0.6rem; }}
</style></head><body>{body}</body></html>"""
WAITING = PAGE.format(head='<meta http-equiv="refresh" content="1">', body="<p>The next two films are being made.</p>")
LAST = PAGE.format(head="", body="<h1>Thank you.</h1><p>It is decided. You may close this tab.</p>")


class Pair(NamedTuple):
    """Two films of the same start."""

    number: int
    left: Path
    right: Path


class _Desk:
    """The pair that is shown, and the answers."""

    def __init__(self) -> None:
        self.pair: Pair | None = None
        self.answers: queue.Queue[int] = queue.Queue()
        self.over = False
        self.last_shown = threading.Event()

    def page(self) -> HTMLResponse:
        """Return the page of the moment."""
        if self.over:
            self.last_shown.set()
            return HTMLResponse(LAST)
        if self.pair is None:
            return HTMLResponse(WAITING)
        number = self.pair.number
        films = "".join(f'<img src="film/{number}/{side}" alt="the {side} film">' for side in ("left", "right"))
        answers = "".join(
            f'<button formaction="answer/{number}/{word}">{text}</button>' for word, text in BUTTONS.items()
        )
        words = f"<p>Pair {number + 1}: both start alike. Which does the task better?</p>"
        return HTMLResponse(
            PAGE.format(head="", body=f'{words}<div class="films">{films}</div><form method="post">{answers}</form>')
        )

    def film(self, request: Request) -> Response:
        """Return a film of the pair that is shown."""
        number, side, pair = request.path_params["number"], request.path_params["side"], self.pair
        if pair is None or number != pair.number or side not in ("left", "right"):
            return PlainTextResponse("this film is no longer shown\n", 404)
        return FileResponse(getattr(pair, side))

    def answer(self, request: Request) -> Response:
        """Take the answer about the pair that is shown; a second one about it says nothing."""
        number, word, pair = request.path_params["number"], request.path_params["word"], self.pair
        if pair is not None and number == pair.number and word in WORDS:
            self.pair = None
            self.answers.put(WORDS[word])
        return RedirectResponse("../../", 303)


@contextlib.contextmanager
def film_page(port: int, tell: Callable[[str], None]) -> Iterator[Callable[[Path, Path], int]]:
    """Serve the page on this machine, and yield a function of two films that waits for an answer.

    The function returns -1 where the left film is better, 0 where neither is, 1 where the right one is. `tell` gets the
    page's address, which contains a secret token. Port 0 is any free one.

    Raises UserError if the port is taken, and Interrupted for Ctrl-C while an answer is waited for.
    """
    with bind(port) as listening:
        token, desk = secrets.token_urlsafe(18), _Desk()
        app = FastAPI(docs_url=None, redoc_url=None, openapi_url=None)
        app.add_route("/", lambda request: desk.page())
        app.add_route("/film/{number:int}/{side}", desk.film)
        app.add_route("/answer/{number:int}/{word}", desk.answer, methods=["POST"])
        gate = guard(app, listening.getsockname()[1], token)
        server = uvicorn.Server(uvicorn.Config(gate, log_level="warning", timeout_graceful_shutdown=1))
        thread = threading.Thread(target=server.run, kwargs={"sockets": [listening]}, daemon=True)
        thread.start()
        tell(f"http://{HOST}:{listening.getsockname()[1]}/?token={token}")
        numbers = iter(range(10**9))

        def ask(left: Path, right: Path) -> int:
            desk.pair = Pair(next(numbers), left, right)
            with interruptible("the answer of the moment") as stopping:
                while not stopping.is_set():
                    with contextlib.suppress(queue.Empty):
                        return desk.answers.get(timeout=0.2)
                raise Interrupted("stopped before it was decided: nothing is written")

        try:
            yield ask
            desk.over = True
            desk.last_shown.wait(SHOWN_WITHIN)
        finally:
            server.should_exit = True
            thread.join()
