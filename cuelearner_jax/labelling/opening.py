"""A session that its own thread prepares, while the session's page is open already and shows the progress.

The thread waits while the server starts. NiceGUI then lists every object that Python's garbage collector knows, also
tuples that another thread is just building, and CPython refuses to finish these (`SystemError: bad argument to internal
function`, see the documentation of `gc.get_referrers`).
"""

from __future__ import annotations

import threading
from collections.abc import Callable

from nicegui import ui

from cuelearner_jax.labelling.session import Session

LOOK_EVERY = 0.3  # between two looks of a waiting page for the session [s]


class Opening:
    """A session being prepared in the background; a context, which closes the session at its end."""

    def __init__(
        self, make: Callable[[Callable[[str], None]], Session], failed: Callable[[], None], tell: Callable[[str], None]
    ) -> None:
        """Start the thread.

        Args:
            make: opens the session. Its argument is to be called with progress lines, first when files are checked.
            failed: called by the thread if `make` raises.
            tell: called with each progress line.
        """
        self.session: Session | None = None
        self.doing = "preparing"
        self._make, self._failed, self._told = make, failed, tell
        self._error: BaseException | None = None
        self._checked, self._proceeds = threading.Event(), threading.Event()
        self._thread = threading.Thread(target=self._open, name="opening")
        self._thread.start()

    def _open(self) -> None:
        try:
            self.session = self._make(self._tell)
        except BaseException as error:
            self._error = error
            self._failed()
        finally:
            self._checked.set()

    def _tell(self, words: str) -> None:
        self._checked.set()
        self._proceeds.wait()
        self.doing = words
        self._told(words)

    def wait_for_files(self) -> None:
        """Wait until the session's files are checked. Raises what `make` raised until then, before a page is shown."""
        self._checked.wait()
        self.check()

    def proceed(self) -> None:
        """Let the thread go on after its check of files: the server has started."""
        self._proceeds.set()

    def check(self) -> None:
        """Raise what opening the session raised, if anything."""
        if self._error is not None:
            raise self._error

    def __enter__(self) -> Opening:
        return self

    def __exit__(self, *_: object) -> None:
        self.proceed()
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
