"""Relative feedback for adaptation: a correction that depends on the action's offset from the finished policy's.

In a changed world a finished policy is often wrong by the same offset everywhere. A few labels determine such an
offset, but not a network of the situation. So a correction has two parts. The first depends on the offset alone: a
smoothing spline (Eilers, Marx, "Flexible smoothing with B-splines and penalties", Statistical Science 1996). The second
is a network of offset, situation and action, fitted to the spline's residuals. Held-out labels set the network's weight
(stacked regressions: Breiman, Machine Learning 1996); the weight is zero where the network does not predict them
better.

With a_0 the policy's action, t = log(a_0, a) / eps the offset so far along each cue, m_c a spline for each cue c:

    m_c = argmin over m of sum over labels that speak of c of (h_c - m(t_c))^2 + ROUGHNESS |m''|^2 + RIDGE |m|^2
    phi(s, a) = exp(a, eps m(t)) - a + eps w f(s, a, t),   w in [0, 1] the share of the network f
    a <- clip(retract(a + phi(s, a)), a_0, tau_max), until a pass moves a by less than tau, K_max passes at most
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, partial
from typing import Any

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from cuelearner_jax.config import GuideScalars
from cuelearner_jax.feedback.answers import RELATIVE
from cuelearner_jax.guides.base import Guide, Kind
from cuelearner_jax.guides.fitting import Lesson, along_cues, fit_least_squares, held_out
from cuelearner_jax.guides.model import GuideModel, guide_model
from cuelearner_jax.guides.refining import Refinement
from cuelearner_jax.guides.relative import Relative
from cuelearner_jax.spaces import Space
from cuelearner_jax.types import GuidanceModel, Label, Params

KNOTS = 13  # evenly spaced, from the largest turn that was asked about on one side to that on the other
ROUGHNESS = 3.0  # penalty on the spline's squared second differences, in squared errors of labels
RIDGE = 0.3  # penalty on its squared heights, which keeps unlabelled offsets uncorrected


class Spline(struct.PyTreeNode):
    """A function of the turn: straight lines between knots, level beyond them. Of several cues each has its own."""

    heights: Float[Array, "*cues knots"]  # corrections in units of eps; for directions counterclockwise
    reach: Float[Array, "*cues"]  # offset of the outermost knots, in units of eps


class TwoParts(struct.PyTreeNode):
    """The spline and the network of a correction, as the parameters of a model."""

    spline: Spline
    network: Params
    share: Float[Array, ""]  # weight of the network, from 0 to 1


def accumulated_turn(
    space: Space, first: Float[Array, "n action"], actions: Float[Array, "n action"], eps: Float[Array, ""]
) -> Float[Array, "n cues"]:
    """Return how far actions lie from the policy's own along each cue, in units of eps."""
    return space.log(first, actions) / eps


def _hats(turns: Float[Array, " n"], reach: Float[Array, ""]) -> Float[Array, "n knots"]:
    """Return the weight of each knot at each offset; the weights add up to 1."""
    place = (jnp.clip(turns / reach, -1, 1) + 1) * (KNOTS - 1) / 2
    return jnp.maximum(0.0, 1.0 - jnp.abs(place[:, None] - jnp.arange(KNOTS)[None]))


def height(spline: Spline, turns: Float[Array, " n"]) -> Float[Array, " n"]:
    """Return the spline's correction at each offset, in units of eps."""
    return _hats(turns, spline.reach) @ spline.heights


def fit_spline(turns: Float[Array, " n"], wanted: Float[Array, " n"], valid: Bool[Array, " n"]) -> Spline:
    """Return the spline with the least penalised squared error.

    Args:
        turns: offsets of the actions asked about, in units of eps.
        wanted: corrections that the answers ask for, in units of eps, counterclockwise.
        valid: rows that count.
    """
    reach = jnp.maximum(jnp.max(jnp.abs(turns), where=valid, initial=0.0), 1.0)
    hats = _hats(turns, reach) * valid[:, None]
    bends = jnp.diff(jnp.eye(KNOTS), n=2, axis=0)
    normal = hats.T @ hats + ROUGHNESS * bends.T @ bends + RIDGE * jnp.eye(KNOTS)
    return Spline(jnp.linalg.solve(normal, hats.T @ jnp.where(valid, wanted, 0.0)), reach)


def fit_splines(turns: Float[Array, "n cues"], wanted: Float[Array, "n cues"], counts: Bool[Array, "n cues"]) -> Spline:
    """Return a spline for each cue, by `fit_spline`; with one cue there is no axis of cues."""
    if turns.shape[1] == 1:
        return fit_spline(turns[:, 0], wanted[:, 0], counts[:, 0])
    return jax.vmap(fit_spline, 1)(turns, wanted, counts)


def heights_of(spline: Spline, turns: Float[Array, "n cues"]) -> Float[Array, "n cues"]:
    """Return each cue's spline correction (`height`)."""
    if turns.shape[1] == 1:
        return height(spline, turns[:, 0])[:, None]
    return jax.vmap(height, (0, 1), 1)(spline, turns)


def vectors(
    space: Space, heights: Float[Array, "n cues"], actions: Float[Array, "n action"], eps: Float[Array, ""]
) -> Float[Array, "n action"]:
    """Return corrections in units of eps as vectors to add to actions."""
    return (space.exp(actions, heights * eps) - actions) / eps


def share_of(
    left: Float[Array, "n action"], predicted: Float[Array, "n action"], valid: Bool[Array, " n"]
) -> Float[Array, ""]:
    """Return the weight in [0, 1] that scales predictions nearest to the residuals, by least squares."""
    product = jnp.sum(jnp.sum(left * predicted, -1), where=valid)
    size = jnp.sum(jnp.sum(jnp.square(predicted), -1), where=valid)
    return jnp.clip(product / jnp.where(size > 0, size, 1.0), 0, 1)


@dataclass(frozen=True)
class Offset(Relative):
    """A guide that corrects actions by their offset from the policy's own, which its labels keep (`base`).

    The members' disagreement is computed at zero offset.
    """

    @cached_property
    def network(self) -> GuideModel:
        """The network, or ensemble, whose inputs are the offset, the situation and the action."""
        return guide_model(self.sizes, self.spaces, beside=self.cues)

    @property
    def cues(self) -> int:
        """Number of cues, along each of which an action may be offset."""
        return len(self.spaces.actions.cues)

    def init(self, key: PRNGKeyArray) -> GuidanceModel:
        """Return a model that corrects nothing."""
        each = () if self.cues == 1 else (self.cues,)
        spline = Spline(jnp.zeros((*each, KNOTS)), jnp.ones(each))
        return GuidanceModel(TwoParts(spline, self.network.init(key), jnp.zeros(())), jnp.array(False))

    def fit(
        self, key: PRNGKeyArray, env: Any, labels: Label, former: GuidanceModel, scalars: GuideScalars
    ) -> GuidanceModel:
        """Fit the spline to the training labels, then the network to its residuals, then the network's weight."""
        assert labels.base is not None  # `asking` keeps it for a kind that `sees_base`
        space, rows = self.spaces.actions, Guide.lessons(self, labels, scalars)
        eps = space.from_unit(scalars.eps_deg)
        asked = space.retract(rows.action + rows.target)
        turns = accumulated_turn(space, labels.base, rows.action, eps)
        training = jnp.broadcast_to((rows.valid & ~held_out(len(rows.valid)))[:, None], turns.shape)
        training = training if rows.said is None else training & rows.said
        spline = fit_splines(turns, accumulated_turn(space, rows.action, asked, eps), training)
        left = rows.target / eps - vectors(space, heights_of(spline, turns), rows.action, eps)
        rows = rows.replace(action=jnp.concatenate([rows.action, turns], -1), target=left)
        predict = partial(self.network.predict, env)
        model = fit_least_squares(key, rows, scalars, init=self.network.init, apply=predict, sizes=self.sizes)
        predicted = predict(model.params, rows.obs, rows.action)
        share = share_of(_told(rows, left), _told(rows, predicted), rows.valid & held_out(len(rows.valid)))
        return GuidanceModel(TwoParts(spline, model.params, share), model.fitted)

    def onward(
        self,
        model: GuidanceModel,
        env: Any,
        obs: Float[Array, "n obs"],
        first: Float[Array, "n action"],
        actions: Float[Array, "n action"],
        active: Bool[Array, " n"],
        scalars: GuideScalars,
    ) -> Refinement:
        """Return `act` of `actions` whose uncorrected actions were `first`."""
        space, known = self.spaces.actions, model.params
        eps = space.from_unit(scalars.eps_deg)

        def phi(current: Float[Array, "n action"]) -> Float[Array, "n action"]:
            turns = accumulated_turn(space, first, current, eps)
            seen = jnp.concatenate([current, turns], -1)
            of_turn = vectors(space, heights_of(known.spline, turns), current, eps)
            return eps * (of_turn + known.share * self.network.predict(env, known.network, obs, seen))

        return self.refined(phi, actions, active & model.fitted, scalars)

    def act(
        self,
        model: GuidanceModel,
        env: Any,
        obs: Float[Array, "n obs"],
        actions: Float[Array, "n action"],
        active: Bool[Array, " n"],
        scalars: GuideScalars,
    ) -> Refinement:
        """Return the refinement of a policy's own actions."""
        return self.onward(model, env, obs, actions, actions, active, scalars)

    def refine_labelled_actions(
        self, model: GuidanceModel, env: Any, labels: Label, active: Bool[Array, " n"], scalars: GuideScalars
    ) -> Refinement:
        """Return the refinement of the actions that labels (n, ...) are about, with offsets from the policy's."""
        assert labels.base is not None
        return self.onward(model, env, labels.obs, labels.base, labels.action, active, scalars)

    def disagreement(
        self, model: GuidanceModel, env: Any, obs: Float[Array, "n obs"], actions: Float[Array, "n action"]
    ) -> Float[Array, " n"]:
        """Return the variance of the members' corrections, summed over their entries."""
        seen = jnp.concatenate([actions, jnp.zeros((len(actions), self.cues))], -1)
        return self.network.disagreement(env, model.params.network, obs, seen)


def _told(rows: Lesson, values: Float[Array, "n action"]) -> Float[Array, "n entries"]:
    """Return vectors along the cues that labels name; whole vectors where labels are not about cues."""
    return values if rows.said is None else jnp.where(rows.said, along_cues(rows, values), 0.0)


KIND = Kind(
    "offset",
    "relative feedback for adaptation: corrections by how far an action was turned",
    Offset,
    form=RELATIVE,
    colour="#6A3D9A",
    sees_base=True,
)
