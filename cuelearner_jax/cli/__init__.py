"""The command `cuelearner`: dispatch, and one file per command with its options."""

import os
import sys
from collections.abc import Sequence


def main(argv: Sequence[str] | None = None) -> int:
    """Run a command line (default: this process's own). Returns the exit status, see `dispatch`."""
    if argv is None:
        _open_streams()
        from cuelearner_jax import signals  # before anything else, which takes seconds to load

        signals.listen()
    from cuelearner_jax.cli import dispatch

    return dispatch.main(argv)


def _open_streams() -> None:
    """Open to null any standard stream this process lacks (`2>&-`), so that no other file gets its number."""
    for number, name in enumerate(("stdin", "stdout", "stderr")):
        try:
            os.fstat(number)
        except OSError:
            os.open(os.devnull, os.O_RDWR)  # uses the lowest free number
            setattr(sys, name, os.fdopen(number, "r" if number == 0 else "w"))
