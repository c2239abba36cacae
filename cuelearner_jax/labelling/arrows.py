"""Draw arrows as SVG in the coordinate frame of a task's sketch."""

from __future__ import annotations

import math

from cuelearner_jax.types import Sketch

HAIR = 1 / 400  # width of a thin line, as a share of the sketch's width; "hair" below is this length
HEAD = 7.0  # length of an arrow's head [hairs]
HALO = ' class="halo"', 3.8  # CSS class and width [hairs] of the outline that sets an arrow off from its background
BADGE = 7.0  # radius of the key's disc at an arrow's tip [hairs]


def point(sketch: Sketch, angle: float, along: float, across: float = 0.0) -> tuple[float, float]:
    """Return the screen point at a distance along, and one to the left of, an action's direction [m]."""
    screen = math.radians(angle + sketch.turn)
    cos, sin = math.cos(screen), math.sin(screen)
    x, y = along * cos - across * sin, along * sin + across * cos
    return sketch.foot[0] + x, sketch.foot[1] - y


def room(sketch: Sketch, angle: float) -> float:
    """Return the distance from the sketch's foot, along a direction [deg], to the edge of the picture [m]."""
    (x, y), (left, top, width, height) = sketch.foot, sketch.box
    away_x, away_y = (one - other for one, other in zip(point(sketch, angle, 1.0), sketch.foot, strict=True))
    across = (left + width - x if away_x > 0 else x - left) / max(abs(away_x), 1e-9)
    down = (top + height - y if away_y > 0 else y - top) / max(abs(away_y), 1e-9)
    return min(across, down)


def ends(sketch: Sketch, angle: float, longer: float = 1.0, beyond: float = 0.0) -> tuple[float, float]:
    """Return where an arrow begins and ends, as distances from the sketch's foot [m].

    The arrow stays within the picture, but is never too short for its head. `beyond` is the space to leave beyond its
    tip [m].
    """
    hair, (first, last) = sketch.box[2] * HAIR, sketch.reach
    last = first + (last - first) * longer
    return first, max(min(last, room(sketch, angle) - 2 * hair - beyond), first + HEAD * hair)


def arrow(sketch: Sketch, angle: float, name: str, longer: float = 1.0, key: str = "", larger: float = 1.0) -> str:
    """Return the SVG of an arrow along an action's direction.

    Args:
        sketch: gives the arrow's start and length.
        angle: the direction, counterclockwise [deg].
        name: the arrow's CSS class, which sets its colour.
        longer: factor on the arrow's length.
        key: the key shown at the arrow's tip; empty for no key.
        larger: factor on the widths of strokes, head and key.
    """
    hair = sketch.box[2] * HAIR * larger
    head, half, badge = HEAD * hair, 2.8 * hair, BADGE * hair
    first, last = ends(sketch, angle, longer, 2 * badge if key else 0.0)
    shaft = [point(sketch, angle, first), point(sketch, angle, last - 0.6 * head)]
    tip = [point(sketch, angle, last), *(point(sketch, angle, last - head, side) for side in (half, -half))]
    (x1, y1), (x2, y2) = shaft
    corners = " ".join(f"{x:.4f},{y:.4f}" for x, y in tip)
    place = f'x1="{x1:.4f}" y1="{y1:.4f}" x2="{x2:.4f}" y2="{y2:.4f}"'
    halo, line = (f'<line{kind} {place} stroke-width="{width * hair:.5f}"/>' for kind, width in (HALO, ("", 2.2)))
    head_drawn = f'<polygon points="{corners}" stroke-width="{1.6 * hair:.5f}"/>'
    shown = ""
    if key:  # the key at the tip names the answer: screen left and right are swapped where an arrow points down
        x, y = point(sketch, angle, last + badge)
        disc = f'<circle cx="{x:.4f}" cy="{y:.4f}" r="{badge:.5f}" stroke-width="{0.8 * hair:.5f}"/>'
        shown = f'<g class="at-key">{disc}<text x="{x:.4f}" y="{y:.4f}" font-size="{1.6 * badge:.5f}">{key}</text></g>'
    return f'<g class="arrow {name}">{halo}{line}{head_drawn}{shown}</g>'


def line(sketch: Sketch, angle: float) -> str:
    """Return the SVG of the thin line that continues an arrow; empty where the sketch has no aim line."""
    if not sketch.aim:
        return ""
    (x1, y1), (x2, y2) = (point(sketch, angle, along) for along in (sketch.reach[1], sketch.reach[1] + sketch.aim))
    hair = sketch.box[2] * HAIR
    dashes = f"{4 * hair:.5f} {3 * hair:.5f}"
    place = f'x1="{x1:.4f}" y1="{y1:.4f}" x2="{x2:.4f}" y2="{y2:.4f}"'
    return f'<line class="aim" {place} stroke-width="{0.8 * hair:.5f}" stroke-dasharray="{dashes}"/>'
