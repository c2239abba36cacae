"""Screen directions of cues, given by the task or inferred from the cues' words, and their drawing."""

from __future__ import annotations

import html
import math
from collections.abc import Sequence

import numpy as np

from cuelearner_jax.labelling.arrows import BADGE, HAIR, arrow, room
from cuelearner_jax.labelling.controls import Control
from cuelearner_jax.spaces import DIRECTIONS, Cue, Space
from cuelearner_jax.spaces.box import SHARE
from cuelearner_jax.types import Sketch

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


def by_words(cue: Cue) -> Direction | None:
    """Return the screen direction for "more" of a cue by its words; None: the words give none, or contradict."""
    said: set[Direction] = set()
    for words, sign in zip(cue.words, (1.0, -1.0), strict=True):
        ways = (WORDS.get(word) for word in words.lower().replace("-", " ").split())
        said |= {(sign * way[0], sign * way[1]) for way in ways if way}
    return said.pop() if len(said) == 1 else None


def ways_of(space: Space, sketch: Sketch) -> tuple[Direction | None, ...]:
    """Return the screen direction for "more" of each cue in a sketch; empty for directions, which are arrows already.

    A direction that the task gives has its own length; a direction inferred from words has length 1 or less.
    """
    if space == DIRECTIONS:
        return ()
    if sketch.points:
        return tuple(sketch.points)
    return tuple(by_words(cue) for cue in space.cues)


def answers_drawn(sketch: Sketch, ways: Sequence[Direction | None], controls: Sequence[Control]) -> list[str]:
    """Draw an arrow with its key for each control about a cue that has a direction on the screen.

    The arrows are placed near the edge, to leave the middle of the picture free. Their words stand on the buttons.
    """
    drawn, lanes = [], {}
    for control in controls:
        number = 0 if len(ways) == 1 else control.cue
        if number is None or control.answer is None or (way := ways[number]) is None:
            continue
        sign = control.answer[number if len(control.answer) > 1 else 0]
        if abs(sign) != 1.0:
            continue
        angle = math.degrees(math.atan2(-sign * way[1], sign * way[0]))
        lane = lanes[round(angle)] = lanes.get(round(angle), -1) + 1  # several cues may point in one direction
        drawn.append(_at_edge(sketch, angle, lane, control))
    return drawn


def _at_edge(sketch: Sketch, angle: float, lane: int, control: Control) -> str:
    _, _, width, height = sketch.box
    length, size = LENGTH * min(width, height), BADGE * HAIR * width * LARGER
    across = (lane + 1) // 2 * (-1) ** lane * 4.0 * size
    middle = sketch.box[0] + width / 2, sketch.box[1] + height / 2
    x, y = math.cos(math.radians(angle)), -math.sin(math.radians(angle))
    middle = middle[0] - y * across, middle[1] + x * across
    at = sketch._replace(foot=middle, turn=0.0)
    out = room(at, angle) - length - 2.5 * size
    foot = middle[0] + x * out, middle[1] + y * out
    at = at._replace(foot=foot, reach=(0.0, length))
    drawn = arrow(at, angle, control.colour, key=control.shown, larger=LARGER)
    touched = (
        f'<circle class="touched" cx="{foot[0] + x * length:.3f}" cy="{foot[1] + y * length:.3f}" r="{length:.3f}"/>'
    )
    name = html.escape(control.name)
    title = f"<title>{html.escape(control.words)}</title>"
    return f'<g class="said {control.colour}" data-name="{name}">{title}{touched}{drawn}</g>'


def from_foot(sketch: Sketch, ways: Sequence[Direction | None], shares: np.ndarray, name: str) -> str:
    """Draw an action as an arrow from the foot of a sketch, if it is long enough to be seen.

    `shares` (cues,) is the action's distance from the middle of each cue's range; 1 is the end of the range.
    """
    moves = [(float(share) * way[0], float(share) * way[1]) for share, way in zip(shares, ways, strict=True) if way]
    x, y = sum(move[0] for move in moves), sum(move[1] for move in moves)
    far = math.hypot(x, y)
    if far < LEAST:
        return ""
    first, last = sketch.reach
    at = sketch._replace(turn=0.0, reach=(first, first + far * (last - first)))
    return arrow(at, math.degrees(math.atan2(-y, x)), name)


def change_words(space: Space, change: np.ndarray) -> str:
    """Return a change (cues,) in the words of the cues, as "left by 12%, open by 30% of the range".

    `change` is in the space's unit.
    """
    told, shares = [], space.unit == SHARE
    for cue, part in zip(space.cues, np.asarray(change, float), strict=True):
        if abs(part) >= 0.005 * space.reach:
            amount = f"{100 * abs(part):.0f}%" if shares else f"{abs(part):.2g} {space.unit}"
            told.append(f"{cue.words[0 if part > 0 else 1]} by {amount}")
    return f"{', '.join(told)}{' of the range' * shares}" if told else "as it is"
