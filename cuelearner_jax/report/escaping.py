"""Names from results files, paths and command lines as text of a document: they say what they are and do nothing.

A name may hold anything: a newline and pipes (a forged row of a table), tags (a script in a page made of the report), a
formula (run by a spreadsheet that opens the CSV). Whatever a report writes passes one of these functions.
"""

from __future__ import annotations

import html
import re
from typing import TypeVar

from cuelearner_jax.errors import one_line

ValueT = TypeVar("ValueT")

# What makes text more than text in Markdown with GitHub's tables, wherever it stands; underscores inside words do not.
_ACTIVE = re.compile(r"[\\`*\[\]|~]|(?<![^\W_])_|_(?![^\W_])")
_BLOCK = re.compile(r"^(\d*)([#+\-=.)])")  # at the beginning of a line: heading, list or rule
# What a spreadsheet takes for the beginning of a formula (OWASP, "CSV injection"), also after blanks and in full width.
_FORMULA = re.compile(r"\s*[=+\-@＝＋－＠]")


def markdown(text: object) -> str:
    """Text as Markdown that shows it as it is, in a line of its own, a list or a cell of a table."""
    plain = html.escape(one_line(str(text)), quote=False)
    return _BLOCK.sub(r"\1\\\2", _ACTIVE.sub(r"\\\g<0>", plain))


def code(text: object) -> str:
    """Text as code in Markdown."""
    plain = one_line(str(text))
    # Backticks would end a code span, and what follows would be Markdown; a tag is kept out of the file altogether.
    return f"<code>{markdown(plain)}</code>" if re.search("[`<>&]", plain) or not plain.strip() else f"`{plain}`"


def cell(value: ValueT) -> ValueT | str:
    """A value for a CSV file: numbers as they are, text that a spreadsheet would run with an apostrophe before it."""
    if not isinstance(value, str):
        return value
    plain = one_line(value)  # a tab or a return at the beginning would lead to a formula too
    return f"'{plain}" if _FORMULA.match(plain) else plain
