"""Guidance that learns what to add to an action, in units of eps, and adds it until nothing moves (paper, Eqs. 2 to 4).

The kinds that are made of it differ by what is answered, and by what the network is to predict of an answer.
"""

from __future__ import annotations

from functools import partial
from typing import Any

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from cuelearner_jax.config import GuideScalars, GuideSizes
from cuelearner_jax.environment import Spaces
from cuelearner_jax.feedback.forms import AnswerForm
from cuelearner_jax.guides import turning
from cuelearner_jax.guides.bundle import Guidance, TargetFunction
from cuelearner_jax.guides.fitting import fit_least_squares, lessons
from cuelearner_jax.guides.model import residual_model
from cuelearner_jax.guides.questions import about_refined
from cuelearner_jax.guides.refining import Refined, refine
from cuelearner_jax.types import GuidanceModel, Label


def correcting(
    name: str,
    form: AnswerForm,
    target: TargetFunction,
    sizes: GuideSizes,
    spaces: Spaces,
) -> Guidance:
    """The bundle of a kind.

    Args:
        name: of the kind.
        form: what is answered.
        target: the correction of an action that an answer asks for; the network predicts it in units of eps, so that a
            small eps fits as easily as a large one.
        sizes: of the network and its fitting.
        spaces: the environment's.
    """
    if sizes.sees_turn:
        return turning.correcting(name, form, target, sizes, spaces)
    network = residual_model(sizes, spaces)

    def init(key: PRNGKeyArray) -> GuidanceModel:
        return GuidanceModel(network.init(key), jnp.array(False))

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
            space=spaces.actions,
            tau=scalars.radians("tau"),
            tau_max=scalars.radians("tau_max"),
            k_max=scalars.k_max,
        )

    return Guidance(name, form, init, about_refined(act), target, fit, act, network.disagreement)
