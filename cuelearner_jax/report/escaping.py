"""Escape names from results files, paths and command lines, so that a document shows them and executes nothing.

A name may contain anything: a newline and pipes (a forged table row), tags (a script in a page made from the report),
a formula (executed by a spreadsheet that opens the CSV). Everything that a report writes passes one of these functions.
"""

from __future__ import annotations

import html
import re
from typing import TypeVar

from cuelearner_jax.errors import one_line

ValueT = TypeVar("ValueT")

# Characters with a meaning anywhere in Markdown with GitHub's tables; underscores inside words have none.
_ACTIVE = re.compile(r"[\\`*\[\]|~]|(?<![^\W_])_|_(?![^\W_])")
_BLOCK = re.compile(r"^(\d*)([#+\-=.)])")  # at the beginning of a line: heading, list or rule
# What spreadsheets take for the start of a formula (OWASP, "CSV injection"), also after spaces and in full width.
_FORMULA = re.compile(r"\s*[=+\-@＝＋－＠]")


def markdown(text: object) -> str:
    """Escape text for Markdown, for use in a line of its own, in a list or in a table cell."""
    plain = html.escape(one_line(str(text)), quote=False)
    return _BLOCK.sub(r"\1\\\2", _ACTIVE.sub(r"\\\g<0>", plain))


def code(text: object) -> str:
    """Format text as code in Markdown."""
    plain = one_line(str(text))
    # A backtick would end a code span and start Markdown; tags are escaped altogether.
    return f"<code>{markdown(plain)}</code>" if re.search("[`<>&]", plain) or not plain.strip() else f"`{plain}`"


def cell(value: ValueT) -> ValueT | str:
    """Return a value for a CSV file: numbers unchanged, an apostrophe before text that a spreadsheet would execute."""
    if not isinstance(value, str):
        return value
    plain = one_line(value)  # a tab or a return at the start would lead to a formula too
    return f"'{plain}" if _FORMULA.match(plain) else plain
