"""The last page: what was saved, where, how many, and what to type next. It needs no server once it is shown."""

from __future__ import annotations

import html
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

from cuelearner_jax.labelling.session import Status

ADDRESS, SEEN = "/finished", "/finished/seen"  # the last page, and what its script asks for once it is shown


class Commands(NamedTuple):
    """What a person may type."""

    again: str  # opens the session once more
    following: Callable[[int], str]  # number of labels -> what uses them


class Ending(NamedTuple):
    """How the work ended."""

    file: Path
    labels: int
    unsure: int
    wanted: int
    following: str  # the command that uses the labels
    again: str  # the one that goes on

    @property
    def line(self) -> str:
        """What was saved, and where."""
        also = f", and {self.unsure} questions without an answer" if self.unsure else ""
        return f"{self.labels} of {self.wanted} labels are saved{also}, in {self.file}"


def ending(file: Path, status: Status, commands: Commands) -> Ending:
    """That of a session.

    Args:
        file: what it left.
        status: its last.
        commands: what may be typed now.
    """
    following = commands.following(status.answered)
    return Ending(file.resolve(), status.answered, status.unsure, status.labels, following, commands.again)


def page(told: Ending) -> str:
    """As a whole page of HTML, which tells the server once it is shown."""
    line, following, again = (html.escape(text) for text in (told.line, told.following, told.again))
    return f"""<!doctype html>
<html lang="en"><head><meta charset="utf-8"><meta name="viewport" content="width=device-width">
<title>finished</title><style>
:root {{ color-scheme: light dark; }}
body {{ font: 1.1rem/1.6 system-ui, sans-serif; max-width: 46rem; margin: 3rem auto; padding: 0 1rem; }}
pre {{ background: #80808022; padding: 0.8rem; border-radius: 6px; white-space: pre-wrap; overflow-wrap: anywhere; }}
button {{ font: inherit; padding: 0.2rem 0.8rem; }}
</style></head><body>
<h1>Finished. Thank you.</h1>
<p class="saved">{line}</p>
<h2>What to type next</h2>
<pre id="next">{following}</pre>
<p><button onclick="navigator.clipboard.writeText(document.getElementById('next').textContent);
this.textContent = 'copied'">copy</button></p>
<h2>To add labels later</h2>
<pre>{again}</pre>
<p>The command in the terminal has ended by itself. You may close this tab.</p>
<script>fetch("{SEEN}", {{method: "POST", keepalive: true}});</script>
</body></html>"""
