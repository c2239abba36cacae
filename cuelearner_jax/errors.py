"""Errors for users, and the parts of their messages."""

import difflib
import errno
import re
import reprlib
from collections.abc import Iterable
from typing import Any

MOST_LISTED = 20  # numbers that a message names


def one_line(text: str) -> str:
    """Return the text with every unprintable character escaped, for instance a newline as `\\n`."""
    return "".join(one if one.isprintable() else one.encode("unicode_escape").decode("ascii") for one in text)


def first_line(error: object) -> str:
    """Return the first line of an error's message, cut to 200 characters; empty for an error without words."""
    return (str(error).splitlines() or [""])[0][:200]


class UserError(Exception):
    """Bad input: one line that says what is wrong and what to do, for exit status 2 without a traceback.

    Whatever reads or checks input may raise it. A docstring names the cases only where its caller needs them.
    """

    def __init__(self, message: object = "") -> None:
        """Store the message on one line, without escape sequences that a path or a name in it may hold."""
        super().__init__(one_line(" ".join(str(message).splitlines())))


class UserCodeError(UserError):
    """An exception of the user's own code, which is its `__cause__`. The command line prints that traceback too."""


class NotFinite(Exception):
    """A result stopped being finite: one line that says which result, and what was saved."""

    status = 1  # exit status of the command


def machine_message(error: BaseException, resumes: bool) -> str | None:
    """Return one line about an exception that the file system or a lack of memory caused; None for any other.

    `resumes`: whether the command can resume from what it saved.
    """
    causes = [error]
    while (cause := causes[-1].__cause__ or causes[-1].__context__) is not None:
        causes.append(cause)
    numbers, words = {getattr(one, "errno", None) for one in causes}, " ".join(map(str, causes))
    full = re.search("No space left on device|Disk quota exceeded|File too large", words)  # TensorStore has words only
    if full or numbers & {errno.ENOSPC, errno.EDQUOT, errno.EFBIG}:
        again = "go on with the same command and --resume" if resumes else "give the same command again"
        return f"the disk is full: free some, then {again}"
    if isinstance(error, OSError) and error.filename is not None:
        return f"{error.filename}: {error.strerror}; what was saved before is safe"
    is_scarce = isinstance(error, MemoryError) or errno.ENOMEM in numbers
    if is_scarce or re.search("RESOURCE_EXHAUSTED|Out of memory", words):
        lower = "lower the sizes that were given, or the number of seeds at once"
        return f"not enough memory ({first_line(error)}): {lower}"
    return None


def format_value(value: Any) -> str:
    """Return a value for a message, on one short line: plain values in Python's notation, others by type."""
    if isinstance(value, type):
        return f"the class {value.__name__}"
    if shape := getattr(value, "shape", None):
        return f"an array of shape {shape}"
    if not isinstance(value, str | bytes | int | float | complex | list | tuple | dict | set | None):
        return f"a {type(value).__name__}"
    return one_line(reprlib.repr(value))


def user_code_error(code: str, error: BaseException) -> UserCodeError:
    """Return the error for an exception of the user's own code; `code`: the code, as "policy my_policy"."""
    words = " ".join(str(error).split())[:200]
    return UserCodeError(f"{code} raised {type(error).__name__}{': ' if words else ''}{words}: mend it first")


def format_numbers(numbers: Iterable[float]) -> str:
    """Return sorted numbers for a message: a range where they are consecutive, else at most 20 numbers."""
    ordered = sorted(set(numbers))
    texts = [f"{number:g}" if isinstance(number, float) else str(number) for number in ordered]
    if len(ordered) > 2 and ordered == list(range(int(ordered[0]), int(ordered[0]) + len(ordered))):
        return f"{texts[0]} to {texts[-1]}"
    return ", ".join(texts[:MOST_LISTED]) + (" and others" if len(texts) > MOST_LISTED else "")


def suggestion(word: str, choices: Iterable[str]) -> str:
    """Return the end of a message about an unknown word: the probably intended word, or all known words."""
    return near(word, choices := list(choices)) or f": choose one of {', '.join(choices)}"


def near(word: str, choices: Iterable[str]) -> str:
    """Return the end of a message that names the probably intended word; empty where none is near."""
    nearest = difflib.get_close_matches(str(word)[:100], list(choices), n=1)
    return f", did you mean {nearest[0]!r}?" if nearest else ""
