"""Several members in place of one network: they predict their mean, and disagree about what they do not know.

Members differ by their random initial parameters and by the batches that they are fitted to, as in Lakshminarayanan,
Pritzel, Blundell, "Simple and scalable predictive uncertainty estimation using deep ensembles", NeurIPS 2017. Their
parameters have a leading axis of members; of one member there is no such axis, and nothing is different from a network.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray, Shaped

from cuelearner_jax.guides.bundle import DisagreementFunction
from cuelearner_jax.types import GuidanceModel, Params

Predict = Callable[[Any, Params, Array, Array], Array]  # (env, params, obs (n, ...), actions (n, ...)) -> (n, outputs)


class Ensemble(NamedTuple):
    """Its members as one model."""

    init: Callable[[PRNGKeyArray], Params]  # the members' parameters
    predict: Predict  # their mean; of parameters with any number of members
    disagreement: DisagreementFunction | None  # None: there is but one member


def ensemble(members: int, init: Callable[[PRNGKeyArray], Params], predict: Predict) -> Ensemble:
    """So many members of one kind.

    Args:
        members: their number.
        init: one member's parameters.
        predict: one member's outputs.
    """
    if members == 1:
        return Ensemble(init, predict, None)
    each = jax.vmap(predict, in_axes=(None, 0, None, None))

    def init_all(key: PRNGKeyArray) -> Params:
        return for_each(members, init, key)

    def mean(env: Any, params: Params, obs: Array, actions: Array) -> Array:
        return each(env, params, obs, actions).mean(0)

    def disagreement(
        model: GuidanceModel, env: Any, obs: Shaped[Array, "n ..."], actions: Shaped[Array, "n ..."]
    ) -> Float[Array, " n"]:
        """The members' variance, summed over outputs; of whatever they predict from."""
        return jnp.sum(each(env, model.params, obs, actions).var(0), -1)

    return Ensemble(init_all, mean, disagreement)


def for_each(members: int, function: Callable[..., Any], key: PRNGKeyArray, *parameters: Any) -> Any:
    """What a function of a key and of one member's parameters makes of every member, each from its own random numbers.

    Args:
        members: their number.
        function: (key, *parameters of one member) -> a tree.
        key: of all of them; of one member, its own.
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
    """Each member fitted by itself, from its own random numbers.

    Args:
        members: their number.
        fit: the model of one member from a key and its `init`.
        key: of all of them.
        init: of `ensemble`. A member is fitted as an ensemble of one, whose mean is its own prediction.
    """
    if members == 1:
        return fit(key, init)
    first = lambda key: jax.tree.map(lambda leaf: leaf[:1], init(key))  # noqa: E731
    each = jax.vmap(lambda key: fit(key, first))(jax.random.split(key, members))
    return GuidanceModel(jax.tree.map(lambda leaf: leaf[:, 0], each.params), each.fitted.all())
