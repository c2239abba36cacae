"""The command `cuelearner`: dispatch, and one file a command with its options."""

from collections.abc import Sequence


def main(argv: Sequence[str] | None = None) -> int:
    """Runs a command line (by default this process's own). Returns the exit status, see `dispatch`."""
    from cuelearner_jax.cli import dispatch  # loads JAX

    return dispatch.main(argv)
