"""The paper's method: a model of relative feedback ("more left", "more right") that refines the agent's actions.

The network predicts in units of eps, so that a small eps fits as easily as a large one: phi = eps * network.
"""

from __future__ import annotations

from functools import partial
from typing import Any

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from cuelearner_jax.config import GuideScalars, GuideSizes
from cuelearner_jax.environment import Spaces
from cuelearner_jax.guidance.answers import RELATIVE
from cuelearner_jax.guidance.bundle import Guidance
from cuelearner_jax.guidance.fitting import fit_least_squares, lessons
from cuelearner_jax.guidance.kind import Kind
from cuelearner_jax.guidance.model import residual_model
from cuelearner_jax.guidance.questions import about_refined
from cuelearner_jax.guidance.refining import Refined, refine
from cuelearner_jax.types import GuidanceModel, Label


def make(sizes: GuideSizes, spaces: Spaces) -> Guidance:
    """The bundle for an environment's spaces."""
    space = spaces.actions
    network = residual_model(sizes, spaces)

    def init(key: PRNGKeyArray) -> GuidanceModel:
        return GuidanceModel(network.init(key), jnp.array(False))

    def target(label: Label, scalars: GuideScalars) -> Float[Array, " action"]:
        """Eq. 3's eps * h as a vector: the action turned by h * eps, less the action."""
        return space.toward(label.action, label.answer[0], scalars.radians("eps")) - label.action

    def fit(key: PRNGKeyArray, env: Any, labels: Label, former: GuidanceModel, scalars: GuideScalars) -> GuidanceModel:
        rows = lessons(labels, target, scalars)
        rows = rows.replace(target=rows.target / scalars.radians("eps"))
        predict = partial(network.predict, env)
        return fit_least_squares(key, rows, scalars, init=network.init, apply=predict, sizes=sizes)

    def act(
        model: GuidanceModel,
        env: Any,
        obs: Float[Array, "n obs"],
        actions: Float[Array, "n action"],
        active: Bool[Array, " n"],
        scalars: GuideScalars,
    ) -> Refined:
        return refine(
            lambda current: scalars.radians("eps") * network.predict(env, model.params, obs, current),
            actions,
            active & model.fitted,
            space=space,
            tau=scalars.radians("tau"),
            tau_max=scalars.radians("tau_max"),
            k_max=scalars.k_max,
        )

    return Guidance("relative", RELATIVE, init, about_refined(act), target, fit, act, network.disagreement)


KIND = Kind("relative", "a model of the teacher's relative feedback", make, form=RELATIVE, colour="#0072B2")
