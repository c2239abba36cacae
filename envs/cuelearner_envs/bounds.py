"""Validate numbers and words of a task's configuration; an invalid one is refused in one line."""

from __future__ import annotations

import math
import numbers
from collections.abc import Iterable
from typing import Any

from cuelearner_jax.errors import UserError, format_value, suggestion

MOST_STEPS = 1_000_000  # of an episode: counters are of 32 bits
MOST_SEED = 2**32 - 1  # of a key
LARGEST = 3.4028e38  # in single precision


def check_number(
    name: str,
    value: Any,
    least: float = -math.inf,
    most: float = math.inf,
    *,
    positive: bool = False,
    whole: bool = False,
    unit: str = "",
) -> None:
    """Raise UserError unless a field holds a number within bounds that is finite in single precision.

    `least` and `most` are allowed; a `positive` number is above 0. `unit` is for the message, in words.
    """
    kind: Any = numbers.Integral if whole else numbers.Real
    is_number = isinstance(value, kind) and not isinstance(value, bool)
    if is_number and max(least, -LARGEST) <= value <= min(most, LARGEST) and not (positive and value < 1e-45):
        return
    advice = f"a {'whole' if whole else 'positive' if positive else 'finite'} number"
    advice += f" from {_digits(least)}" if least > -math.inf else ""
    advice += f" up to {_digits(most)}" if most < math.inf else ""
    raise UserError(f"task.{name} is {format_value(value)}: give {advice}{f' ({unit})' if unit else ''}")


def check_word(name: str, value: Any, words: Iterable[str]) -> None:
    """Raise UserError unless a field holds one of the words that it can."""
    if not isinstance(value, str) or value not in tuple(words):
        raise UserError(f"task.{name} is {format_value(value)}{suggestion(str(value), words)}")


def check_vector(name: str, value: Any, size: int, least: float, most: float, unit: str = "") -> None:
    """Like `check_number`, for a field that holds `size` numbers."""
    if not isinstance(value, (tuple, list)) or len(value) != size:
        raise UserError(f"task.{name} is {format_value(value)}: give {size} numbers")
    for entry in value:
        check_number(name, entry, least, most, unit=unit)


def _digits(bound: float) -> str:
    return f"{bound:,}" if isinstance(bound, int) else f"{bound:g}"
