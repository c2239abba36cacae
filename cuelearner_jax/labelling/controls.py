"""Buttons and keys of the labelling page, and the answers they give, for a form of answers and an action space."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

from cuelearner_jax.errors import UserError
from cuelearner_jax.feedback.answers import AnswerForm
from cuelearner_jax.spaces import DIRECTIONS, UNSAID, Cue, Space

# What the page calls the two turns, from the point of view of somebody walking along the arrow.
WALKED = ("more to the left", "more to the right")
BESIDE = {"ArrowLeft": "aA", "ArrowRight": "dD"}  # the same answers' keys for the other hand
KEY_SIGNS = {" ": "space", "Backspace": "⌫", "Enter": "⏎"}  # how the page writes these keys
KEY_SIGNS |= {"ArrowLeft": "←", "ArrowRight": "→", "ArrowUp": "↑", "ArrowDown": "↓"}


def key_words(key: str) -> str:
    """Return a key as the page writes it."""
    return KEY_SIGNS.get(key, key.upper() if len(key) == 1 else key)


class Control(NamedTuple):
    """A button and its keys."""

    name: str  # of the control's event
    words: str
    keys: tuple[str, ...] = ()  # as browsers call them (`KeyboardEvent.key`)
    answer: tuple[float, ...] | None = None  # the answer in the form's encoding; None: this control gives no answer
    colour: str = ""  # of the button, and of the arrow that shows the answer's outcome: a key of `outcomes`
    cue: int | None = None  # index of the cue that this control answers about, where the space has several

    @property
    def picks(self) -> bool:
        """Whether a press is only stored until the whole answer is sent."""
        return self.cue is not None and self.answer is not None and len(self.answer) == 1

    @property
    def first_key(self) -> str:
        """The first key, as the page writes it."""
        return key_words(self.keys[0]) if self.keys else ""


UNSURE = Control("unsure", "don't know", ("ArrowDown", "s", "S"))
UNDO = Control("undo", "undo", ("Backspace", "u", "U"))
FILM = Control("film", "film", ("f", "F", "v", "V"))
CORRECTED = Control("film-refined", "film of the correction", ("x", "X"))
HELP = Control("help", "help", ("h", "H", "?"))
AS_IT_IS = Control("0", "already right", ("ArrowUp", "w", "W", " "), (0.0,), "asked")
PAIR = (
    Control("first", "A is better", ("a", "A", "ArrowLeft"), (-1.0,), "left"),
    Control("same", "no difference", AS_IT_IS.keys, (0.0,)),
    Control("second", "B is better", ("b", "B", "ArrowRight"), (1.0,), "right"),
)
FILMS = Control("film-left", "film of A", ("f", "F")), Control("film-right", "film of B", ("v", "V"))
REST_UNSAID = Control("send", "send, nothing is said of the others", ("Enter",), (UNSAID,))
REST_RIGHT = Control("rest", "send, the others are already right", (" ", "ArrowUp"), (0.0,))
ALL_RIGHT = REST_RIGHT._replace(words="all already right", colour="asked")


def _cases(key: str) -> tuple[str, ...]:
    """Return a key; for a letter, both of its cases."""
    return tuple(dict.fromkeys((key.lower(), key.upper()))) if len(key) == 1 else (key,)


def _spare(space: Space, keys: tuple[str, ...] | str) -> tuple[str, ...]:
    """Return those of `keys` that no cue of the space uses."""
    own = {one for cue in space.cues for key in cue.keys for one in _cases(key)}
    return tuple(key for key in keys if key not in own)


def _keys_of(space: Space, cue: Cue) -> tuple[tuple[str, ...], ...]:
    """Return all keys for "more" and all keys for "less" of a cue."""
    return tuple((*_cases(key), *_spare(space, BESIDE.get(key, ""))) for key in cue.keys) or ((), ())


def _of_cue(number: int, space: Space, one_cue: bool) -> tuple[Control, ...]:
    """Return the controls about one of several cues: parts of an answer or, with `one_cue`, whole answers."""
    cue, others = space.cues[number], [UNSAID] * len(space.cues)
    sides = zip(("more", "less"), (1.0, -1.0), ("left", "right"), cue.words, _keys_of(space, cue), strict=True)
    more, less = (
        Control(f"pick-{number}-{way}", words, keys, (h,), colour, number) for way, h, colour, words, keys in sides
    )
    if one_cue:
        whole = lambda one: (*others[:number], *(one.answer or ()), *others[number + 1 :])  # noqa: E731
        return tuple(one._replace(name=one.name.replace("pick", "only"), answer=whole(one)) for one in (more, less))
    right = Control(f"pick-{number}-right", "already right", (), (0.0,), "asked", number)
    return more, right, less, Control(f"pick-{number}-unsaid", "not said", (), (UNSAID,), "", number)


def answers(form: AnswerForm, space: Space, one_cue: bool = False) -> tuple[Control, ...]:
    """Return the controls that give an answer, in the order of their buttons; empty for an answer by pointing.

    `one_cue`: where the space has several cues, one press about one cue is the whole answer.
    """
    if form.by_eps and len(space.cues) == 1:
        words = WALKED if space == DIRECTIONS else space.cues[0].words
        more, less = _keys_of(space, space.cues[0])
        right = AS_IT_IS._replace(keys=_spare(space, AS_IT_IS.keys))
        return Control("+1", words[0], more, (1.0,), "left"), right, Control("-1", words[1], less, (-1.0,), "right")
    if form.by_eps:
        numbers = [number for number, cue in enumerate(space.cues) if cue.is_asked]
        about_cues = (control for number in numbers for control in _of_cue(number, space, one_cue))
        whole = (ALL_RIGHT,) if one_cue else (REST_RIGHT, REST_UNSAID)
        return (*about_cues, *(control._replace(keys=_spare(space, control.keys)) for control in whole))
    if form.second is not None:
        return PAIR
    if form.values is None:
        return ()
    values = form.values(space)
    if set(values) == {0.0, 1.0}:
        no = Control("no", "no", ("ArrowLeft", "n", "N"), (0.0,))
        return no, Control("yes", "yes", ("ArrowRight", "y", "Y"), (1.0,))
    return tuple(
        Control(f"value-{place}", f"{value:g}", (str(place),), (value,)) for place, value in enumerate(values, start=1)
    )


def controls(
    form: AnswerForm, space: Space, one_cue: bool = False, films: bool = True, simulated: bool = True
) -> dict[str, Control]:
    """Return all controls by name; an answer's key is removed from every other control.

    `films`: whether the task films a situation. `simulated`: whether it can film the outcome of any action.
    """
    result = {control.name: control for control in answers(form, space, one_cue)}
    own_keys = {key for control in result.values() for key in control.keys}
    of_actions = FILMS if form.second is not None else (FILM,)
    for control in (UNSURE, UNDO, *of_actions * films, *[CORRECTED] * (films and simulated), HELP):
        result[control.name] = control._replace(keys=tuple(key for key in control.keys if key not in own_keys))
    return result


def check(form: AnswerForm, space: Space) -> None:
    """Raise UserError for answers that the page does not support in a space, or two cues with one key."""
    if form.is_action and space != DIRECTIONS:
        raise UserError(f"the page supports {form.name} answers only for directions: give --guidance relative")
    if form.by_eps and not space.cues:
        raise UserError(f"the space {space.name} has no cues to ask about: give --guidance scalar")
    keys = [key for control in answers(form, space) for key in control.keys]
    if twice := [key for key in keys if keys.count(key) > 1]:
        raise UserError(f"the key {key_words(twice[0])!r} stands for two answers: give the space's cues different keys")


def question(form: AnswerForm, space: Space) -> str:
    """Return the question that the page asks."""
    planar = space == DIRECTIONS
    if form.second is not None:
        return "Which is better, A or B?"
    if form.by_eps:
        return "Which way should the middle arrow turn?" if planar else "Which way should the action change?"
    if form.is_action:
        return "Point at what to do instead: click there."
    if set(form.values(space) if form.values else ()) == {0.0, 1.0}:
        return f"Is the {'arrow' if planar else 'action'} good?"
    return f"Your answer? ({form.meaning(space)})"


def help_lines(form: AnswerForm, space: Space, entries: Iterable[Control]) -> list[str]:
    """Return the lines of the page's help about these controls."""
    entries, lines = list(entries), []
    for one in entries:
        name = f"{space.cues[one.cue].name}: " if one.cue is not None else ""
        lines += [f"{name}{one.words}: {', '.join(dict.fromkeys(map(key_words, one.keys)))}"] if one.keys else []
    if form.by_eps and space == DIRECTIONS:
        lines.append(
            "Left and right are meant for somebody who walks along the arrow: left turns it counterclockwise. "
            "Two arrows in the picture show both turns, each in the colour of its button and with its key."
        )
    if any(one.picks for one in entries):
        lines.append("Say which way each cue should change, then send. An answer about no cue counts as: don't know.")
    elif form.by_eps and len(space.cues) > 1:
        lines.append("Say what comes to mind first: one press is the answer. Nothing is said of the other cues.")
    return [
        *lines,
        "Each answer is saved before the next question shows. Where you cannot tell, say so: that costs nothing.",
        "A key pressed while no question is ready is ignored, and the page says so.",
    ]


def answer_of(
    space: Space, control: Control | None, angle_deg: float | None, parts: Mapping[int, float]
) -> np.ndarray | None:
    """Return the answer in the form's encoding, (width,); None for "don't know".

    Without a `control` the answer is the direction pointed at [deg]. `parts` maps a cue's index to the part of
    the answer chosen for it.
    """
    if control is None:
        assert angle_deg is not None
        return np.array([np.cos(np.deg2rad(angle_deg)), np.sin(np.deg2rad(angle_deg))], np.float32)
    if control.answer is None:
        return None
    if control.name not in (REST_RIGHT.name, REST_UNSAID.name):  # these two complete the parts chosen so far
        return np.asarray(control.answer, np.float32)
    rest = [control.answer[0] if cue.is_asked else UNSAID for cue in space.cues]
    answer = np.array([parts.get(number, value) for number, value in enumerate(rest)], np.float32)
    return None if (answer == UNSAID).all() else answer


def outcomes(form: AnswerForm, space: Space, action: np.ndarray, eps: float) -> dict[str, np.ndarray]:
    """Return the asked action ("asked") and, for a single cue, each answer's outcome ("left", "right")."""
    result = {"asked": action}
    if form.by_eps and len(space.cues) == 1:
        for name, h in (("left", 1.0), ("right", -1.0)):
            result[name] = np.asarray(space.toward(jnp.asarray(action), jnp.array([h]), space.from_unit(eps)))
    return result
