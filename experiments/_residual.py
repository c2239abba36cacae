"""The correction itself, learned from optimal actions: what the paper compares adaptation with.

Source: paper, section V-B ("residual learning": learning to directly predict the needed correction from optimal
corrective demonstrations, within the same bound). The teacher shows what it would have done instead of an action; the
network is fitted to the way from the one to the other, cut off at `scalars.tau_max_deg` and in units of
`scalars.eps_deg` (give the bound for both). With `scalars.k_max` 1 it is applied once;
more passes correct what it has made of the action, about which questions are from the second round on (DAgger, see
`scalars.refined_fraction`).

It is a kind of guidance, so the program of adaptation runs it as it runs relative feedback; on the command line it is
named as `_residual:Residual`, with this folder on the path of Python.
"""

from __future__ import annotations

from jaxtyping import Array, Float

from cuelearner_jax.config import GuideScalars
from cuelearner_jax.feedback.answers import DEMONSTRATION
from cuelearner_jax.guides.relative import Relative
from cuelearner_jax.types import Label


class Residual(Relative):
    """A guide that learns the difference between the teacher's action and the action asked about."""

    name, about = "residual", "the correction itself, from optimal actions"
    form, colour = DEMONSTRATION, "#D55E00"

    def target(self, label: Label, scalars: GuideScalars) -> Float[Array, " action"]:
        """Return the correction to the teacher's action, clipped at the bound."""
        space = self.spaces.actions
        return space.clip(label.answer, label.action, space.from_unit(scalars.tau_max_deg)) - label.action
