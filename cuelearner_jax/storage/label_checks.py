"""Whether the head and the rows of a label file make sense, before they are used; knows no form of answer."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pyarrow as pa

from cuelearner_jax import spaces

ANSWERED, UNSURE, UNDONE = SAID = ("answer", "unsure", "undone")  # an answer, "don't know", taken back
ROW = ("obs", "action", "answer")  # columns of lists
PEOPLE = ("item", "said", "seconds", "who", "when")  # columns of rows that a person gave
SESSION = ("guidance", "base", "base_digest", "robot", "again_of")  # what is text of a session


def check_head(head: dict[str, Any]) -> None:
    """Raises ValueError, with the reason, unless a file says of itself what labels need."""
    task, eps = head.get("task"), head.get("eps", "absent")
    if not isinstance(task, dict) or not isinstance(task.get("name"), str):
        raise ValueError("it does not name its task")
    if not isinstance(head.get("answers"), str):
        raise ValueError("it does not name the form of its answers")
    space = spaces.from_json(head.get("space") or {})
    if eps is not None and not (_is_number(eps) and 0 < eps <= space.reach):
        raise ValueError(f"its eps is no number above 0 and up to {space.reach:g} ({space.unit})")
    session = head.get("session")
    if session is None:
        return
    if not isinstance(session, dict) or not _is_whole(session.get("seed")):
        raise ValueError("its session has no seed")
    if not all(isinstance(session.get(name, ""), str) for name in SESSION):
        raise ValueError(f"one of {', '.join(SESSION)} of its session is no text")
    bound, layout = session.get("bound"), session.get("observation", [])
    if bound is not None and not (_is_number(bound) and 0 < bound <= space.reach):
        raise ValueError(f"the bound of its session is no number above 0 and up to {space.reach:g} ({space.unit})")
    if not isinstance(layout, list) or not all(_is_part(part) for part in layout):
        raise ValueError("the observation of its session is no list of names and sizes")


def check_rows(table: pa.Table, head: dict[str, Any]) -> None:
    """Raises ValueError, with the reason, unless rows are such as were written; numbers are not looked at."""
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
            continue  # a simulated teacher's
        if said is None or not _is_whole(item) or not (_is_number(seconds) and seconds >= 0) or None in (who, when):
            raise ValueError(f"row {row + 1} lacks one of {', '.join(PEOPLE)}, or it makes no sense")


def _width(table: pa.Table, name: str) -> int:
    widths = np.unique(np.asarray(table[name].combine_chunks().value_lengths().drop_null()))
    if len(widths) > 1 or 0 in widths:
        raise ValueError(f"{name} has lists of several lengths, or empty ones")
    return int(widths[0]) if len(widths) else 0


def _is_part(part: Any) -> bool:
    return isinstance(part, dict) and isinstance(part.get("name"), str) and _is_whole(part.get("size"))


def _is_whole(value: Any) -> bool:
    """Is it a whole number from 0 that 32 bits hold?"""
    return type(value) is int and 0 <= value < 1 << 31


def _is_number(value: Any) -> bool:
    return type(value) in (int, float) and math.isfinite(value)
