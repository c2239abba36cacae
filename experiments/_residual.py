"""The correction itself, learned from optimal actions: what the paper compares adaptation with.

Source: paper, section V-B ("residual learning": learning to directly predict the needed correction from optimal
corrective demonstrations, within the same bound). The teacher shows what it would have done instead of an action; the
network is fitted to the way from the one to the other, cut off at `scalars.tau_max_deg` and in units of
`scalars.eps_deg` (give the bound for both). With `scalars.k_max` 1 it is applied once;
more passes correct what it has made of the action, about which questions are from the second round on (DAgger, see
`scalars.refined_fraction`).

It is a kind of guidance, so the program of adaptation runs it as it runs relative feedback; on the command line it is
named as `_residual:KIND`, with this folder on the path of Python.
"""

from __future__ import annotations

from jaxtyping import Array, Float

from cuelearner_jax.config import GuideScalars, GuideSizes
from cuelearner_jax.environment import Spaces
from cuelearner_jax.feedback.answers import DEMONSTRATION
from cuelearner_jax.guides.bundle import Guidance
from cuelearner_jax.guides.correcting import correcting
from cuelearner_jax.guides.kind import Kind
from cuelearner_jax.types import Label


def make(sizes: GuideSizes, spaces: Spaces) -> Guidance:
    """The bundle for an environment's spaces."""
    space = spaces.actions

    def target(label: Label, scalars: GuideScalars) -> Float[Array, " action"]:
        """The needed correction, cut off at the bound."""
        return space.clip(label.answer, label.action, scalars.radians("tau_max")) - label.action

    return correcting("residual", DEMONSTRATION, target, sizes, spaces)


KIND = Kind("residual", "the correction itself, from optimal actions", make, form=DEMONSTRATION, colour="#D55E00")
