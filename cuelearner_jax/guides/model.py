"""The model of a guide: one network, or an ensemble whose members' mean predicts and whose variance is disagreement.

Members differ by their random initial parameters and by the batches that they are fitted to, as in Lakshminarayanan,
Pritzel, Blundell, "Simple and scalable predictive uncertainty estimation using deep ensembles", NeurIPS 2017. Their
parameters have a leading axis of members; of one member there is no such axis, and nothing is different from a network.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from cuelearner_jax.agents import view
from cuelearner_jax.agents.networks import as_function, residual_network
from cuelearner_jax.config import GuideSizes
from cuelearner_jax.environment import Spaces
from cuelearner_jax.types import GuidanceModel, Params

Predict = Callable[[Any, Params, Array, Array], Array]  # (env, params, obs (n, ...), actions (n, ...)) -> (n, outputs)


class GuideModel(NamedTuple):
    """A network of observation and action, or an ensemble of such, as pure functions."""

    init: Callable[[PRNGKeyArray], Params]
    predict: Predict  # the members' mean; of parameters with any number of members
    disagreement: Predict  # the variance of several members, summed over outputs (n,)


def ensemble(members: int, init: Callable[[PRNGKeyArray], Params], predict: Predict) -> GuideModel:
    """Return the model of one kind of network.

    Args:
        members: their number.
        init: one member's parameters.
        predict: one member's outputs.
    """
    each = jax.vmap(predict, in_axes=(None, 0, None, None))

    def mean(env: Any, params: Params, obs: Array, actions: Array) -> Array:
        return each(env, params, obs, actions).mean(0)

    def disagreement(env: Any, params: Params, obs: Array, actions: Array) -> Float[Array, " n"]:
        return jnp.sum(each(env, params, obs, actions).var(0), -1)

    return GuideModel(lambda key: for_each(members, init, key), predict if members == 1 else mean, disagreement)


def guide_model(sizes: GuideSizes, spaces: Spaces, outputs: int | None = None, beside: int = 0) -> GuideModel:
    """Return the networks of these sizes.

    Args:
        sizes: sizes of the networks.
        spaces: the environment's.
        outputs: number of outputs, such as the value of an action; None: a vector to be added to the
            action, whichever frame it is seen in.
        beside: numbers that they see beside observation and action: actions then have so many entries more, at the end.

    Raises UserError for a frame in which the environment cannot be seen.
    """
    size = spaces.actions.size
    network = residual_network(sizes.feedback_layers, size if outputs is None else outputs)
    own, turned = view.widths(sizes.frame, spaces)

    def init(key: PRNGKeyArray) -> Params:
        return network.init(key, jnp.zeros(own), jnp.zeros(turned + beside))

    def predict(
        env: Any, params: Params, obs: Float[Array, "*n obs"], actions: Float[Array, "m action"]
    ) -> Float[Array, "m outputs"]:
        """Return predictions for m situations with an action each, or for one situation with m actions."""
        bare, known = jnp.split(actions, [size], -1)
        of_obs, of_action = view.network_inputs(sizes.frame, env, obs, bare)
        return as_function(network)(params, of_obs, jnp.concatenate([of_action, known], -1) if beside else of_action)

    made = ensemble(sizes.ensemble, init, predict)
    if outputs is not None:
        return made

    def residual(env: Any, params: Params, obs: Array, actions: Array) -> Array:
        return view.outward(sizes.frame, spaces, made.predict(env, params, obs, actions), actions[..., :size])

    return made._replace(predict=residual)


def for_each(members: int, function: Callable[..., Any], key: PRNGKeyArray, *parameters: Any) -> Any:
    """Return a function's result for every member, each from its own random key and parameters.

    Args:
        members: their number.
        function: (key, *parameters of one member) -> a tree.
        key: the members' common key; a single member uses it directly.
        parameters: the members', with the leading axis that several have.
    """
    if members == 1:
        return function(key, *parameters)
    return jax.vmap(function)(jax.random.split(key, members), *parameters)


def fitted_members(
    members: int,
    fit: Callable[[PRNGKeyArray, Callable[[PRNGKeyArray], Params]], GuidanceModel],
    key: PRNGKeyArray,
    init: Callable[[PRNGKeyArray], Params],
) -> GuidanceModel:
    """Return each member fitted by itself, from its own random key.

    Args:
        members: their number.
        fit: the model of one member from a key and its `init`.
        key: the members' common key.
        init: the ensemble's initialiser. A member is fitted as an ensemble of one, whose mean is its own prediction.
    """
    if members == 1:
        return fit(key, init)
    first = lambda key: jax.tree.map(lambda leaf: leaf[:1], init(key))  # noqa: E731
    each = jax.vmap(lambda key: fit(key, first))(jax.random.split(key, members))
    return GuidanceModel(jax.tree.map(lambda leaf: leaf[:, 0], each.params), each.fitted.all())
