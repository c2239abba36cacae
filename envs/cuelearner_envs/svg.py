"""Elements of SVG as text. Lengths are as given; y points down, as on a screen."""

from __future__ import annotations

from typing import Any, SupportsFloat

import numpy as np

Point = Any  # two numbers
Points = Any  # rows of two numbers


def number(value: SupportsFloat) -> str:
    """A number, a millimetre precise where it is in metres."""
    return f"{float(value):.3f}".rstrip("0").rstrip(".") or "0"


def points(rows: Points) -> str:
    """Points of a line."""
    return " ".join(",".join(map(number, row)) for row in np.asarray(list(rows), float))


def element(name: str, body: str = "", **attributes: SupportsFloat | str) -> str:
    """An element; underscores of attributes' names become hyphens."""
    pairs = " ".join(
        f'{key.replace("_", "-")}="{value if isinstance(value, str) else number(value)}"'
        for key, value in attributes.items()
    )
    return f"<{name} {pairs}>{body}</{name}>"


def circle(at: Point, radius: float, style: str) -> str:
    """A disc."""
    return element("circle", cx=at[0], cy=at[1], r=radius, style=style)


def polygon(rows: Points, style: str) -> str:
    """A closed shape."""
    return element("polygon", points=points(rows), style=style)


def rectangle(left: float, top: float, width: float, height: float, style: str, round_by: float = 0.0) -> str:
    """A rectangle with rounded corners."""
    return element("rect", x=left, y=top, width=width, height=height, rx=round_by, style=style)


def text(at: Point, size: float, words: str, style: str, anchor: str = "middle") -> str:
    """Words; `size` is the height of letters."""
    words = words.replace("&", "&amp;").replace("<", "&lt;")
    place = {"x": at[0], "y": at[1], "font_size": size, "text_anchor": anchor, "dominant_baseline": "central"}
    return element("text", words, **place, style=style)
