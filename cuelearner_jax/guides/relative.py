"""The paper's method: a model of relative feedback ("more left", "more right") that refines the agent's actions."""

from __future__ import annotations

from jaxtyping import Array, Float

from cuelearner_jax.config import GuideScalars, GuideSizes
from cuelearner_jax.environment import Spaces
from cuelearner_jax.feedback.answers import RELATIVE
from cuelearner_jax.guides.bundle import Guidance
from cuelearner_jax.guides.correcting import correcting
from cuelearner_jax.guides.kind import Kind
from cuelearner_jax.types import Label


def make(sizes: GuideSizes, spaces: Spaces) -> Guidance:
    """The bundle for an environment's spaces."""

    def target(label: Label, scalars: GuideScalars) -> Float[Array, " action"]:
        """Eq. 3's eps * h as a vector: the action turned by h * eps, less the action."""
        return spaces.actions.toward(label.action, label.answer[0], scalars.radians("eps")) - label.action

    return correcting("relative", RELATIVE, target, sizes, spaces)


KIND = Kind("relative", "a model of the teacher's relative feedback", make, form=RELATIVE, colour="#0072B2")
