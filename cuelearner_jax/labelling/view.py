"""Draw a question as SVG: the situation's sketch, its action and the answers as arrows, and the answers' outcomes."""

from __future__ import annotations

import html
import json
import math
from collections.abc import Sequence

import numpy as np

from cuelearner_jax.feedback.answers import AnswerForm
from cuelearner_jax.labelling import controls
from cuelearner_jax.labelling.controls import Control
from cuelearner_jax.labelling.questions import Item
from cuelearner_jax.spaces import DIRECTIONS, Cue, Space
from cuelearner_jax.spaces.box import SHARE
from cuelearner_jax.types import Sketch

HAIR = 1 / 400  # width of a thin line, as a share of the sketch's width; "hair" below is this length
HEAD, BADGE = 7.0, 7.0  # length of an arrow's head, and radius of the key's disc at its tip [hairs]
HALO = 3.8  # width of the outline that sets an arrow off from its background [hairs]
# factors on the reach of turned arrows, least and most: the smaller the turn, the longer the arrow,
TURNED_REACH = 1.25, 3.5
APART = 10.0  # by this over eps [deg], so that the arrows can be told apart
BESIDE_TRAILS = 1.8  # the most where trails show the outcomes, so that what an arrow points at stays visible
TIPS = 8.0  # turns are magnified where arrow tips would otherwise be nearer than this [hairs],
STEEPEST = 30.0  # with eps drawn no larger than this [deg],
WIDEST = 60.0  # and a refined action no farther away than this, unless its true turn is larger [deg]
LEAST_TURN = 1.0  # smallest drawn turn for which the refined action is shown [deg]

Direction = tuple[float, float]  # on the screen: x to the right, y down
AWAY = (0.7, -0.7)  # "away" is drawn to the upper right, since up and right belong to other cues
WORDS: dict[str, Direction] = {
    **dict.fromkeys(("left", "leftward", "leftwards"), (-1.0, 0.0)),
    **dict.fromkeys(("right", "rightward", "rightwards"), (1.0, 0.0)),
    **dict.fromkeys(("up", "upward", "upwards", "higher", "raise"), (0.0, -1.0)),
    **dict.fromkeys(("down", "downward", "downwards", "lower"), (0.0, 1.0)),
    **dict.fromkeys(("forward", "forwards", "farther", "further", "away", "ahead"), AWAY),
    **dict.fromkeys(("back", "backward", "backwards", "nearer", "closer"), (-AWAY[0], -AWAY[1])),
}
LENGTH = 0.1  # length of a cue's arrow, as a share of the picture's shorter side
LEAST = 0.05  # arrows of actions shorter than this share of the sketch's reach are not drawn
LARGER = 1.5  # factor on strokes and keys of cues' arrows, compared with those of directions


def picture(item: Item, form: AnswerForm, eps_deg: float, space: Space = DIRECTIONS, one_cue: bool = False) -> str:
    """Return an item with a sketch as an SVG element; attributes `data-…` describe it to the page's script.

    Directions are drawn as arrows. For other actions the picture shows their outcomes, where the task draws them, and
    the cues that have a direction on the screen. `one_cue`: see `controls.answers`.
    """
    sketch, planar = item.sketch, space == DIRECTIONS
    assert sketch is not None
    parts = [f'<g class="still">{sketch.still}</g>']
    for name, trail in reversed((item.trails or {}).items()):
        parts += [f'<g class="trail halo">{trail}</g>', f'<g class="trail {name}">{trail}</g>']
    for name, body in sketch.movers.items():
        x, y, turn = sketch.places[name]
        place = f"translate({x:.4f} {y:.4f}) rotate({turn:.2f})"
        parts.append(f'<g class="mover" data-mover="{html.escape(name)}" transform="{place}">{body}</g>')
    if planar:
        parts += _arrows(sketch, item, form, eps_deg)
    else:
        parts += _cues(sketch, item, space, controls.answers(form, space, one_cue) if form.by_eps else ())
    data = {
        "item": item.number,
        "foot": json.dumps(sketch.foot),
        "turn": sketch.turn,
        "points": int(form.is_action and planar),
        "places": json.dumps(sketch.places),
        "angle": angle_of(item.action) if planar else 0.0,
    }
    attributes = " ".join(f'data-{name}="{html.escape(str(value))}"' for name, value in data.items())
    box = " ".join(f"{value:.4f}" for value in sketch.box)
    about = "arrows A and B are the actions in question" if item.pair else "the arrow is the action in question"
    about = about if planar else note(item, form, eps_deg, space)
    words = html.escape(f"{sketch.words}; {about}")
    return f'<svg class="scene" role="img" aria-label="{words}" viewBox="{box}" {attributes}>{"".join(parts)}</svg>'


def note(item: Item, form: AnswerForm, eps_deg: float, space: Space = DIRECTIONS) -> str:
    """Return the note below the picture: the magnification or, where the action is no arrow, its words."""
    if space != DIRECTIONS:
        actions = zip("AB", item.pair.values(), strict=True) if item.pair else [("the action", item.action)]
        words = ". ".join(f"{name}: {space.words_of(action)}" for name, action in actions)
        if item.refined is None:
            return words
        change = np.asarray(space.to_unit(space.log(item.action, item.refined)))
        return f"{words}. The correction: {change_words(space, change)}"
    times = magnification_of(item, eps_deg) if form.by_eps else 1
    if times == 1:
        return ""
    true = "; the thin lines are true" if item.trails else ""
    return f"turns are drawn {times} times as large: {eps_deg:g}° as {times * eps_deg:g}°{true}"


def change_words(space: Space, change: np.ndarray) -> str:
    """Return a change (cues,), in the space's unit, in words, as "left by 12%, open by 30% of the range"."""
    shares = space.unit == SHARE
    words = [
        f"{cue.words[part < 0]} by " + (f"{100 * abs(part):.0f}%" if shares else f"{abs(part):.2g} {space.unit}")
        for cue, part in zip(space.cues, change.tolist(), strict=True)
        if abs(part) >= 0.005 * space.reach
    ]
    return f"{', '.join(words)}{' of the range' * shares}" if words else "as it is"


def angle_of(action: np.ndarray) -> float:
    """Return the angle of a direction, counterclockwise [deg]."""
    return math.degrees(math.atan2(float(action[1]), float(action[0])))


def magnification_of(item: Item, eps_deg: float) -> int:
    """Return the factor by which turns of an item's action are magnified, so that a turn by eps is visible."""
    sketch = item.sketch
    assert sketch is not None
    _, far = _ends(sketch, angle_of(item.action), BESIDE_TRAILS if item.trails else TURNED_REACH[1])
    visible = min(math.degrees(math.asin(min(TIPS * sketch.box[2] * HAIR / far, 1.0))), STEEPEST)
    return math.ceil(visible / eps_deg) if eps_deg < 0.75 * visible else 1


def _arrows(sketch: Sketch, item: Item, form: AnswerForm, eps_deg: float) -> list[str]:
    """Return the arrows of the asked direction, of the answers' outcomes, of the model's action, and the pointer."""
    parts, angle, times = [], angle_of(item.action), magnification_of(item, eps_deg) if form.by_eps else 1
    if form.by_eps:
        turn = times * eps_deg
        longer = min(max(APART / turn, TURNED_REACH[0]), BESIDE_TRAILS if item.trails else TURNED_REACH[1])
        for one in controls.answers(form, DIRECTIONS):
            if one.answer and one.answer[0]:
                parts.append(arrow(sketch, angle + one.answer[0] * turn, one.colour, longer, one.first_key))
    for name, key, longer in (("left", "A", BESIDE_TRAILS), ("right", "B", TURNED_REACH[0])) if item.pair else ():
        parts.append(arrow(sketch, angle_of(item.pair[name]), name, longer, key))  # A shows where B lies upon it
    if sketch.aim and not item.trails and not item.pair:
        hair, tip = sketch.box[2] * HAIR, sketch.reach[1]
        dashes = f' class="aim" stroke-dasharray="{4 * hair:.5f} {3 * hair:.5f}"'
        parts.append(_line(_point(sketch, angle, tip), _point(sketch, angle, tip + sketch.aim), 0.8 * hair, dashes))
    parts += [] if item.pair else [arrow(sketch, angle, "asked")]
    if item.refined is not None:
        turn = (angle_of(item.refined) - angle + 180) % 360 - 180
        turn = math.copysign(min(times * abs(turn), max(WIDEST, abs(turn))), turn)
        if abs(turn) >= LEAST_TURN:
            parts.append(arrow(sketch, angle + turn, "refined", 0.8))
    return [*parts, arrow(sketch, angle, "pointer")] if form.is_action else parts


def by_words(cue: Cue) -> Direction | None:
    """Return the screen direction for "more" of a cue by its words; None: the words give none, or contradict."""
    ways = {
        (sign * WORDS[word][0], sign * WORDS[word][1])
        for words, sign in zip(cue.words, (1.0, -1.0), strict=True)
        for word in words.lower().replace("-", " ").split()
        if word in WORDS
    }
    return ways.pop() if len(ways) == 1 else None


def _cues(sketch: Sketch, item: Item, space: Space, answers: Sequence[Control]) -> list[str]:
    """Return the arrows of the cues' answers and of the actions, for cues with a screen direction.

    A direction that the task gives has its own length; a direction inferred from words has length 1 or less.
    """
    middle, ways = space.middle(), sketch.points or tuple(map(by_words, space.cues))
    parts, lanes = [], {}
    for control in answers:
        number = 0 if len(ways) == 1 else control.cue
        if number is None or control.answer is None or (way := ways[number]) is None:
            continue
        sign = control.answer[number if len(control.answer) > 1 else 0]
        if abs(sign) == 1.0:
            angle = math.degrees(math.atan2(-sign * way[1], sign * way[0]))
            lane = lanes[round(angle)] = lanes.get(round(angle), -1) + 1  # several cues may point in one direction
            parts.append(_at_edge(sketch, angle, lane, control))
    for name, action in ((item.pair or {"asked": item.action}) | {"refined": item.refined}).items():
        if action is not None and middle is not None and not item.trails:  # which show where actions lead
            start = np.where(np.asarray(space.retract(0 * middle)) == 0, 0, middle)  # 0 where a range holds it
            shares = np.asarray(space.to_unit(space.log(start, action))) / (space.reach / 2)
            parts.append(_from_foot(sketch, ways, shares, name))
    return parts


def _at_edge(sketch: Sketch, angle: float, lane: int, control: Control) -> str:
    """Draw the arrow of an answer near the edge, to leave the middle of the picture free; its words are a tooltip."""
    left, top, width, height = sketch.box
    length, size = LENGTH * min(width, height), BADGE * HAIR * width * LARGER
    across = (lane + 1) // 2 * (-1) ** lane * 4.0 * size
    x, y = math.cos(math.radians(angle)), -math.sin(math.radians(angle))
    middle = left + width / 2 - y * across, top + height / 2 + x * across
    edge = 1.5 * size
    inner = sketch._replace(foot=middle, turn=0.0, box=(left + edge, top + edge, width - 2 * edge, height - 2 * edge))
    out = _room(inner, angle) - length - size
    foot = middle[0] + x * out, middle[1] + y * out
    at = sketch._replace(foot=foot, turn=0.0, reach=(0.0, length))
    shape = arrow(at, angle, control.colour, key=control.first_key, larger=LARGER)
    centre = f'cx="{foot[0] + x * length:.3f}" cy="{foot[1] + y * length:.3f}"'
    title = f"<title>{html.escape(control.words)}</title>"
    return (
        f'<g class="said {control.colour}" data-name="{html.escape(control.name)}">{title}'
        f'<circle class="touched" {centre} r="{length:.3f}"/>{shape}</g>'
    )


def _from_foot(sketch: Sketch, ways: Sequence[Direction | None], shares: np.ndarray, name: str) -> str:
    """Draw an action as an arrow from the foot of a sketch, if it is long enough to be seen.

    `shares` (cues,) is the action's distance from 0, or from the middle of a range without 0; 1 is half of the range.
    """
    x, y = shares @ np.array([way or (0.0, 0.0) for way in ways])
    if (far := math.hypot(x, y)) < LEAST:
        return ""
    first, last = sketch.reach
    at = sketch._replace(turn=0.0, reach=(first, first + far * (last - first)))
    return arrow(at, math.degrees(math.atan2(-y, x)), name)


def _point(sketch: Sketch, angle: float, along: float, across: float = 0.0) -> tuple[float, float]:
    """Return the screen point at a distance along, and one to the left of, an action's direction [m]."""
    screen = math.radians(angle + sketch.turn)
    cos, sin = math.cos(screen), math.sin(screen)
    x, y = along * cos - across * sin, along * sin + across * cos
    return sketch.foot[0] + x, sketch.foot[1] - y


def _room(sketch: Sketch, angle: float) -> float:
    """Return the distance from the sketch's foot, along a direction [deg], to the edge of the picture [m]."""
    (x, y), (left, top, width, height) = sketch.foot, sketch.box
    away_x, away_y = (one - other for one, other in zip(_point(sketch, angle, 1.0), sketch.foot, strict=True))
    across = (left + width - x if away_x > 0 else x - left) / max(abs(away_x), 1e-9)
    return min(across, (top + height - y if away_y > 0 else y - top) / max(abs(away_y), 1e-9))


def _ends(sketch: Sketch, angle: float, longer: float = 1.0, beyond: float = 0.0) -> tuple[float, float]:
    """Return where an arrow begins and ends, as distances from the sketch's foot [m].

    The arrow stays within the picture with the space `beyond` its tip [m], but is never too short for its head.
    """
    hair, (first, last) = sketch.box[2] * HAIR, sketch.reach
    last = first + (last - first) * longer
    return first, max(min(last, _room(sketch, angle) - 2 * hair - beyond), first + HEAD * hair)


def _line(one: tuple[float, float], other: tuple[float, float], width: float, more: str = "") -> str:
    (x1, y1), (x2, y2) = one, other
    return f'<line{more} x1="{x1:.4f}" y1="{y1:.4f}" x2="{x2:.4f}" y2="{y2:.4f}" stroke-width="{width:.5f}"/>'


def arrow(sketch: Sketch, angle: float, name: str, longer: float = 1.0, key: str = "", larger: float = 1.0) -> str:
    """Return the SVG of an arrow along a direction [deg, counterclockwise], from the foot of a sketch over its reach.

    `name` is the CSS class, which sets the colour; `key` stands at the tip. `longer` is a factor on the length,
    `larger` on the widths of strokes, head and key.
    """
    hair = sketch.box[2] * HAIR * larger
    head, half, badge = HEAD * hair, 2.8 * hair, BADGE * hair
    first, last = _ends(sketch, angle, longer, 2 * badge if key else 0.0)
    shaft = _point(sketch, angle, first), _point(sketch, angle, last - 0.6 * head)
    tip = [_point(sketch, angle, last), *(_point(sketch, angle, last - head, side) for side in (half, -half))]
    corners = " ".join(f"{x:.4f},{y:.4f}" for x, y in tip)
    parts = [_line(*shaft, HALO * hair, ' class="halo"'), _line(*shaft, 2.2 * hair)]
    parts.append(f'<polygon points="{corners}" stroke-width="{1.6 * hair:.5f}"/>')
    if key:  # the key at the tip names the answer: screen left and right are swapped where an arrow points down
        x, y = _point(sketch, angle, last + badge)
        disc = f'<circle cx="{x:.4f}" cy="{y:.4f}" r="{badge:.5f}" stroke-width="{0.8 * hair:.5f}"/>'
        text = f'<text x="{x:.4f}" y="{y:.4f}" font-size="{1.6 * badge:.5f}">{html.escape(key)}</text>'
        parts.append(f'<g class="at-key">{disc}{text}</g>')
    return f'<g class="arrow {name}">{"".join(parts)}</g>'
