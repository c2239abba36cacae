"""Action spaces: directions in the plane, boxes, choices."""

from __future__ import annotations

from typing import Any

# ruff: noqa: F401 (what other modules import from here)
from cuelearner_jax.errors import UserError
from cuelearner_jax.spaces.box import Box, cues_from
from cuelearner_jax.spaces.choices import Choices
from cuelearner_jax.spaces.directions import DIRECTIONS
from cuelearner_jax.spaces.space import SPACES, UNSAID, Cue, Space, is_answered, says_something


def from_json(about: Any) -> Space:
    """Return the space that a file describes (`Space.to_json`), of a class that has been imported.

    Raises ValueError for a description of no known space.
    """
    try:
        cues = tuple(Cue(cue["name"], tuple(cue["words"]), tuple(cue["keys"]), cue["unit"]) for cue in about["cues"])
        space = SPACES[about["name"]].of_json(about, cues)
    except (KeyError, TypeError, AttributeError, UserError) as error:
        raise ValueError("the description of its space of actions makes no sense, or is of unknown code") from error
    if space.to_json() != about:
        raise ValueError("its space of actions is unknown to this program")
    return space
