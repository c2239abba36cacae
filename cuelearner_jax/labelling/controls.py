"""What a person may press: derived from the form of the answers, so that each form of feedback has a page."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from cuelearner_jax.guidance.bundle import AnswerForm


class Control(NamedTuple):
    """A button and its keys."""

    name: str  # of its event
    words: str
    keys: tuple[str, ...]  # as browsers call them (`KeyboardEvent.key`)
    shown: str  # the keys, for people
    answer: tuple[float, ...] | None = None  # in the words of the form; None: no answer
    colour: str = ""  # of the arrow that shows what it would do


UNSURE = Control("unsure", "don't know", ("ArrowDown", "s", "S"), "↓")
UNDO = Control("undo", "undo", ("Backspace", "u", "U"), "⌫")
FILM = Control("film", "film", ("f", "F"), "F")
HELP = Control("help", "help", ("h", "H", "?"), "H")
TURNED_FILMS = (
    Control("film-left", "film of counterclockwise", ("q", "Q"), "Q"),
    Control("film-right", "film of clockwise", ("e", "E"), "E"),
)
COUNTERCLOCKWISE = Control("+1", "counterclockwise", ("ArrowLeft", "a", "A"), "←", (1.0,), "left")
RIGHT = Control("0", "already right", ("ArrowUp", "w", "W", " "), "↑", (0.0,), "asked")
CLOCKWISE = Control("-1", "clockwise", ("ArrowRight", "d", "D"), "→", (-1.0,), "right")


def answers(form: AnswerForm) -> tuple[Control, ...]:
    """The answers that a form has, in the order of their buttons; none where an answer is pointed at."""
    if form.by_eps:
        return COUNTERCLOCKWISE, RIGHT, CLOCKWISE
    if form.values is None:
        return ()
    if set(form.values) == {0.0, 1.0}:
        no, yes = Control("no", "no", ("ArrowLeft", "n", "N"), "←", (0.0,)), None
        yes = Control("yes", "yes", ("ArrowRight", "y", "Y"), "→", (1.0,))
        return no, yes
    return tuple(
        Control(f"value-{place}", f"{value:g}", (str(place),), str(place), (value,))
        for place, value in enumerate(form.values, start=1)
    )


def controls(form: AnswerForm) -> dict[str, Control]:
    """Everything that can be pressed, by name."""
    films = TURNED_FILMS if form.by_eps else ()
    return {control.name: control for control in (*answers(form), UNSURE, UNDO, FILM, *films, HELP)}


def question(form: AnswerForm) -> str:
    """What a person is asked."""
    if form.by_eps:
        return "Which way should the arrow turn?"
    if form.is_action:
        return "Point at what to do instead: click there."
    return "Is the arrow good?" if set(form.values or ()) == {0.0, 1.0} else f"Your answer? ({form.meaning})"


def given(form: AnswerForm, pressed: Control | None, angle_deg: float | None) -> np.ndarray | None:
    """An answer in the words of the form: what was pressed, or pointed at [deg]; None: no answer."""
    if pressed is not None:
        return None if pressed.answer is None else np.asarray(pressed.answer, np.float32)
    assert angle_deg is not None
    return np.array([np.cos(np.deg2rad(angle_deg)), np.sin(np.deg2rad(angle_deg))], np.float32)
