"""Validate the head and the rows of a label file before use, whatever the form of answers."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pyarrow as pa

from cuelearner_jax import spaces

ANSWERED, UNSURE, UNDONE = SAID = ("answer", "unsure", "undone")  # an answer, "don't know", an answer taken back
ROW = ("obs", "action", "answer")  # columns that hold lists
PEOPLE = ("item", "said", "seconds", "who", "when")  # columns of a person's rows
SESSION = ("guidance", "base", "base_digest", "robot", "again_of")  # text fields of a session


def check_head(head: dict[str, Any]) -> None:
    """Raise ValueError, with the reason, unless a file's head has what labels need."""
    task, eps = head.get("task"), head.get("eps", "absent")
    if not isinstance(task, dict) or not isinstance(task.get("name"), str):
        raise ValueError("it does not name its task")
    if not isinstance(head.get("answers"), str):
        raise ValueError("it does not name the form of its answers")
    space = spaces.from_json(head.get("space") or {})
    if eps is not None and not (_is_number(eps) and 0 < eps <= space.reach):
        raise ValueError(f"its eps is not a number above 0 and up to {space.reach:g} ({space.unit})")
    session = head.get("session")
    if session is None:
        return
    if not isinstance(session, dict) or not _is_whole(session.get("seed")):
        raise ValueError("its session has no seed")
    if not all(isinstance(session.get(name, ""), str) for name in SESSION):
        raise ValueError(f"one of {', '.join(SESSION)} of its session is not text")
    bound, layout = session.get("bound"), session.get("observation", [])
    if bound is not None and not (_is_number(bound) and 0 < bound <= space.reach):
        raise ValueError(f"the bound of its session is not a number above 0 and up to {space.reach:g} ({space.unit})")
    if not isinstance(layout, list) or not all(_is_part(part) for part in layout):
        raise ValueError("the observation of its session is not a list of names and sizes")


def check_rows(table: pa.Table, head: dict[str, Any]) -> None:
    """Raise ValueError, with the reason, unless the rows have a valid structure; their numbers are not checked."""
    if not table.num_rows:
        return
    for name in ("seed", "obs", "action"):
        if table[name].null_count:
            raise ValueError(f"a row has no {name}")
    if np.asarray(table["seed"]).min() < 0:
        raise ValueError("a seed is negative")
    widths = {name: _width(table, name) for name in ROW if name in table.column_names}
    layout = (head.get("session") or {}).get("observation")
    if layout and sum(part["size"] for part in layout) != widths["obs"]:
        raise ValueError("its observations have another size than its session says")
    nothing = pa.nulls(table.num_rows)
    answered = np.asarray((table["answer"] if "answer" in widths else pa.chunked_array([nothing])).is_valid())
    columns = {
        name: table[name].to_pylist() if name in table.column_names else [None] * len(answered) for name in PEOPLE
    }
    for row, (item, said, seconds, who, when) in enumerate(zip(*(columns[name] for name in PEOPLE), strict=True)):
        if said not in (None, *SAID):
            raise ValueError(f"row {row + 1} says {said!r}, not one of {', '.join(SAID)}")
        if answered[row] != (said in (None, ANSWERED)):
            raise ValueError(f"row {row + 1} says {said!r} and has {'an' if answered[row] else 'no'} answer")
        if said is None and item is None:
            continue  # a simulated teacher's row
        if said is None or not _is_whole(item) or not (_is_number(seconds) and seconds >= 0) or None in (who, when):
            raise ValueError(f"row {row + 1} lacks a valid value of one of {', '.join(PEOPLE)}")


def _width(table: pa.Table, name: str) -> int:
    widths = np.unique(np.asarray(table[name].combine_chunks().value_lengths().drop_null()))
    if len(widths) > 1 or 0 in widths:
        raise ValueError(f"{name} has lists of several lengths, or empty ones")
    return int(widths[0]) if len(widths) else 0


def _is_part(part: Any) -> bool:
    return isinstance(part, dict) and isinstance(part.get("name"), str) and _is_whole(part.get("size"))


def _is_whole(value: Any) -> bool:
    """Whether a value is an integer from 0 to 2^31 - 1."""
    return type(value) is int and 0 <= value < 1 << 31


def _is_number(value: Any) -> bool:
    return type(value) in (int, float) and math.isfinite(value)
