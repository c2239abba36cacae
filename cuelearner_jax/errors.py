"""Errors for users, and the parts of their messages."""

import difflib
import errno
import reprlib
from collections.abc import Collection, Iterable
from typing import Any

# Refusals of the file system that no check beforehand can rule out.
FILE_SYSTEM = (
    *(errno.EACCES, errno.EPERM, errno.EROFS, errno.ENOTDIR, errno.EISDIR, errno.ENAMETOOLONG, errno.ELOOP),
    *(errno.EIO, errno.ESTALE, errno.EMFILE, errno.ENFILE, errno.EBUSY, errno.ENOTEMPTY, errno.EEXIST),
)
MOST_LISTED = 20  # numbers that a message names


def one_line(text: str) -> str:
    """Return the text with every unprintable character escaped, for instance a newline as `\\n`."""
    return "".join(
        character if character.isprintable() else character.encode("unicode_escape").decode("ascii")
        for character in text
    )


class UserError(Exception):
    """Bad input. The message is one clear line that says what is wrong and what to do.

    The command line prints the message alone, without a traceback, and exits with status 2.
    """

    def __init__(self, message: object = "") -> None:
        """Store the message on one line, without escape sequences that a path or a name in it may hold."""
        super().__init__(one_line(" ".join(str(message).splitlines())))


class UserCodeError(UserError):
    """An exception of the user's own code, which is its `__cause__`. The command line prints that traceback too."""


class NotFinite(Exception):
    """A result stopped being finite. The message is one line that says which result, and what was kept.

    The command line prints the message and exits with `status`.
    """

    status = 1


def mentions(error: BaseException | None, numbers: Collection[int | None], *words: str) -> bool:
    """Return whether an exception, or one of its causes, has one of these error numbers or contains one of these words.

    TensorStore reports the system's errors in words only.
    """
    while error is not None:
        if (isinstance(error, OSError) and error.errno in numbers) or any(text in str(error) for text in words):
            return True
        error = error.__cause__ or error.__context__
    return False


def machine_message(error: BaseException, resumes: bool) -> str | None:
    """Return one line about an exception that the file system or a lack of memory caused; None for any other.

    `resumes`: whether the command can resume from what it saved.
    """
    words = ("No space left on device", "Disk quota exceeded", "File too large")
    if mentions(error, (errno.ENOSPC, errno.EDQUOT, errno.EFBIG), *words):
        again = "go on with the same command and --resume" if resumes else "give the same command again"
        return f"the disk is full: free some, then {again}"
    if isinstance(error, OSError) and error.filename is not None and error.errno in FILE_SYSTEM:
        return f"{error.filename}: {error.strerror}; what was saved before is safe"
    if mentions(error, (errno.ENOMEM,), "RESOURCE_EXHAUSTED", "Out of memory") or isinstance(error, MemoryError):
        why = (str(error).splitlines() or [""])[0][:200]
        return f"not enough memory ({why}): lower the sizes that were given, or the number of seeds at once"
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


def user_code_error(named: str, error: BaseException) -> UserCodeError:
    """Return the error for an exception of the user's own code; `named`: the code, as "policy my_policy"."""
    words = " ".join(str(error).split())[:200]
    return UserCodeError(f"{named} raised {type(error).__name__}{': ' if words else ''}{words}: mend it first")


def format_numbers(numbers: Iterable[float]) -> str:
    """Return sorted numbers for a message: a range where they are consecutive, else at most 20 numbers."""
    known = sorted(set(numbers))
    texts = [f"{number:g}" if isinstance(number, float) else str(number) for number in known]
    if len(known) > 2 and known == list(range(int(known[0]), int(known[0]) + len(known))):
        return f"{texts[0]} to {texts[-1]}"
    return ", ".join(texts[:MOST_LISTED]) + (" and others" if len(texts) > MOST_LISTED else "")


def suggestion(word: str, known: Iterable[str]) -> str:
    """Return the end of a message about an unknown word: the probably intended word, or all known words."""
    known = list(known)
    return near(word, known) or f": choose one of {', '.join(known)}"


def near(word: str, known: Iterable[str]) -> str:
    """Return the end of a message that names the probably intended word; empty where none is near."""
    nearest = difflib.get_close_matches(str(word)[:100], list(known), n=1)
    return f", did you mean {nearest[0]!r}?" if nearest else ""
