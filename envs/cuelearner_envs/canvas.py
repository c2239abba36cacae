"""What drawings with matplotlib share: arrows, pictures that repeat by the byte, and frames of a film."""

from __future__ import annotations

import os
from typing import Any

import matplotlib
import numpy as np
from jaxtyping import UInt8
from matplotlib import patheffects
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import FancyArrowPatch


def save(figure: Figure, file: str | os.PathLike[str]) -> None:
    """Write a picture with no date: the same drawing, the same bytes."""
    with matplotlib.rc_context({"svg.hashsalt": "cuelearner"}):
        figure.savefig(file, metadata={"Date": None} if str(file).endswith(".svg") else None)


def edged(width: float, colour: str) -> list[Any]:
    """Return the path effect of a line with an edge."""
    return [patheffects.withStroke(linewidth=width, foreground=colour)]


def arrow(axes: Axes, ends: np.ndarray, colour: str, head: float, effects: list[Any]) -> Artist:
    """Add an arrow from the first of two places to the second."""
    look = {"arrowstyle": "-|>", "mutation_scale": head, "shrinkA": 0, "shrinkB": 0, "linewidth": 2.2, "zorder": 7}
    return axes.add_patch(FancyArrowPatch(*map(tuple, ends), color=colour, path_effects=effects, **look))


class Backdrop:
    """A figure whose constant parts are drawn once; each picture draws only what moves over them."""

    def __init__(self, figure: Figure) -> None:
        self.canvas: Any = figure.canvas
        self.canvas.draw()
        self.empty = self.canvas.copy_from_bbox(figure.bbox)

    def picture(self, *artists: Any) -> UInt8[np.ndarray, "height width 3"]:
        """Return the picture with these artists on top, and remove them from the figure."""
        self.canvas.restore_region(self.empty)
        for artist in artists:
            artist.draw(self.canvas.renderer)
            artist.remove()
        return np.asarray(self.canvas.buffer_rgba())[..., :3].copy()
