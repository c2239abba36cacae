"""Spaces of actions: directions in the plane, boxes, choices."""

from __future__ import annotations

from typing import Any

from cuelearner_jax.errors import UserError
from cuelearner_jax.spaces.box import Box
from cuelearner_jax.spaces.choices import Choices
from cuelearner_jax.spaces.directions import DIRECTIONS, check_directions
from cuelearner_jax.spaces.space import UNSAID, Cue, Space, said

__all__ = ["DIRECTIONS", "UNSAID", "Box", "Choices", "Cue", "Space", "check_directions", "from_json", "said"]


def from_json(about: Any) -> Space:
    """Return the space that a file describes (`Space.to_json`). Raises ValueError for a description of none."""
    try:
        if about == DIRECTIONS.to_json():
            return DIRECTIONS
        cues = tuple(Cue(cue["name"], tuple(cue["words"]), tuple(cue["keys"]), cue["unit"]) for cue in about["cues"])
        if not all(isinstance(text, str) for cue in cues for text in (cue.name, *cue.words, *cue.keys)):
            raise ValueError("a cue of its space of actions has no name, words or keys")
        kinds = {
            Box.name: lambda: Box(about["low"], about["high"], cues),
            Choices.name: lambda: Choices(about["count"], *cues),
        }
        return kinds[about["name"]]()
    except (KeyError, TypeError, AttributeError, UserError) as error:
        raise ValueError("the description of its space of actions makes no sense") from error
    raise ValueError("its space of actions is none that this program knows")
