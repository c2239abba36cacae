"""A question as SVG: the sketch of its situation, the action as an arrow, and what answers would make of it."""

from __future__ import annotations

import html
import json
import math

import numpy as np

from cuelearner_jax.feedback.forms import AnswerForm
from cuelearner_jax.labelling import controls
from cuelearner_jax.labelling.session import Item
from cuelearner_jax.spaces import DIRECTIONS, Space
from cuelearner_jax.types import Reel, Sketch

HAIR = 1 / 400  # of the sketch's width: a thin line
TURNED_REACH = 1.25, 3.5  # how much farther arrows reach that are turned: the more the less they are,
APART = 10.0  # by this over eps [deg], so that they can be told apart
BESIDE_TRAILS = 1.8  # no turned arrow reaches farther where trails tell them apart: what it points at stays in view
HEAD = 7.0  # length of an arrow's head [hairs]
HALO = ' class="halo"', 3.8  # so that arrows stand out on any ground
TIPS = 8.0  # turns are drawn larger than they are where tips would be nearer than this [hairs],
STEEPEST = 30.0  # but eps no larger than this [deg],
WIDEST = 60.0  # and a refined action no farther away, unless it is [deg]
BADGE = 7.0  # radius of the key at a turned arrow's tip [hairs]
LEAST_TURN = 1.0  # of the refined action from the one in question as they are drawn, to be shown [deg]


def magnified(item: Item, eps_deg: float) -> int:
    """How many times larger than they are turns of an item's action are drawn: so that one by eps can be seen."""
    assert item.sketch is not None
    sketch, hair = item.sketch, item.sketch.box[2] * HAIR
    far = _ends(sketch, angle_of(item.action), _farthest(item))[1]
    seen = min(math.degrees(math.asin(min(TIPS * hair / far, 1.0))), STEEPEST)
    return math.ceil(seen / eps_deg) if eps_deg < 0.75 * seen else 1


def _farthest(item: Item) -> float:
    """How much farther turned arrows may reach."""
    return BESIDE_TRAILS if item.trails else TURNED_REACH[1]


def note(item: Item, form: AnswerForm, eps_deg: float, space: Space = DIRECTIONS) -> str:
    """What a person has to know about the picture, of an action that is no arrow in it what it is; empty: nothing."""
    if space != DIRECTIONS:
        refined = "" if item.refined is None else f"; the model makes of it: {space.words_of(item.refined)}"
        return f"the action: {space.words_of(item.action)}{refined}"
    times = magnified(item, eps_deg) if form.by_eps else 1
    if times == 1:
        return ""
    true = "; the thin lines are true" if item.trails else ""
    return f"turns are drawn {times} times as large: {eps_deg:g}° as {times * eps_deg:g}°{true}"


def picture(item: Item, form: AnswerForm, eps_deg: float, space: Space = DIRECTIONS) -> str:
    """An item with a sketch, as an SVG element; attributes `data-…` tell the page's script what it shows.

    Directions are drawn as arrows; of other actions the picture shows what they lead to, where the task draws that.
    """
    assert item.sketch is not None
    sketch, planar = item.sketch, space == DIRECTIONS
    parts = [f'<g class="still">{sketch.still}</g>']
    for name, drawn in reversed((item.trails or {}).items()):
        parts += [f'<g class="trail halo">{drawn}</g>', f'<g class="trail {name}">{drawn}</g>']
    for name, body in sketch.movers.items():
        place = f'class="mover" data-mover="{html.escape(name)}" transform="{_moved(sketch, name)}"'
        parts.append(f"<g {place}>{body}</g>")
    parts += _arrows(item, form, eps_deg) if planar else []
    data = {
        "item": item.number,
        "foot": json.dumps(sketch.foot),
        "turn": sketch.turn,
        "points": int(form.is_action and planar),
        "places": json.dumps(sketch.places),
        "angle": angle_of(item.action) if planar else 0.0,
    }
    told = " ".join(f'data-{name}="{html.escape(str(value))}"' for name, value in data.items())
    box = " ".join(f"{value:.4f}" for value in sketch.box)
    asked = "the arrow is the action in question" if planar else note(item, form, eps_deg, space)
    words = html.escape(f"{sketch.words}; {asked}")
    return f'<svg class="scene" role="img" aria-label="{words}" viewBox="{box}" {told}>{"".join(parts)}</svg>'


def angle_of(action: np.ndarray) -> float:
    """Of a direction, counterclockwise [deg]."""
    return math.degrees(math.atan2(float(action[1]), float(action[0])))


def _arrows(item: Item, form: AnswerForm, eps_deg: float) -> list[str]:
    """The direction in question, what the answers and the model would make of it, and where one points."""
    assert item.sketch is not None
    sketch, angle = item.sketch, angle_of(item.action)
    parts, times = [], magnified(item, eps_deg) if form.by_eps else 1
    if form.by_eps:
        drawn = times * eps_deg
        longer = min(max(APART / drawn, TURNED_REACH[0]), _farthest(item))
        for one in controls.answers(form, DIRECTIONS):
            if one.answer and one.answer[0]:
                parts.append(_arrow(sketch, angle + one.answer[0] * drawn, one.colour, longer, one.shown))
    parts.append("" if item.trails else _line(sketch, angle))
    parts.append(_arrow(sketch, angle, "asked"))
    if item.refined is not None:
        turn = (angle_of(item.refined) - angle + 180) % 360 - 180
        turn = math.copysign(min(times * abs(turn), max(WIDEST, abs(turn))), turn)
        if abs(turn) >= LEAST_TURN:
            parts.append(_arrow(sketch, angle + turn, "refined", 0.8))
    if form.is_action:
        parts.append(_arrow(sketch, angle, "pointer"))
    return parts


def film(item: Item, reel: Reel) -> str:
    """A film for the page's script, as JSON."""
    return json.dumps({"item": item.number, **reel._asdict()})


def _moved(sketch: Sketch, name: str) -> str:
    x, y, turn = sketch.places[name]
    return f"translate({x:.4f} {y:.4f}) rotate({turn:.2f})"


def _point(sketch: Sketch, angle: float, along: float, across: float = 0.0) -> tuple[float, float]:
    """A place on the screen, by its distances along and to the left of an action's direction."""
    screen = math.radians(angle + sketch.turn)
    cos, sin = math.cos(screen), math.sin(screen)
    x, y = along * cos - across * sin, along * sin + across * cos
    return sketch.foot[0] + x, sketch.foot[1] - y


def _room(sketch: Sketch, angle: float) -> float:
    """From the foot along a direction to the edge of what is shown."""
    (x, y), (left, top, width, height) = sketch.foot, sketch.box
    away_x, away_y = (one - other for one, other in zip(_point(sketch, angle, 1.0), sketch.foot, strict=True))
    across = (left + width - x if away_x > 0 else x - left) / max(abs(away_x), 1e-9)
    down = (top + height - y if away_y > 0 else y - top) / max(abs(away_y), 1e-9)
    return min(across, down)


def _ends(sketch: Sketch, angle: float, longer: float = 1.0, beyond: float = 0.0) -> tuple[float, float]:
    """Where an arrow begins and ends, from the foot: within what is shown, but never too short for its head [m].

    `beyond`: what else is to be shown beyond its tip [m].
    """
    hair, (first, last) = sketch.box[2] * HAIR, sketch.reach
    last = first + (last - first) * longer
    return first, max(min(last, _room(sketch, angle) - 2 * hair - beyond), first + HEAD * hair)


def _arrow(sketch: Sketch, angle: float, name: str, longer: float = 1.0, key: str = "") -> str:
    hair = sketch.box[2] * HAIR
    head, half, badge = HEAD * hair, 2.8 * hair, BADGE * hair
    first, last = _ends(sketch, angle, longer, 2 * badge if key else 0.0)
    shaft = [_point(sketch, angle, first), _point(sketch, angle, last - 0.6 * head)]
    tip = [_point(sketch, angle, last), *(_point(sketch, angle, last - head, side) for side in (half, -half))]
    (x1, y1), (x2, y2) = shaft
    corners = " ".join(f"{x:.4f},{y:.4f}" for x, y in tip)
    place = f'x1="{x1:.4f}" y1="{y1:.4f}" x2="{x2:.4f}" y2="{y2:.4f}"'
    halo, line = (f'<line{kind} {place} stroke-width="{width * hair:.5f}"/>' for kind, width in (HALO, ("", 2.2)))
    head_drawn = f'<polygon points="{corners}" stroke-width="{1.6 * hair:.5f}"/>'
    shown = ""
    if key:  # which says this, at its tip: left and right on the screen are others where the arrow points down
        x, y = _point(sketch, angle, last + badge)
        disc = f'<circle cx="{x:.4f}" cy="{y:.4f}" r="{badge:.5f}" stroke-width="{0.8 * hair:.5f}"/>'
        shown = f'<g class="at-key">{disc}<text x="{x:.4f}" y="{y:.4f}" font-size="{1.6 * badge:.5f}">{key}</text></g>'
    return f'<g class="arrow {name}">{halo}{line}{head_drawn}{shown}</g>'


def _line(sketch: Sketch, angle: float) -> str:
    if not sketch.aim:
        return ""
    (x1, y1), (x2, y2) = (_point(sketch, angle, along) for along in (sketch.reach[1], sketch.reach[1] + sketch.aim))
    hair = sketch.box[2] * HAIR
    dashes = f"{4 * hair:.5f} {3 * hair:.5f}"
    place = f'x1="{x1:.4f}" y1="{y1:.4f}" x2="{x2:.4f}" y2="{y2:.4f}"'
    return f'<line class="aim" {place} stroke-width="{0.8 * hair:.5f}" stroke-dasharray="{dashes}"/>'
