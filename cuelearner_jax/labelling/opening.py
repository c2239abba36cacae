"""A session that a thread of its own prepares, while its page is open already and says how far that is."""

from __future__ import annotations

import threading
from collections.abc import Callable

from nicegui import ui

from cuelearner_jax.labelling.session import Session

LOOK_EVERY = 0.3  # for which a page waits before it asks again whether the session is there [s]


class Opening:
    """Prepares a session in the background; a context, at whose end the session is closed."""

    def __init__(
        self, make: Callable[[Callable[[str], None]], Session], failed: Callable[[], None], tell: Callable[[str], None]
    ) -> None:
        """Begin.

        Args:
            make: opens the session; is given who is told what is being prepared.
            failed: is called by the thread if that raises.
            tell: is told the same.
        """
        self.session: Session | None = None
        self.doing = "preparing"
        self._make, self._failed, self._told = make, failed, tell
        self._error: BaseException | None = None
        self._thread = threading.Thread(target=self._open, name="opening")
        self._thread.start()

    def _open(self) -> None:
        try:
            self.session = self._make(self._tell)
        except BaseException as error:
            self._error = error
            self._failed()

    def _tell(self, words: str) -> None:
        self.doing = words
        self._told(words)

    def check(self) -> None:
        """Raise what opening the session raised, if anything."""
        if self._error is not None:
            raise self._error

    def __enter__(self) -> Opening:
        return self

    def __exit__(self, *_: object) -> None:
        self._thread.join()
        if self.session is not None:
            self.session.close()


def waiting_page(opening: Opening) -> None:
    """Build the page that says what is being prepared, and gives way to the session's page once that is there."""
    with ui.element("main").classes("label-page"):
        ui.label("The questions are being prepared.").classes("big")
        doing = ui.label(f"{opening.doing} ...").classes("note")

    def look() -> None:
        doing.text = f"{opening.doing} ..."
        if opening.session is not None:
            timer.cancel()
            ui.navigate.reload()

    timer = ui.timer(LOOK_EVERY, look)
