"""The paper's method: a model phi(s, a) of relative feedback ("more left", "more right") that refines actions.

Source: paper, Eqs. 2 to 5, written with `log` and `exp` of the space, so that they hold in boxes of any size, for
directions and for choices in a row. Of a label (s, a, h), h of each cue in {-1, 0, 1} or not said:

    y = exp(a, eps h) - a                                                        (`target`; h of an unsaid cue is 0)
    phi = argmin over f of sum over labels, and cues of which they speak, of (d log (f(s, a) - y))^2        (`fit`)
    a <- clip(retract(a + phi(s, a)), a_0, tau_max), until a pass moves a by less than tau, K_max passes at most (`act`)

The network predicts corrections in units of eps, so that a small eps fits as easily as a large one. A cue of which
nothing was said adds no loss: "not said" is no "right". Only a cue that no label names counts as no change.
"""

from __future__ import annotations

from typing import Any

from cuelearner_jax.config import GuideScalars
from cuelearner_jax.feedback.answers import RELATIVE
from cuelearner_jax.guides.base import Guide, Rows
from cuelearner_jax.guides.fitting import Example
from cuelearner_jax.guides.refining import Refinement
from cuelearner_jax.types import Action, Actions, GuidanceModel, Label, Observations


class Relative(Guide):
    """A guide that corrects actions until a pass no longer moves them."""

    name, about = "relative", "a model of the teacher's relative feedback"
    form, colour = RELATIVE, "#0072B2"

    def target(self, label: Label, scalars: GuideScalars) -> Action:
        """Return eps * h of Eq. 3 as a vector: the action changed by h * eps along each cue, less the action."""
        space = self.spaces.actions
        return space.toward(label.action, label.answer, space.from_unit(scalars.eps_deg)) - label.action

    def examples(self, labels: Label, scalars: GuideScalars) -> Example:
        """Return labels (slots, ...) with their targets in units of eps."""
        rows = super().examples(labels, scalars)
        return rows.replace(target=rows.target / self.spaces.actions.from_unit(scalars.eps_deg))

    def act(
        self, model: GuidanceModel, env: Any, obs: Observations, actions: Actions, active: Rows, scalars: GuideScalars
    ) -> Refinement:
        """Refine active rows with a fitted model by Eq. 4: a <- a + phi(s, a)."""
        eps = self.spaces.actions.from_unit(scalars.eps_deg)

        def phi(current: Actions) -> Actions:
            return eps * self.predict(env, model.params, obs, current)

        return self.refined(phi, actions, active & model.fitted, scalars)
