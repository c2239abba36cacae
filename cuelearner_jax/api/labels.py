"""Relative labels as arrays, and as the rows that a fit takes."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Float

from cuelearner_jax.api.worlds import numbers
from cuelearner_jax.errors import UserError
from cuelearner_jax.feedback import external_labels
from cuelearner_jax.feedback.answers import RELATIVE
from cuelearner_jax.spaces import is_answered
from cuelearner_jax.storage import label_files
from cuelearner_jax.storage.label_files import LabelFile
from cuelearner_jax.types import Label


class Labels(NamedTuple):
    """Labels as arrays: observations, the actions asked about, and the answers."""

    obs: Float[np.ndarray, "labels obs"]
    action: Float[np.ndarray, "labels action"]  # directions: unit vectors
    # h: of directions +1 counterclockwise ("more to the left"), 0 already right, -1 clockwise; (labels, cues) where a
    # space has several cues, `spaces.UNSAID` for a cue of which nothing was said
    answer: Float[np.ndarray, "labels *cues"]


def labels_of(rows: Label) -> Labels:
    """Return a lane's valid labels as arrays."""
    arrays = jax.device_get(rows)
    obs, action, answer = (np.asarray(part)[arrays.valid] for part in (arrays.obs, arrays.action, arrays.answer))
    return Labels(obs, action, answer[:, 0] if answer.shape[1] == 1 else answer)


def rows_of(labels: Labels) -> Label:
    """Return labels as rows (labels, ...) of finite floats, without those that say nothing of any cue.

    Raises UserError unless they are three arrays of one length.
    """
    if len(labels) != len(Labels._fields):
        raise UserError(f"labels are {len(labels)} arrays: give observations, actions and answers")
    obs, action, answer = (numbers(f"labels.{name}", part) for name, part in zip(Labels._fields, labels, strict=True))
    if not (obs.size and obs.ndim == action.ndim == 2 and obs.shape[:1] == action.shape[:1] == answer.shape[:1]):
        raise UserError(
            f"labels have shapes {obs.shape}, {action.shape}, {answer.shape}: give observations (n, obs), "
            "actions (n, action) and answers (n,), or (n, cues) where there are several"
        )
    answer = answer[:, None] if answer.ndim == 1 else answer
    has_answer = np.asarray(is_answered(answer).any(-1))
    if not has_answer.any():
        raise UserError("labels say nothing of any cue: give labels with answers")
    return Label(obs[has_answer], action[has_answer], answer[has_answer], np.ones(has_answer.sum(), bool))  # pyright: ignore[reportArgumentType]


def labels_from_file(path: Path) -> LabelFile:
    """Return the labels of a file, of all its seeds. Raises UserError for a file of other answers."""
    file = label_files.read(path)
    if file.answers != RELATIVE.name:
        raise UserError(f"{path} holds {file.answers} answers: give a file of {RELATIVE.name} ones")
    external_labels.check_file(file, None, RELATIVE, str(path))
    return file
