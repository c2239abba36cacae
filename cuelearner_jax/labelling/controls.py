"""What a person may press, and what the answers mean: derived from their form, so that each form has a page."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from cuelearner_jax.feedback.forms import AnswerForm
from cuelearner_jax.spaces import DIRECTIONS


class Control(NamedTuple):
    """A button and its keys."""

    name: str  # of its event
    words: str
    keys: tuple[str, ...]  # as browsers call them (`KeyboardEvent.key`)
    shown: str  # the keys, for people
    answer: tuple[float, ...] | None = None  # in the words of the form; None: no answer
    colour: str = ""  # of the button, and of the arrow that shows what it would do: a name of `outcomes`


UNSURE = Control("unsure", "don't know", ("ArrowDown", "s", "S"), "↓")
UNDO = Control("undo", "undo", ("Backspace", "u", "U"), "⌫")
FILM = Control("film", "film", ("f", "F"), "F")
HELP = Control("help", "help", ("h", "H", "?"), "H")
TURNED_FILMS = (
    Control("film-left", "film of more to the left", ("q", "Q"), "Q"),
    Control("film-right", "film of more to the right", ("e", "E"), "E"),
)
LEFT = Control("+1", "more to the left", ("ArrowLeft", "a", "A"), "←", (1.0,), "left")
RIGHT = Control("-1", "more to the right", ("ArrowRight", "d", "D"), "→", (-1.0,), "right")
AS_IT_IS = Control("0", "already right", ("ArrowUp", "w", "W", " "), "↑", (0.0,), "asked")
KEYS = {" ": "space", "ArrowLeft": "←", "ArrowRight": "→", "ArrowUp": "↑", "ArrowDown": "↓"}  # for people
PRACTICE = (  # what a person is to try, one a question of practice
    "Compare the arrows with what is wanted, then answer by key, button or click.",
    "Where you cannot tell, press ↓: it costs nothing. F shows a film of where the arrow leads.",
    "An answer can be taken back with ⌫. After this one it counts.",
)


def answers(form: AnswerForm) -> tuple[Control, ...]:
    """The answers that a form has, in the order of their buttons; none where an answer is pointed at."""
    if form.by_eps:
        return LEFT, AS_IT_IS, RIGHT
    if form.values is None:
        return ()
    if set(form.values(DIRECTIONS)) == {0.0, 1.0}:
        no = Control("no", "no", ("ArrowLeft", "n", "N"), "←", (0.0,))
        yes = Control("yes", "yes", ("ArrowRight", "y", "Y"), "→", (1.0,))
        return no, yes
    return tuple(
        Control(f"value-{place}", f"{value:g}", (str(place),), str(place), (value,))
        for place, value in enumerate(form.values(DIRECTIONS), start=1)
    )


def controls(form: AnswerForm) -> dict[str, Control]:
    """Everything that can be pressed, by name."""
    films = TURNED_FILMS if form.by_eps else ()
    return {control.name: control for control in (*answers(form), UNSURE, UNDO, FILM, *films, HELP)}


def question(form: AnswerForm) -> str:
    """What a person is asked."""
    if form.by_eps:
        return "Which way should the middle arrow turn?"
    if form.is_action:
        return "Point at what to do instead: click there."
    return (
        "Is the arrow good?"
        if set(form.values(DIRECTIONS) if form.values else ()) == {0.0, 1.0}
        else f"Your answer? ({form.meaning(DIRECTIONS)})"
    )


def help_lines(form: AnswerForm) -> list[str]:
    """What the page's help says, line by line."""
    lines = [f"{control.words}: {keys_of(control)}" for control in controls(form).values()]
    if form.by_eps:
        lines.append(
            "Left and right are those of somebody who walks along the arrow: left turns it counterclockwise. "
            "Two arrows in the picture show both turns, in the colour of their button and with its key."
        )
    return [
        *lines,
        "Each answer is saved before the next question shows. Where you cannot tell, say so: it costs nothing.",
        "A key that comes while no question can take it is not taken, and the page says so.",
    ]


def keys_of(control: Control) -> str:
    """All keys of a control, for people."""
    return ", ".join(dict.fromkeys(KEYS.get(key, key.upper() if len(key) == 1 else key) for key in control.keys))


def given(form: AnswerForm, pressed: Control | None, angle_deg: float | None) -> np.ndarray | None:
    """An answer in the words of the form: what was pressed, or pointed at [deg]; None: no answer."""
    if pressed is not None:
        return None if pressed.answer is None else np.asarray(pressed.answer, np.float32)
    assert angle_deg is not None
    return np.array([np.cos(np.deg2rad(angle_deg)), np.sin(np.deg2rad(angle_deg))], np.float32)


def angle_of(action: np.ndarray) -> float:
    """Of a direction, counterclockwise [deg]."""
    return math.degrees(math.atan2(float(action[1]), float(action[0])))


def turned(action: np.ndarray, by_deg: float) -> np.ndarray:
    """A direction turned counterclockwise."""
    angle = math.radians(angle_of(action) + by_deg)
    return np.array([math.cos(angle), math.sin(angle)], np.float32)


def outcomes(form: AnswerForm, action: np.ndarray, eps_deg: float) -> dict[str, np.ndarray]:
    """The action in question ("asked"), and what the answers would make of it ("left", "right") if they turn it."""
    ways = {"left": eps_deg, "right": -eps_deg} if form.by_eps else {}
    return {"asked": action, **{name: turned(action, way) for name, way in ways.items()}}
