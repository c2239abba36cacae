"""The command `cuelearner`: dispatch, and one file a command with its options."""

import os
import sys
from collections.abc import Sequence


def main(argv: Sequence[str] | None = None) -> int:
    """Runs a command line (by default this process's own). Returns the exit status, see `dispatch`."""
    if argv is None:
        _open_streams()
        from cuelearner_jax import signals  # before anything else, which takes seconds to load

        signals.listen()
    from cuelearner_jax.cli import dispatch

    return dispatch.main(argv)


def _open_streams() -> None:
    """Opens to nowhere what this process was started without (as by `2>&-`), or other files would take its place."""
    for number, name in enumerate(("stdin", "stdout", "stderr")):
        try:
            os.fstat(number)
        except OSError:
            os.open(os.devnull, os.O_RDWR)  # the lowest number that is free
            setattr(sys, name, os.fdopen(number, "r" if number == 0 else "w"))
