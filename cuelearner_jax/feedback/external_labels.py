"""Check labels from a file or from arrays before a model learns from them."""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
import numpy as np

from cuelearner_jax.environment import Spaces
from cuelearner_jax.errors import UserError
from cuelearner_jax.feedback.answers import AnswerForm
from cuelearner_jax.spaces import Box, Space
from cuelearner_jax.storage.label_files import LabelFile
from cuelearner_jax.types import Label

ACTION_ERROR = 1e-3  # largest error of an entry of an action; in a box, of half its range


def action_error(space: Space) -> Any:
    """Return the largest error of each entry of an action of a space."""
    return ACTION_ERROR * (np.subtract(space.high, space.low) / 2 if isinstance(space, Box) else 1.0)


def check_file(file: LabelFile, spaces: Spaces | None, form: AnswerForm | None, source: str) -> None:
    """Check that a file's labels, called `source` in messages, fit an environment and a form of answers, as `check`.

    `spaces`: None for observations of any size and the file's own space of actions.
    """
    if form is not None and form.by_eps and file.eps is None:
        raise UserError(f"{source} does not name the strength (eps) of its {form.name} answers: write the file again")
    check(file.labels, spaces or Spaces(file.labels.obs.shape[1], file.space), form, source)


def check(labels: Label, spaces: Spaces, form: AnswerForm | None, source: str = "the labels") -> None:
    """Raise UserError unless labels (labels, ...) fit an environment's spaces and a form of answers.

    `form`: None if it is unknown; answers are then only checked to be finite.
    """
    rows = {"observations": labels.obs, "actions": labels.action, "answers": labels.answer}
    width = labels.answer.shape[-1] if form is None else form.width(spaces.actions)
    widths = {"observations": spaces.obs_size, "actions": spaces.actions.size, "answers": width}
    for name, values in rows.items():
        if values.ndim != 2 or values.shape[1] != widths[name]:
            raise UserError(f"{source}: {name} have the shape {values.shape}: give (labels, {widths[name]})")
        _refuse(~np.isfinite(values), f"{source}: {name} hold numbers that are not finite", "leave these labels out")
    ends_in_action = form is not None and (form.is_action or form.second is not None)
    for name in ("actions", "answers") if ends_in_action else ("actions",):
        action = np.asarray(rows[name])[:, -spaces.actions.size :]
        space = spaces.actions
        off = np.abs(np.asarray(space.retract(jnp.asarray(action))) - action) > action_error(space)
        _refuse(off, f"{source}: {name} are no {space.about}", f"the space {space.name} gives the nearest by `retract`")
    if form is not None and form.values is not None:
        values = form.values(spaces.actions)
        names = ", ".join(f"{value:g}" for value in values)
        wrong = ~np.isin(form.choice(labels.answer), values)
        _refuse(wrong, f"{source}: an answer is none of {names}", f"each means {form.meaning(spaces.actions)}")


def _refuse(wrong: np.ndarray, reason: str, remedy: str) -> None:
    """Raise UserError if an entry of any label is wrong: (labels, ...)."""
    if len(rows := np.flatnonzero(wrong.reshape(len(wrong), -1).any(axis=1))):
        raise UserError(f"{reason} ({len(rows)} of {len(wrong)} labels, the first is number {rows[0] + 1}): {remedy}")
