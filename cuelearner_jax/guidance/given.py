"""Labels that were given elsewhere, by a file or as arrays: do they make sense to who is to learn from them?"""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np

from cuelearner_jax.environment import Spaces
from cuelearner_jax.errors import UserError
from cuelearner_jax.guidance.bundle import AnswerForm
from cuelearner_jax.types import Label

ACTION_ERROR = 1e-3  # by which an entry of an action may miss it


def check(labels: Label, spaces: Spaces, form: AnswerForm, named: str = "the labels") -> None:
    """Whether labels are such as a teacher could have given.

    Args:
        labels: rows (labels, ...) of arrays.
        spaces: of the environment.
        form: of their answers.
        named: what a message calls them.

    Raises:
        UserError: a shape is another, a number is not finite, an action is none, an answer is none of the form, a
            strength is no angle.
    """
    rows = {"observations": labels.obs, "actions": labels.action, "answers": labels.answer}
    widths = {"observations": spaces.obs_size, "actions": spaces.actions.size, "answers": form.width}
    for name, values in rows.items():
        if values.ndim != 2 or values.shape[1] != widths[name]:
            raise UserError(f"{named}: {name} have the shape {values.shape}, (labels, {widths[name]}) is needed")
        if not np.isfinite(values).all():
            raise UserError(f"{named}: {name} hold numbers that are not finite: leave these labels out")
    own = np.asarray(1.0 if labels.eps_deg is None else labels.eps_deg)
    if not ((own > 0) & (own <= 180)).all():
        raise UserError(f"{named}: strengths are no angles above 0 and up to 180: leave these labels out")
    for name in ("actions", "answers") if form.is_action else ("actions",):
        action = np.asarray(rows[name])
        # The one action space there is has unit vectors; retract leaves an action of any as it is.
        if np.abs(np.asarray(spaces.actions.retract(jnp.asarray(action))) - action).max(initial=0.0) > ACTION_ERROR:
            raise UserError(f"{named}: {name} are no unit vectors: divide each by its length")
    if form.values is not None and not np.isin(labels.answer, form.values).all():
        values = ", ".join(f"{value:g}" for value in form.values)
        raise UserError(f"{named}: an answer is none of {values} ({form.meaning})")
