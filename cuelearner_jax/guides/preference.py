"""Guidance by preferences: a utility of actions, fitted to which of two actions is better; its argmax acts.

Source: the Bradley-Terry model of paired comparisons (Bradley, Terry, "Rank analysis of incomplete block designs",
Biometrika 1952), as Christiano et al., "Deep reinforcement learning from human preferences" (2017), fit it to people's
choices: "no difference" counts half for either side. They compare clips of some steps, and learn a reward for an agent
to maximise. Here a pair is two actions in one situation, and the utility's argmax acts. For a label (s, a, b, c), where
c is -1 if a is better, 1 if b is better and 0 without a difference, in any space:

    P(b over a) = sigmoid(u(s, b) - u(s, a)),   p = (1 + c) / 2
    u = argmax over f of sum over labels of p log P(b over a) + (1 - p) log P(a over b)
    a <- argmax over `space.spread(guide_directions)` of u(s, a)

As for `scalar`, a is the guide's own action, or a base action in a share `explored_fraction` of the questions; b is
drawn around a (`answers.draw_second`).
"""

from __future__ import annotations

from typing import Any

import jax
from jaxtyping import Array, Float

from cuelearner_jax.config import GuideScalars
from cuelearner_jax.feedback.answers import PREFERENCE
from cuelearner_jax.guides.fitting import Example
from cuelearner_jax.guides.scalar import Scalar
from cuelearner_jax.types import Params


class Preference(Scalar):
    """A guide that executes the action of largest utility."""

    name, about = "preference", "a utility of actions by which of two the teacher prefers"
    form, colour, compares = PREFERENCE, "#882255", True

    def losses(self, env: Any, scalars: GuideScalars, params: Params, rows: Example) -> Float[Array, " n"]:
        """Return -log of the probability of each choice by the model of Bradley and Terry."""
        utility = lambda actions: self.network.predict(env, params, rows.obs, actions)[:, 0]  # noqa: E731
        gain, share = utility(rows.target[:, 1:]) - utility(rows.action), (1 + rows.target[:, 0]) / 2
        return -share * jax.nn.log_sigmoid(gain) - (1 - share) * jax.nn.log_sigmoid(-gain)
