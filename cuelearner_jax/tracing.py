"""How a minimum over data is written into a program: as a reduction, or as a loop that goes through the data."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar

import jax

_written_out = ContextVar("written out", default=False)


@contextmanager
def written_out() -> Iterator[None]:
    """Trace without loops over data: for exporters, whose formats have none."""
    token = _written_out.set(True)
    try:
        yield
    finally:
        _written_out.reset(token)


def goes_through() -> bool:
    """Return whether a minimum over few data for many places is best taken datum by datum.

    On a CPU: all places are then worked on side by side in vector registers, which XLA's reductions leave unused.
    """
    return jax.default_backend() == "cpu" and not _written_out.get()
