"""Change one entry of nested JSON values, for tests of damaged and hostile files."""

import copy
import functools

GONE = object()


def ways(values, way=()):
    """The ways to every value, the objects and lists themselves included."""
    for name, value in values.items() if isinstance(values, dict) else enumerate(values):
        yield (*way, name)
        if isinstance(value, dict | list):
            yield from ways(value, (*way, name))


def at(values, way):
    """Return the entry at a path."""
    return functools.reduce(lambda part, name: part[name], way, values)


def changed(values, way, value):
    """A copy with another value there, or without any (`GONE`)."""
    copied = copy.deepcopy(values)
    if value is GONE:
        del at(copied, way[:-1])[way[-1]]
    else:
        at(copied, way[:-1])[way[-1]] = value
    return copied
