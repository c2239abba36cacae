"""Arrays and teachers that callers give: where numbers enter from outside, they are checked once."""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Float

from cuelearner_jax.config import LARGEST_FLOAT
from cuelearner_jax.errors import UserError, format_value
from cuelearner_jax.policies import teaching
from cuelearner_jax.spaces import Space
from cuelearner_jax.types import Teacher


def numbers(name: str, value: Any) -> Float[np.ndarray, "..."]:
    """Return numbers of any shape, all finite in single precision."""
    found = np.asarray(value)
    if found.dtype.kind not in "fiu" and not jnp.issubdtype(found.dtype, jnp.floating):  # NumPy lacks bfloat16's kind
        raise UserError(f"{name} is {format_value(value)}: give an array of real numbers")
    if isinstance(value, np.ma.MaskedArray) and np.ma.getmaskarray(value).any():
        raise UserError(f"{name} is an array with masked numbers: leave these rows out")
    if not (np.abs(found.astype(np.float64)) <= LARGEST_FLOAT).all():
        raise UserError(f"{name} holds numbers that are not finite (in single precision): leave these rows out")
    return found.astype(np.float32)


def observations(value: Any, size: int | None) -> Float[np.ndarray, "*n obs"]:
    """Return one observation (size,) or many (n, size); `size` None: any size above 0."""
    rows = numbers("obs", value)
    width = rows.shape[-1] if size is None and rows.ndim else size
    if rows.ndim not in (1, 2) or rows.shape[-1] != width or not width:
        raise UserError(f"obs: observations have shape {rows.shape}: give ({width},) or (n, {width})")
    return rows


def action(value: Any, space: Space) -> Any:
    """Return one action, which may be traced."""
    if isinstance(value, Tracer):
        return value
    found = numbers("action", value)
    if found.shape != (space.size,) or not space.usable(found, np):
        example = np.asarray(space.spread(4))[0].round(2).tolist()
        raise UserError(
            f"action is {format_value(value)}: give an action of shape ({space.size},), for instance {example}"
        )
    return found


def teacher_of_world(value: Any, space: Space) -> Teacher:
    """Return a teacher: the given one, or one that shows what a given policy does itself."""
    if not callable(getattr(value, "best_action", None)):
        value = getattr(value, "policy", value)  # a `CallablePolicy`, which is above this module
    return teaching(value, space)
