"""Deep COACH and BD-COACH as corrections of a finished policy, which begin at nothing: for comparison with adaptation.

Source: Perez-Dattari et al. (ISER 2018), see `cuelearner_jax/guides/dcoach.py`. There the policy that is corrected is
one network, which would begin at random where a finished policy is at hand. So the network is what is added to that
policy's action. Its last layer begins at zero: before the first correction the policy stays what it was.

They are kinds of guidance, so the program of adaptation runs them as it runs relative feedback; on the command line
they are `_coach:CoachedCorrection` and `_coach:BatchCoachedCorrection`, with this folder on the path of Python.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from cuelearner_jax.config import GuideScalars
from cuelearner_jax.guides import bdcoach, dcoach
from cuelearner_jax.guides.fitting import Example
from cuelearner_jax.guides.refining import Refinement
from cuelearner_jax.types import GuidanceModel, Label, Params


class CoachedCorrection(dcoach.DeepCoach):
    """A correction of the base policy's action, moved by each label; labels keep that action (`base`)."""

    name, sees_base = "dcoach-correction", True
    about = "a correction moved by each label, which begins at nothing"

    @property
    def looks_again(self) -> bool:
        """No: a correction is of the base's own action alone."""
        return False

    def init(self, key: PRNGKeyArray) -> GuidanceModel:
        """A correction of nothing."""
        model = super().init(key)
        last = f"Dense_{len(self.sizes.feedback_layers)}"

        def zeroed(path: Any, leaf: Array) -> Array:
            return jnp.zeros_like(leaf) if any(getattr(part, "key", None) == last for part in path) else leaf

        policy = jax.tree_util.tree_map_with_path(zeroed, model.params.policy)
        return model.replace(params=model.params.replace(policy=policy))

    def predict(
        self, env: Any, params: Params, obs: Float[Array, "n obs"], actions: Float[Array, "n action"]
    ) -> Float[Array, "n action"]:
        """The corrected actions of a base policy that does `actions`."""
        return actions + self.network.predict(env, params, obs, actions)

    def examples(self, labels: Label, scalars: GuideScalars) -> Example:
        """Labels (slots, ...) with their targets, seen from what the base policy did."""
        assert labels.base is not None  # `asking` keeps it for a kind that `sees_base`
        return super().examples(labels, scalars).replace(action=labels.base)

    def refine_labelled_actions(
        self, model: GuidanceModel, env: Any, labels: Label, active: Bool[Array, " n"], scalars: GuideScalars
    ) -> Refinement:
        """Return the corrected policy's actions in the situations of labels (n, ...)."""
        assert labels.base is not None
        return self.act(model, env, labels.obs, labels.base, active, scalars)


class BatchCoachedCorrection(CoachedCorrection, bdcoach.BatchCoach):
    """A correction moved by a model of the teacher, which is asked about the corrected actions."""

    name = "bdcoach-correction"
    about = "a correction moved by a model of the teacher, which begins at nothing"
