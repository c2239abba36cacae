"""Draw a question as SVG: the situation's sketch, the action as an arrow, and the answers' outcomes."""

from __future__ import annotations

import html
import json
import math
from collections.abc import Sequence

import numpy as np

from cuelearner_jax.feedback.answers import AnswerForm
from cuelearner_jax.labelling import controls, pointing
from cuelearner_jax.labelling.arrows import HAIR, arrow, ends, line
from cuelearner_jax.labelling.controls import Control
from cuelearner_jax.labelling.questions import Item
from cuelearner_jax.spaces import DIRECTIONS, Space
from cuelearner_jax.types import Reel, Sketch

# factors on the reach of turned arrows, least and most: the smaller the turn, the longer the arrow,
TURNED_REACH = 1.25, 3.5
APART = 10.0  # by this over eps [deg], so that the arrows can be told apart
BESIDE_TRAILS = 1.8  # the most where trails show the outcomes, so that what an arrow points at stays visible
TIPS = 8.0  # turns are magnified where arrow tips would otherwise be nearer than this [hairs],
STEEPEST = 30.0  # with eps drawn no larger than this [deg],
WIDEST = 60.0  # and a refined action no farther away than this, unless its true turn is larger [deg]
LEAST_TURN = 1.0  # smallest drawn turn for which the refined action is shown [deg]


def drawn(item: Item) -> Sketch:
    """Return the sketch of an item that the page shows."""
    assert item.sketch is not None
    return item.sketch


def magnified(item: Item, eps_deg: float) -> int:
    """Return the factor by which turns of an item's action are magnified, so that a turn by eps is visible."""
    sketch = drawn(item)
    hair = sketch.box[2] * HAIR
    far = ends(sketch, angle_of(item.action), _farthest(item))[1]
    seen = min(math.degrees(math.asin(min(TIPS * hair / far, 1.0))), STEEPEST)
    return math.ceil(seen / eps_deg) if eps_deg < 0.75 * seen else 1


def _farthest(item: Item) -> float:
    """Return the largest factor on the reach of turned arrows."""
    return BESIDE_TRAILS if item.trails else TURNED_REACH[1]


def note(item: Item, form: AnswerForm, eps_deg: float, space: Space = DIRECTIONS) -> str:
    """Return the note below the picture: the magnification or, where the action is no arrow, its words."""
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
    """Return an item with a sketch as an SVG element; attributes `data-…` describe it to the page's script.

    Directions are drawn as arrows. For other actions the picture shows their outcomes, where the task draws them, and
    the cues that have a direction on the screen. `one_cue`: see `controls.answers`.
    """
    sketch, planar = drawn(item), space == DIRECTIONS
    parts = [f'<g class="still">{sketch.still}</g>']
    for name, trail in reversed((item.trails or {}).items()):
        parts += [f'<g class="trail halo">{trail}</g>', f'<g class="trail {name}">{trail}</g>']
    for name, body in sketch.movers.items():
        x, y, turn = sketch.places[name]
        moved = f"translate({x:.4f} {y:.4f}) rotate({turn:.2f})"
        parts.append(f'<g class="mover" data-mover="{html.escape(name)}" transform="{moved}">{body}</g>')
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
    """Return the angle of a direction, counterclockwise [deg]."""
    return math.degrees(math.atan2(float(action[1]), float(action[0])))


def _arrows(item: Item, form: AnswerForm, eps_deg: float) -> list[str]:
    """Return the arrows of the asked direction, of the answers' outcomes, of the model's action, and the pointer."""
    sketch, angle = drawn(item), angle_of(item.action)
    parts, times = [], magnified(item, eps_deg) if form.by_eps else 1
    if form.by_eps:
        turn = times * eps_deg
        longer = min(max(APART / turn, TURNED_REACH[0]), _farthest(item))
        for one in controls.answers(form, DIRECTIONS):
            if one.answer and one.answer[0]:
                parts.append(arrow(sketch, angle + one.answer[0] * turn, one.colour, longer, one.shown))
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
    """Return the arrows of the cues' answers and of the actions, for cues with a screen direction."""
    sketch, middle = drawn(item), space.middle()
    ways = pointing.ways_of(space, sketch)
    parts = pointing.answers_drawn(sketch, ways, answers)
    for name, action in (("asked", item.action), ("refined", item.refined)):
        if action is not None and middle is not None:
            shares = np.asarray(space.to_unit(space.log(middle, action))) / (space.reach / 2)
            parts.append(pointing.from_foot(sketch, ways, shares, name))
    return parts


def film(item: Item, reel: Reel) -> str:
    """Return a film as JSON for the page's script."""
    return json.dumps({"item": item.number, **reel._asdict()})
