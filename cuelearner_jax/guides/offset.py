"""Relative feedback for adaptation: a correction that depends on how far the action has been turned already.

Of a finished policy in a changed world much is wrong in the same way everywhere, and right once an action has been
turned far enough from what the policy did. A few labels tell that, where no network of the situation can be learned
from them. So a correction has two parts: one of the turn alone, a smoothing spline (Eilers, Marx, "Flexible smoothing
with B-splines and penalties", Statistical Science 1996), and a network's, which sees the turn beside situation and
action and is fitted to what the spline leaves. The network counts as much as held-out labels say that it should
(stacked regressions: Breiman, Machine Learning 1996): by nothing, where it predicts them no better.

With a_0 what the policy did, t = log(a_0, a) / eps the turn so far along each cue, m_c a spline for each cue c:

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
ROUGHNESS = 3.0  # of the spline: what a unit of its squared second differences costs, in squared errors of labels
RIDGE = 0.3  # the same of its squared heights: what nothing was asked about is left alone


class Spline(struct.PyTreeNode):
    """A function of the turn: straight lines between knots, level beyond them. Of several cues each has its own."""

    heights: Float[Array, "*cues knots"]  # in units of eps; of directions counterclockwise
    reach: Float[Array, "*cues"]  # turn of the outermost knots, in units of eps


class TwoParts(struct.PyTreeNode):
    """A correction's two parts, as the parameters of a model."""

    spline: Spline
    network: Params
    share: Float[Array, ""]  # by which the network counts, from 0 to 1


def accumulated_turn(
    space: Space, first: Float[Array, "n action"], actions: Float[Array, "n action"], eps: Float[Array, ""]
) -> Float[Array, "n cues"]:
    """How far actions lie from what they were first along each cue, in units of eps."""
    return space.log(first, actions) / eps


def _hats(turns: Float[Array, " n"], reach: Float[Array, ""]) -> Float[Array, "n knots"]:
    """The weight of each knot at each turn: they add up to 1."""
    place = (jnp.clip(turns / reach, -1, 1) + 1) * (KNOTS - 1) / 2
    return jnp.maximum(0.0, 1.0 - jnp.abs(place[:, None] - jnp.arange(KNOTS)[None]))


def height(spline: Spline, turns: Float[Array, " n"]) -> Float[Array, " n"]:
    """The spline's correction at each turn, in units of eps."""
    return _hats(turns, spline.reach) @ spline.heights


def fit_spline(turns: Float[Array, " n"], wanted: Float[Array, " n"], valid: Bool[Array, " n"]) -> Spline:
    """The spline with the least penalised squared error.

    Args:
        turns: of the actions asked about, in units of eps.
        wanted: corrections that the answers ask for, in units of eps, counterclockwise.
        valid: rows that count.
    """
    reach = jnp.maximum(jnp.max(jnp.abs(turns), where=valid, initial=0.0), 1.0)
    hats = _hats(turns, reach) * valid[:, None]
    bends = jnp.diff(jnp.eye(KNOTS), n=2, axis=0)
    normal = hats.T @ hats + ROUGHNESS * bends.T @ bends + RIDGE * jnp.eye(KNOTS)
    return Spline(jnp.linalg.solve(normal, hats.T @ jnp.where(valid, wanted, 0.0)), reach)


def fit_splines(turns: Float[Array, "n cues"], wanted: Float[Array, "n cues"], counts: Bool[Array, "n cues"]) -> Spline:
    """`fit_spline` for each cue by itself; a spline of one cue has no axis of cues."""
    if turns.shape[1] == 1:
        return fit_spline(turns[:, 0], wanted[:, 0], counts[:, 0])
    return jax.vmap(fit_spline, 1)(turns, wanted, counts)


def heights_of(spline: Spline, turns: Float[Array, "n cues"]) -> Float[Array, "n cues"]:
    """`height` along each cue."""
    if turns.shape[1] == 1:
        return height(spline, turns[:, 0])[:, None]
    return jax.vmap(height, (0, 1), 1)(spline, turns)


def vectors(
    space: Space, heights: Float[Array, "n cues"], actions: Float[Array, "n action"], eps: Float[Array, ""]
) -> Float[Array, "n action"]:
    """Corrections as vectors to be added to actions, in units of eps."""
    return (space.exp(actions, heights * eps) - actions) / eps


def share_of(
    left: Float[Array, "n action"], predicted: Float[Array, "n action"], valid: Bool[Array, " n"]
) -> Float[Array, ""]:
    """The weight from 0 to 1 with which predictions come nearest to what is left, by least squares over valid rows."""
    product = jnp.sum(jnp.sum(left * predicted, -1), where=valid)
    size = jnp.sum(jnp.sum(jnp.square(predicted), -1), where=valid)
    return jnp.clip(product / jnp.where(size > 0, size, 1.0), 0, 1)


@dataclass(frozen=True)
class Offset(Relative):
    """A guide that corrects actions by how far they have been turned; its labels keep what the policy did (`base`).

    Members of an ensemble disagree about actions as if they had not been turned.
    """

    @cached_property
    def network(self) -> GuideModel:
        """The network, or ensemble, that sees the turns beside situation and action."""
        return guide_model(self.sizes, self.spaces, beside=self.cues)

    @property
    def cues(self) -> int:
        """Number of cues, along each of which an action may have turned."""
        return len(self.spaces.actions.cues)

    def init(self, key: PRNGKeyArray) -> GuidanceModel:
        """A model that corrects nothing."""
        each = () if self.cues == 1 else (self.cues,)
        spline = Spline(jnp.zeros((*each, KNOTS)), jnp.ones(each))
        return GuidanceModel(TwoParts(spline, self.network.init(key), jnp.zeros(())), jnp.array(False))

    def fit(
        self, key: PRNGKeyArray, env: Any, labels: Label, former: GuidanceModel, scalars: GuideScalars
    ) -> GuidanceModel:
        """The spline of the training labels, then the network of what it leaves, then the network's share."""
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
        """As `act`, of `actions` that were `first` before anything corrected them."""
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
        """The refinement of a policy's own actions."""
        return self.onward(model, env, obs, actions, actions, active, scalars)

    def refine_labelled_actions(
        self, model: GuidanceModel, env: Any, labels: Label, active: Bool[Array, " n"], scalars: GuideScalars
    ) -> Refinement:
        """The refinement of the actions that labels (n, ...) are about, from what the policy did there."""
        assert labels.base is not None
        return self.onward(model, env, labels.obs, labels.base, labels.action, active, scalars)

    def disagreement(
        self, model: GuidanceModel, env: Any, obs: Float[Array, "n obs"], actions: Float[Array, "n action"]
    ) -> Float[Array, " n"]:
        """Variance of the members' corrections, summed over their entries."""
        seen = jnp.concatenate([actions, jnp.zeros((len(actions), self.cues))], -1)
        return self.network.disagreement(env, model.params.network, obs, seen)


def _told(rows: Lesson, values: Float[Array, "n action"]) -> Float[Array, "n entries"]:
    """Vectors along the cues of which labels speak; the vectors themselves where a label says all that there is."""
    return values if rows.said is None else jnp.where(rows.said, along_cues(rows, values), 0.0)


KIND = Kind(
    "offset",
    "relative feedback for adaptation: corrections by how far an action was turned",
    Offset,
    form=RELATIVE,
    colour="#6A3D9A",
    sees_base=True,
)
