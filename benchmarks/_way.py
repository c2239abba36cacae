"""The way to the goal in navigation, by what the labelling page draws and nothing else: for scripts that label there.

Solids of the drawing become a grid; the shortest way over it, which keeps away from them, begins in some direction.
Where the goal lies off the drawing, it is taken to lie where the drawing says: in the direction of its mark, so far.
"""

from __future__ import annotations

import math
import re
import xml.etree.ElementTree as xml

import numpy as np
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import dijkstra

CELL = 0.1  # [m]
ROOM = 0.55  # between the middle of the robot and a solid, if there is any choice [m]
NARROW = 20.0  # by so many times a metre is longer beside a solid than where there is room
STEPS = [(0, 1), (1, 0), (1, 1), (1, -1)]


def _points(polygon: xml.Element) -> np.ndarray:
    return np.array([[float(value) for value in pair.split(",")] for pair in polygon.get("points", "").split()])


def _named(element: xml.Element) -> str:
    return element.tag.rpartition("}")[2]


class Scene:
    """Contents of a drawing; places as drawn (x to the right, y down) [m], the robot at the origin, facing up."""

    def __init__(self, svg: str) -> None:
        """Read the page's SVG element."""
        root = xml.fromstring(svg)
        groups = {group.get("class", ""): group for group in root if _named(group) == "g"}
        still = list(groups["still"])
        self.box = tuple(float(value) for value in root.get("viewBox", "").split())
        solid = [one for one in still if re.search(r"--(solid|low)", one.get("style", ""))]
        self.polygons = [_points(one) for one in solid if _named(one) == "polygon"]
        self.discs = [[float(one.get(name, "")) for name in ("cx", "cy", "r")] for one in solid if one.get("r")]
        tip = _points(next(one for one in groups["arrow asked"] if _named(one) == "polygon"))[0]
        self.asked = _angle(tip)
        marks = [one for one in still if "--goal" in one.get("style", "") and one.get("r")]
        mark = next((one.get("transform", "") for one in still if _named(one) == "g"), None)
        if mark is None:  # it lies in the sketch: the goal, and how near one must come
            self.goal, self.shown = np.array([float(marks[0].get(name, "")) for name in ("cx", "cy")]), True
            return
        words = next(one.text or "" for one in still if _named(one) == "text")
        at = np.array([float(value) for value in re.findall(r"-?[\d.]+", mark)[:2]])
        (away,) = re.findall(r"[\d.]+", words)
        self.goal, self.shown = at / np.linalg.norm(at) * float(away), False

    def clearance(self, places: np.ndarray) -> np.ndarray:
        """Distances of places (n, 2) from the nearest solid [m], (n,); 0 inside."""
        found = np.full(len(places), np.inf)
        for x, y, radius in self.discs:
            found = np.minimum(found, np.maximum(np.hypot(places[:, 0] - x, places[:, 1] - y) - radius, 0.0))
        for corners in self.polygons:
            edges = np.roll(corners, -1, axis=0) - corners
            away = places[:, None] - corners[None]
            along = np.clip((away * edges).sum(-1) / (edges**2).sum(-1), 0, 1)
            apart = np.linalg.norm(away - along[..., None] * edges, axis=-1).min(-1)
            side = edges[:, 0] * away[..., 1] - edges[:, 1] * away[..., 0]
            inside = (side >= 0).all(-1) | (side <= 0).all(-1)
            found = np.minimum(found, np.where(inside, 0.0, apart))
        return found

    def to_goal(self) -> float:
        """Return the direction to walk in, counterclockwise from ahead [deg]."""
        left, top, width, height = self.box
        shape = round(height / CELL) + 1, round(width / CELL) + 1
        rows, columns = np.indices(shape)
        places = np.stack([left + CELL * columns, top + CELL * rows], axis=-1)
        room = self.clearance(places.reshape(-1, 2)).reshape(shape)
        cost = np.where(room > 0, 1 + NARROW * np.maximum(1 - room / ROOM, 0.0), 1e4)
        number = np.arange(rows.size).reshape(shape)
        links = [self._links(number, cost, step) for step in STEPS]
        end = rows.size  # the goal as a place of its own
        near = self._entries(places, number)
        apart = np.linalg.norm(places.reshape(-1, 2)[near] - self.goal, axis=-1) + 1e-6
        links.append((near, np.full(len(near), end), apart))
        one, other, length = (np.concatenate(parts) for parts in zip(*links, strict=True))
        graph = csr_matrix((length, (one, other)), (end + 1, end + 1))
        _, before = dijkstra(graph, directed=False, indices=end, return_predecessors=True)
        return self._first(places.reshape(-1, 2), before, room)

    def _links(self, number: np.ndarray, cost: np.ndarray, step: tuple[int, int]) -> tuple[np.ndarray, ...]:
        """Neighbours in a direction, and the length of the way between them."""
        down, right = step
        rows, columns = number.shape
        one = np.s_[: rows - down, max(0, -right) : columns - max(0, right)]
        other = np.s_[down:, max(0, right) : columns - max(0, -right)]
        length = CELL * math.hypot(*step) * (cost[one] + cost[other]) / 2
        return number[one].ravel(), number[other].ravel(), length.ravel()

    def _entries(self, places: np.ndarray, number: np.ndarray) -> np.ndarray:
        """Cells from which the goal is reached in a straight line: those beside it, or the drawing's edge."""
        if self.shown:
            return number[np.linalg.norm(places - self.goal, axis=-1) < 1.5 * CELL]
        edge = np.ones(number.shape, bool)
        edge[1:-1, 1:-1] = False
        return number[edge]

    def _first(self, places: np.ndarray, before: np.ndarray, room: np.ndarray) -> float:
        """The direction of the farthest place of the way that can be walked to straight."""
        cell = int(np.linalg.norm(places, axis=-1).argmin())
        own, way = room.ravel()[cell], []
        while cell >= 0 and cell < len(places):
            way.append(places[cell])
            cell = before[cell]
        way.append(self.goal)
        found = way[min(len(way) - 1, 3)]
        for place in way[4:]:
            line = np.linspace(0, 1, 2 + int(np.linalg.norm(place) / CELL))[:, None] * place
            if self.clearance(line).min() < min(ROOM - CELL, own, self.clearance(place[None])[0]) - 1e-3:
                break
            found = place
        return _angle(found)


def _angle(place: np.ndarray) -> float:
    """Return the angle of a place as drawn, counterclockwise from ahead [deg]."""
    return math.degrees(math.atan2(-place[0], -place[1]))
