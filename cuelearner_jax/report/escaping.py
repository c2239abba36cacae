"""Escape names from results files for the tables that a report writes."""

from __future__ import annotations

import html
import re
from typing import TypeVar

from cuelearner_jax.errors import one_line

ValueT = TypeVar("ValueT")

_FORMULA = re.compile(r"\s*[=+\-@]")  # what spreadsheets take for the start of a formula


def markdown(text: object) -> str:
    """Escape text for a line or a table cell in Markdown, where tags and bars are active."""
    return re.sub(r"([\\`|\[\]])", r"\\\1", html.escape(one_line(str(text)), quote=False))


def code(text: object) -> str:
    """Format text as code in Markdown."""
    return f"`{one_line(str(text)).replace('`', chr(39))}`"


def cell(value: ValueT) -> ValueT | str:
    """Return a value for a CSV file: numbers unchanged, an apostrophe before text that a spreadsheet would execute."""
    return f"'{value}" if isinstance(value, str) and _FORMULA.match(value) else value
