"""Relative feedback read as intent: which of a situation's aims does the teacher mean?

"More to the left" says that the teacher's aim lies to the left, so some of the situation's aims (`Environment.aims`)
become more likely than others. One network weights every aim by its features, with shared weights, and is fitted by
maximum likelihood of the answers, summed over the aims that may be meant. (Goal inference: Baker, Saxe, Tenenbaum,
"Action understanding as inverse planning", Cognition 2009.) A pass of refinement moves an action by at most eps toward
the likeliest aim and ends there, so the action is as precise as the aim, not as the label. Where the teacher seems to
mean none of the aims (`aim_doubt`), actions do not change, since repeating one bad shot is worse than the agent's own
choice. With g_i the aims of s, p their weights by the network, and each cue that a label names by itself:

    P(h | s, a) = sum over i of p_i(s) prod over cues of P(h_c | log(a, g_i)_c)                          (`likelihood`)
    p = argmax of sum over labels of log P(h | s, a),      a <- approach(a, likeliest g_i, eps)                 (`act`)
"""

from __future__ import annotations

from functools import cached_property, partial
from typing import Annotated, Any

import flax.linen as nn
import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from cuelearner_jax.config import Bounds, GuideScalars, Layers, part
from cuelearner_jax.environment import Aims
from cuelearner_jax.feedback.answers import RELATIVE
from cuelearner_jax.guides.base import Guide, Rows
from cuelearner_jax.guides.fitting import GuideModel, ensemble, fit_model
from cuelearner_jax.guides.refining import Refinement
from cuelearner_jax.spaces import Space, is_answered
from cuelearner_jax.types import Action, Actions, GuidanceModel, Label, Observations, Params

ELSEWHERE = 360  # evenly spaced actions that stand for "the teacher means none of the aims"
SPREAD = 1 / 180  # distance of a meant action from its aim, as a share of the space's reach
SLIPS = 0.02  # share of random answers
WORDS = 3


@part
class IntentConfig:
    """Options of a guide that infers intent."""

    aim_layers: Layers = (32, 32)
    """Hidden layers of the network that weighs the task's aims: the same ones for every aim."""
    aim_doubt: Annotated[float, Bounds(0)] = 2.0
    """Actions stay as they are where it is at least so many times likelier that no aim is meant."""


class Weights(nn.Module):
    """Network of the log-weights of a situation's aims and of "none of them", with shared layers for all aims."""

    layers: tuple[int, ...]

    @nn.compact
    def __call__(
        self, features: Float[Array, "aims features"], possible: Bool[Array, " aims"]
    ) -> Float[Array, " aims_and_none"]:
        """Return the log-weights; without training they are uniform."""
        x = features
        for width in self.layers:
            x = nn.relu(nn.Dense(width, kernel_init=nn.initializers.xavier_uniform())(x))
        weights = nn.Dense(1, kernel_init=nn.initializers.zeros)(x)[:, 0]
        none = self.param("none", nn.initializers.zeros, (1,))
        return jnp.concatenate([jnp.where(possible, weights, -jnp.inf), none])


class Evidence(struct.PyTreeNode):
    """One answer's likelihood under each possible aim."""

    features: Float[Array, "aims features"]
    possible: Bool[Array, " aims"]
    likelihood: Float[Array, " aims_and_none"]  # probability of the answer, if this aim is meant
    valid: Bool[Array, ""]


def likelihood(
    space: Space, action: Action, goals: Float[Array, "goals action"], h: Float[Array, " cues"], eps: Float[Array, ""]
) -> Float[Array, " goals"]:
    """Return the probability of the answer h about `action`, if the teacher means each of the goals.

    What is meant lies round the goal, along each cue by itself, with a logistic error of `SPREAD`; within eps / 2 of
    the action it is right. A cue of which nothing was said tells nothing.
    """
    offset, width = space.log(action[None], goals), space.from_unit(SPREAD * space.reach)
    above = jax.nn.sigmoid((offset - eps / 2) / width)
    below = jax.nn.sigmoid((-offset - eps / 2) / width)
    each = jnp.where(h > 0, above, jnp.where(h < 0, below, 1.0 - above - below))
    return each[..., 0] if len(space.cues) == 1 else jnp.prod(each, -1, where=is_answered(h))


def evidence_of(aims: Aims, space: Space, label: Label, scalars: GuideScalars) -> Evidence:
    """Return a label's likelihood under each aim of its situation."""
    eps = space.from_unit(scalars.eps_deg)
    of_aims = likelihood(space, label.action, aims.actions, label.answer, eps)
    of_none = likelihood(space, label.action, space.spread(ELSEWHERE), label.answer, eps).mean(keepdims=True)
    return Evidence(aims.features, aims.possible, jnp.concatenate([of_aims, of_none]), label.valid)


def choose_aim(
    space: Space, share: Float[Array, " aims_and_none"], aims: Float[Array, "aims action"], action: Action, doubt: float
) -> tuple[Action, Bool[Array, ""]]:
    """Return the nearest of the likeliest aims, and whether the aim is likely enough to be followed."""
    most = share[:-1].max()
    goal = aims[jnp.argmin(jnp.where(share[:-1] >= most, space.distance(action[None], aims), jnp.inf))]
    return goal, (most > 0.0) & (doubt * most > share[-1])


class Intent(Guide):
    """A guide that weights the task's aims by the answers, and moves toward the likeliest."""

    name, about, needs = "intent", "relative feedback about the task's aims", ("aims",)
    form, colour, config = RELATIVE, "#CC79A7", IntentConfig
    options: IntentConfig

    @cached_property
    def network(self) -> GuideModel:
        """The network, or ensemble, of the probability that each aim, or none, is meant.

        Its inputs are the aims' features and a mask of possible aims, in place of observations and actions.
        """
        weights = Weights(self.options.aim_layers)
        width = self.spaces.aims or 0

        def init(key: PRNGKeyArray) -> Params:
            return weights.init(key, jnp.zeros((1, width)), jnp.ones(1, bool))

        def shares(
            env: Any, params: Params, features: Float[Array, "n aims features"], possible: Bool[Array, "n aims"]
        ) -> Float[Array, "n aims_and_none"]:
            return jax.nn.softmax(jnp.asarray(jax.vmap(weights.apply, (None, 0, 0))(params, features, possible)))

        return ensemble(self.sizes.ensemble, init, shares)

    def fit(
        self, key: PRNGKeyArray, env: Any, labels: Label, former: GuidanceModel, scalars: GuideScalars
    ) -> GuidanceModel:
        """Return the maximum-likelihood model of the answers."""
        rows = jax.vmap(lambda label: evidence_of(env.aims(label.obs), self.spaces.actions, label, scalars))(labels)

        def surprise(params: Params, rows: Evidence) -> Float[Array, " rows"]:
            share = self.network.predict(None, params, rows.features, rows.possible)
            return -jnp.log((1.0 - SLIPS) * (share * rows.likelihood).sum(-1) + SLIPS / WORDS)

        return fit_model(key, rows, scalars, init=self.network.init, losses=surprise, sizes=self.sizes)

    def act(
        self, model: GuidanceModel, env: Any, obs: Observations, actions: Actions, active: Rows, scalars: GuideScalars
    ) -> Refinement:
        """Move each action by at most eps a pass toward the likeliest aim, in active rows with a sure, fitted model."""
        space, aims = self.spaces.actions, jax.vmap(env.aims)(obs)
        share = self.shares(model, env, aims)
        goals, sure = jax.vmap(partial(choose_aim, space, doubt=self.options.aim_doubt))(share, aims.actions, actions)

        def phi(current: Actions) -> Actions:
            return space.approach(current, goals, space.from_unit(scalars.eps_deg)) - current

        return self.refined(phi, actions, active & sure & model.fitted, scalars)

    def shares(self, model: GuidanceModel, env: Any, aims: Aims) -> Float[Array, "n aims_and_none"]:
        """Return the probability that each aim (n, aims) is meant and may be followed; last, that none is meant."""
        share = self.network.predict(env, model.params, aims.features, aims.possible)
        return share if aims.open is None else share.at[:, :-1].multiply(aims.open)

    def disagreement(self, model: GuidanceModel, env: Any, obs: Observations, actions: Actions) -> Float[Array, " n"]:
        """Return the variance of the members' probabilities, summed over aims; it does not depend on the action."""
        aims = jax.vmap(env.aims)(obs)
        return self.network.disagreement(env, model.params, aims.features, aims.possible)
