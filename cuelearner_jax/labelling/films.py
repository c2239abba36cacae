"""A page that asks a person which of two films is better. The films have no names, and change sides by chance."""

from __future__ import annotations

import contextlib
import queue
import threading
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path

from fastapi import FastAPI
from fastapi.requests import Request
from fastapi.responses import FileResponse, HTMLResponse, PlainTextResponse, RedirectResponse, Response

from cuelearner_jax.labelling.server import PAGE, bind, serving
from cuelearner_jax.signals import Interrupted, interruptible

# answers: what they say of the right film, and their buttons
WORDS = {"left": (-1, "Left is better"), "same": (0, "No difference"), "right": (1, "Right is better")}
SHOWN_WITHIN = 5.0  # time for the browser to load the last page before the server stops [s]
LOOK = partial(PAGE.format, title="which is better?")
WAITING = LOOK(head='<meta http-equiv="refresh" content="1">', body="<p>The next two films are being made.</p>")
LAST = LOOK(head="", body="<h1>Thank you.</h1><p>It is decided. You may close this tab.</p>")


class _Desk:
    """The pair that is shown, and the answers."""

    def __init__(self) -> None:
        self.number, self.films = -1, {}  # the films by their sides; empty between two pairs
        self.answers: queue.Queue[int] = queue.Queue()
        self.over, self.last_shown = False, threading.Event()

    def ask(self, left: Path, right: Path) -> int:
        """Return -1 where the left film is better, 0 where neither is, 1 where the right one is.

        Raises Interrupted for Ctrl-C while it waits for the answer.
        """
        self.number, self.films = self.number + 1, {"left": left, "right": right}
        with interruptible("the answer of the moment") as stopping:
            while not stopping.is_set():
                with contextlib.suppress(queue.Empty):
                    return self.answers.get(timeout=0.2)
            raise Interrupted("stopped before it was decided: nothing is written")

    def page(self, request: Request) -> Response:
        if self.over:
            self.last_shown.set()
        if self.over or not self.films:
            return HTMLResponse(LAST if self.over else WAITING)
        words = f"<p>Pair {self.number + 1}: both start alike. Which does the task better?</p>"
        films = "".join(f'<img src="film/{self.number}/{side}" alt="the {side} film">' for side in ("left", "right"))
        buttons = ((word, text) for word, (_, text) in WORDS.items())
        answers = "".join(f'<button formaction="answer/{self.number}/{word}">{text}</button>' for word, text in buttons)
        body = f'{words}<div class="films">{films}</div><form method="post">{answers}</form>'
        return HTMLResponse(LOOK(head="", body=body))

    def film(self, request: Request) -> Response:
        file = self.films.get(request.path_params["side"]) if request.path_params["number"] == self.number else None
        return FileResponse(file) if file else PlainTextResponse("this film is no longer shown\n", 404)

    def answer(self, request: Request) -> Response:
        """Take the answer about the pair that is shown; a second one about it says nothing."""
        word = request.path_params["word"]
        if self.films and request.path_params["number"] == self.number and word in WORDS:
            self.films = {}
            self.answers.put(WORDS[word][0])
        return RedirectResponse("../../", 303)


@contextlib.contextmanager
def film_page(tell: Callable[[str], None]) -> Iterator[Callable[[Path, Path], int]]:
    """Serve the page on this machine, and yield a function of two films that waits for an answer (`_Desk.ask`).

    `tell` gets the page's address, which contains a secret token.
    """
    with bind(0) as listening:
        desk, app = _Desk(), FastAPI(docs_url=None, redoc_url=None, openapi_url=None)
        app.add_route("/", desk.page)
        app.add_route("/film/{number:int}/{side}", desk.film)
        app.add_route("/answer/{number:int}/{word}", desk.answer, methods=["POST"])
        with serving(app, listening) as address:
            tell(address)
            yield desk.ask
            desk.over = True
            desk.last_shown.wait(SHOWN_WITHIN)
