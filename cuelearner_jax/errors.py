"""The one exception that a user is meant to read."""

import difflib
import errno
import reprlib
from collections.abc import Collection, Iterable
from typing import Any

# Refusals of the file system that no check beforehand can rule out.
FILE_SYSTEM = (
    *(errno.EACCES, errno.EPERM, errno.EROFS, errno.ENOTDIR, errno.EISDIR, errno.ENAMETOOLONG, errno.ELOOP),
    *(errno.EIO, errno.ESTALE, errno.EMFILE, errno.ENFILE, errno.EBUSY),
)
MOST_LISTED = 20  # numbers that a message names


def one_line(text: str) -> str:
    """The text with every character that is not printable as its escape, for instance a newline as `\\n`."""
    return "".join(
        character if character.isprintable() else character.encode("unicode_escape").decode("ascii")
        for character in text
    )


class UserError(Exception):
    """Bad input: its message is one clear line that says what is wrong and what to do.

    The command line prints the message alone, without a traceback, and exits with status 2. Whatever a path or a name
    in the message holds, there are no line breaks and no escape sequences in it.
    """

    def __init__(self, message: object = "") -> None:
        """Keeps the message, on one line."""
        super().__init__(one_line(" ".join(str(message).splitlines())))


class NotFinite(Exception):
    """What was trained, or some of it, stopped being finite: its message is one line that says what, and what is kept.

    The command line prints the message and exits with `status`.
    """

    status = 1


def mentions(error: BaseException | None, numbers: Collection[int | None], *words: str) -> bool:
    """Does an exception, or what it came from, have one of these error numbers, or say one of these words?

    TensorStore tells in words alone what the system refused.
    """
    while error is not None:
        if (isinstance(error, OSError) and error.errno in numbers) or any(text in str(error) for text in words):
            return True
        error = error.__cause__ or error.__context__
    return False


def no_space(error: BaseException) -> bool:
    """Does an exception, or what it came from, say that the disk is full?"""
    words = ("No space left on device", "Disk quota exceeded", "File too large")
    return mentions(error, (errno.ENOSPC, errno.EDQUOT, errno.EFBIG), *words)


def file_system_message(error: BaseException, resumes: bool) -> str | None:
    """What to tell of an exception that the file system is to blame for, in one line; None for any other.

    `resumes`: can the command go on with what it saved?
    """
    if no_space(error):
        again = "go on with the same command and --resume" if resumes else "give the same command again"
        return f"the disk is full: free some, then {again}"
    if isinstance(error, OSError) and error.filename is not None and error.errno in FILE_SYSTEM:
        return f"{error.filename}: {error.strerror}; what was saved before is safe"
    return None


def format_value(value: Any) -> str:
    """A value for a message, on one short line: plain values as Python writes them, anything else by its type."""
    if isinstance(value, type):
        return f"the class {value.__name__}"
    if shape := getattr(value, "shape", None):
        return f"an array of shape {shape}"
    if not isinstance(value, str | bytes | int | float | complex | list | tuple | dict | set | None):
        return f"a {type(value).__name__}"
    short = reprlib.Repr()
    short.maxstring = short.maxother = 60
    try:
        text = short.repr(value)
    except Exception:  # of what cannot be written: an entry's own `repr`, an integer of thousands of digits
        return f"a {type(value).__name__}"
    return text if text.isprintable() and len(text) <= 120 else f"a {type(value).__name__}"


def user_code_error(named: str, error: Exception) -> UserError:
    """What is told of an exception of the user's own code: one line that says whose it is and what was raised.

    Args:
        named: what the code is, for instance "policy my_policy".
        error: what it raised.
    """
    try:
        words = " ".join(str(error).split())[:200]
    except Exception:  # it has not even words
        words = ""
    return UserError(f"{named} raised {type(error).__name__}{': ' if words else ''}{words}: mend it first")


def format_numbers(numbers: Iterable[float]) -> str:
    """Numbers in order for a message: as a range where no whole number between is absent, else 20 at most."""
    known = sorted(set(numbers))
    texts = [f"{number:g}" if isinstance(number, float) else str(number) for number in known]
    if len(known) > 2 and known == list(range(int(known[0]), int(known[0]) + len(known))):
        return f"{texts[0]} to {texts[-1]}"
    return ", ".join(texts[:MOST_LISTED]) + (" and others" if len(texts) > MOST_LISTED else "")


def suggestion(word: str, known: Iterable[str]) -> str:
    """The end of a message about an unknown word: the one that was probably meant, or all there are."""
    known = list(known)
    found = difflib.get_close_matches(str(word)[:100], known, n=1)
    return f", did you mean {found[0]!r}?" if found else f": choose one of {', '.join(known)}"
