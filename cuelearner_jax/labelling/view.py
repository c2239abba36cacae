"""A question as SVG: the sketch of its situation, the action as an arrow, and what answers would make of it."""

from __future__ import annotations

import html
import json
import math
from collections.abc import Sequence

import numpy as np

from cuelearner_jax.feedback.forms import AnswerForm
from cuelearner_jax.labelling import controls, pointing
from cuelearner_jax.labelling.arrows import HAIR, arrow, ends, line
from cuelearner_jax.labelling.controls import Control
from cuelearner_jax.labelling.session import Item
from cuelearner_jax.spaces import DIRECTIONS, Space
from cuelearner_jax.types import Reel, Sketch

TURNED_REACH = 1.25, 3.5  # how much farther arrows reach that are turned: the more the less they are,
APART = 10.0  # by this over eps [deg], so that they can be told apart
BESIDE_TRAILS = 1.8  # no turned arrow reaches farther where trails tell them apart: what it points at stays in view
TIPS = 8.0  # turns are drawn larger than they are where tips would be nearer than this [hairs],
STEEPEST = 30.0  # but eps no larger than this [deg],
WIDEST = 60.0  # and a refined action no farther away, unless it is [deg]
LEAST_TURN = 1.0  # of the refined action from the one in question as they are drawn, to be shown [deg]


def magnified(item: Item, eps_deg: float) -> int:
    """How many times larger than they are turns of an item's action are drawn: so that one by eps can be seen."""
    assert item.sketch is not None
    sketch, hair = item.sketch, item.sketch.box[2] * HAIR
    far = ends(sketch, angle_of(item.action), _farthest(item))[1]
    seen = min(math.degrees(math.asin(min(TIPS * hair / far, 1.0))), STEEPEST)
    return math.ceil(seen / eps_deg) if eps_deg < 0.75 * seen else 1


def _farthest(item: Item) -> float:
    """How much farther turned arrows may reach."""
    return BESIDE_TRAILS if item.trails else TURNED_REACH[1]


def note(item: Item, form: AnswerForm, eps_deg: float, space: Space = DIRECTIONS) -> str:
    """What a person has to know about the picture, of an action that is no arrow in it what it is; empty: nothing."""
    if space != DIRECTIONS:
        told = f"the action: {space.words_of(item.action)}"
        if item.refined is None:
            return told
        change = np.asarray(space.to_unit(space.log(item.action, item.refined)))
        return f"{told}. The correction: {pointing.change_words(space, change)}"
    times = magnified(item, eps_deg) if form.by_eps else 1
    if times == 1:
        return ""
    true = "; the thin lines are true" if item.trails else ""
    return f"turns are drawn {times} times as large: {eps_deg:g}° as {times * eps_deg:g}°{true}"


def picture(item: Item, form: AnswerForm, eps_deg: float, space: Space = DIRECTIONS, one_cue: bool = False) -> str:
    """An item with a sketch, as an SVG element; attributes `data-…` tell the page's script what it shows.

    Directions are drawn as arrows. Of other actions the picture shows what they lead to, where the task draws that, and
    the cues that point somewhere in it. `one_cue`: see `controls.answers`.
    """
    assert item.sketch is not None
    sketch, planar = item.sketch, space == DIRECTIONS
    parts = [f'<g class="still">{sketch.still}</g>']
    for name, drawn in reversed((item.trails or {}).items()):
        parts += [f'<g class="trail halo">{drawn}</g>', f'<g class="trail {name}">{drawn}</g>']
    for name, body in sketch.movers.items():
        place = f'class="mover" data-mover="{html.escape(name)}" transform="{_moved(sketch, name)}"'
        parts.append(f"<g {place}>{body}</g>")
    parts += _arrows(item, form, eps_deg) if planar else _cues(item, space, controls.answers(form, space, one_cue))
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
                parts.append(arrow(sketch, angle + one.answer[0] * drawn, one.colour, longer, one.shown))
    parts.append("" if item.trails else line(sketch, angle))
    parts.append(arrow(sketch, angle, "asked"))
    if item.refined is not None:
        turn = (angle_of(item.refined) - angle + 180) % 360 - 180
        turn = math.copysign(min(times * abs(turn), max(WIDEST, abs(turn))), turn)
        if abs(turn) >= LEAST_TURN:
            parts.append(arrow(sketch, angle + turn, "refined", 0.8))
    if form.is_action:
        parts.append(arrow(sketch, angle, "pointer"))
    return parts


def _cues(item: Item, space: Space, answers: Sequence[Control]) -> list[str]:
    """The answers about cues, the action in question, and what the model makes of it, where cues point somewhere."""
    assert item.sketch is not None
    ways, middle = pointing.ways_of(space, item.sketch), space.middle()
    parts = pointing.answers_drawn(item.sketch, ways, answers)
    for name, action in (("asked", item.action), ("refined", item.refined)):
        if action is not None and middle is not None:
            shares = np.asarray(space.to_unit(space.log(middle, action))) / (space.reach / 2)
            parts.append(pointing.from_foot(item.sketch, ways, shares, name))
    return parts


def film(item: Item, reel: Reel) -> str:
    """A film for the page's script, as JSON."""
    return json.dumps({"item": item.number, **reel._asdict()})


def _moved(sketch: Sketch, name: str) -> str:
    x, y, turn = sketch.places[name]
    return f"translate({x:.4f} {y:.4f}) rotate({turn:.2f})"
