"""What a correction hangs on besides situation and action: how far the action has been turned already.

Of a finished policy in a changed world much is wrong in the same way everywhere, and right once an action has been
turned far enough from what the policy did. A few labels tell that, where no network of the situation can be learned
from them. So a correction has two parts: one of the turn alone, a smoothing spline (Eilers, Marx, "Flexible smoothing
with B-splines and penalties", Statistical Science 1996), and a network's, which sees the turn beside situation and
action and is fitted to what the first part leaves. The network counts as much as held-out labels say that it should
(stacked regressions: Breiman, Machine Learning 1996): by nothing, where it predicts them no better.
"""

from __future__ import annotations

from functools import partial
from typing import Any

import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from cuelearner_jax.actions import Actions
from cuelearner_jax.config import GuideScalars, GuideSizes
from cuelearner_jax.environment import Spaces
from cuelearner_jax.feedback.forms import AnswerForm
from cuelearner_jax.guides.bundle import Guidance, TargetFunction
from cuelearner_jax.guides.fitting import fit_least_squares, held_out, lessons
from cuelearner_jax.guides.model import residual_model
from cuelearner_jax.guides.questions import about_refined
from cuelearner_jax.guides.refining import Refined, refine
from cuelearner_jax.types import GuidanceModel, Label, Params

KNOTS = 13  # evenly spaced, from the largest turn that was asked about on one side to that on the other
ROUGHNESS = 3.0  # of the spline: what a unit of its squared second differences costs, in squared errors of labels
RIDGE = 0.3  # the same of its squared heights: what nothing was asked about is left alone


class Part(struct.PyTreeNode):
    """A function of the turn: straight lines between knots, level beyond them."""

    heights: Float[Array, " knots"]  # in units of eps, counterclockwise
    reach: Float[Array, ""]  # turn of the outermost knots, in units of eps


class TwoParts(struct.PyTreeNode):
    """A correction's two parts, as the parameters of a model."""

    part: Part
    network: Params
    share: Float[Array, ""]  # by which the network counts, from 0 to 1


def nothing(network: Params) -> TwoParts:
    """Parameters of a model that corrects nothing."""
    return TwoParts(Part(jnp.zeros(KNOTS), jnp.ones(())), network, jnp.zeros(()))


def turned(
    space: Actions, first: Float[Array, "n action"], actions: Float[Array, "n action"], eps: Float[Array, ""]
) -> Float[Array, " n"]:
    """How far actions lie from what they were first, counterclockwise, in units of eps."""
    return space.sense(first, actions) * space.distance(first, actions) / eps


def _hats(turns: Float[Array, " n"], reach: Float[Array, ""]) -> Float[Array, "n knots"]:
    """The weight of each knot at each turn: they add up to 1."""
    place = (jnp.clip(turns / reach, -1, 1) + 1) * (KNOTS - 1) / 2
    return jnp.maximum(0.0, 1.0 - jnp.abs(place[:, None] - jnp.arange(KNOTS)[None]))


def height(part: Part, turns: Float[Array, " n"]) -> Float[Array, " n"]:
    """The part's correction at each turn, in units of eps."""
    return _hats(turns, part.reach) @ part.heights


def fitted(turns: Float[Array, " n"], wanted: Float[Array, " n"], valid: Bool[Array, " n"]) -> Part:
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
    return Part(jnp.linalg.solve(normal, hats.T @ jnp.where(valid, wanted, 0.0)), reach)


def vectors(
    space: Actions, heights: Float[Array, " n"], actions: Float[Array, "n action"], eps: Float[Array, ""]
) -> Float[Array, "n action"]:
    """Corrections as vectors to be added to actions, in units of eps."""
    return (space.toward(actions, heights, eps) - actions) / eps


def share_of(
    left: Float[Array, "n action"], predicted: Float[Array, "n action"], valid: Bool[Array, " n"]
) -> Float[Array, ""]:
    """The weight from 0 to 1 with which predictions come nearest to what is left, by least squares over valid rows."""
    product = jnp.sum(jnp.sum(left * predicted, -1), where=valid)
    size = jnp.sum(jnp.sum(jnp.square(predicted), -1), where=valid)
    return jnp.clip(product / jnp.where(size > 0, size, 1.0), 0, 1)


def correcting(name: str, form: AnswerForm, target: TargetFunction, sizes: GuideSizes, spaces: Spaces) -> Guidance:
    """The bundle of a kind that corrects actions and sees how far they have been turned; see `correcting.correcting`.

    Members of an ensemble disagree about actions as if they had not been turned.
    """
    network, space = residual_model(sizes, spaces, beside=1), spaces.actions

    def init(key: PRNGKeyArray) -> GuidanceModel:
        return GuidanceModel(nothing(network.init(key)), jnp.array(False))

    def fit(key: PRNGKeyArray, env: Any, labels: Label, former: GuidanceModel, scalars: GuideScalars) -> GuidanceModel:
        assert labels.base is not None  # `asking` keeps it for a guidance that has `onward`
        eps, rows = scalars.radians("eps"), lessons(labels, target, scalars)
        asked = space.retract(rows.action + rows.target)
        turns = turned(space, labels.base, rows.action, eps)
        training = rows.valid & ~held_out(len(rows.valid))
        part = fitted(turns, turned(space, rows.action, asked, eps), training)
        left = rows.target / eps - vectors(space, height(part, turns), rows.action, eps)
        rows = rows.replace(action=jnp.concatenate([rows.action, turns[:, None]], -1), target=left)
        predict = partial(network.predict, env)
        model = fit_least_squares(key, rows, scalars, init=network.init, apply=predict, sizes=sizes)
        predicted = predict(model.params, rows.obs, rows.action)
        share = share_of(left, predicted, rows.valid & held_out(len(rows.valid)))
        return GuidanceModel(TwoParts(part, model.params, share), model.fitted)

    def onward(
        model: GuidanceModel,
        env: Any,
        obs: Float[Array, "n obs"],
        first: Float[Array, "n action"],
        actions: Float[Array, "n action"],
        active: Bool[Array, " n"],
        scalars: GuideScalars,
    ) -> Refined:
        eps, known = scalars.radians("eps"), model.params

        def residual(current: Float[Array, "n action"]) -> Float[Array, "n action"]:
            turns = turned(space, first, current, eps)
            seen = jnp.concatenate([current, turns[:, None]], -1)
            of_turn = vectors(space, height(known.part, turns), current, eps)
            return eps * (of_turn + known.share * network.predict(env, known.network, obs, seen))

        return refine(
            residual,
            actions,
            active & model.fitted,
            space=space,
            tau=scalars.radians("tau"),
            tau_max=scalars.radians("tau_max"),
            k_max=scalars.k_max,
        )

    def act(
        model: GuidanceModel,
        env: Any,
        obs: Float[Array, "n obs"],
        actions: Float[Array, "n action"],
        active: Bool[Array, " n"],
        scalars: GuideScalars,
    ) -> Refined:
        return onward(model, env, obs, actions, actions, active, scalars)

    def disagreement(
        model: GuidanceModel, env: Any, obs: Float[Array, "n obs"], actions: Float[Array, "n action"]
    ) -> Float[Array, " n"]:
        assert network.disagreement is not None
        seen = jnp.concatenate([actions, jnp.zeros((len(actions), 1))], -1)
        return network.disagreement(model.replace(params=model.params.network), env, obs, seen)

    members = disagreement if network.disagreement else None
    return Guidance(name, form, init, about_refined(act), target, fit, act, members, onward)
