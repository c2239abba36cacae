"""Double DQN over a finite set of actions: targets, loss and greedy choice, pure and unbatched.

Source: van Hasselt, Guez, Silver, "Deep reinforcement learning with double Q-learning", Eq. 4.
"""

from __future__ import annotations

from collections.abc import Callable

import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Bool, Float, Int

from cuelearner_jax.types import Params, Transition

# (params, obs (..., obs), actions (..., action)) -> (..., 1)
ValueFunction = Callable[[Params, jax.Array, jax.Array], jax.Array]


def greedy(
    q: ValueFunction, params: Params, obs: Float[Array, " obs"], options: Float[Array, "n action"]
) -> Float[Array, " action"]:
    """The action of a set with the largest value."""
    return options[jnp.argmax(q(params, obs, options)[:, 0])]


def greedy_near_peaks(
    q: ValueFunction,
    params: Params,
    obs: Float[Array, " obs"],
    options: Float[Array, "n action"],
    coarse: Float[Array, " coarse"],
    peaks: int,
) -> Float[Array, " action"]:
    """The same choice as `greedy` makes, if the largest value lies next to one of the highest peaks of a first look.

    Args:
        options: evenly spaced, the last beside the first.
        coarse: values of every (n / coarse)-th of them, computed as roughly as may be: they decide where to look only.
        peaks: how many of its local maxima to look round, up to its neighbours.
    """
    stride = options.shape[0] // coarse.shape[0]
    summit = (coarse >= jnp.roll(coarse, 1)) & (coarse >= jnp.roll(coarse, -1))
    _, highest = jax.lax.top_k(jnp.where(summit, coarse, -jnp.inf), peaks)
    near = jnp.mod(highest[:, None] * stride + jnp.arange(1 - stride, stride)[None], options.shape[0]).ravel()
    return greedy(q, params, obs, options[near])


def target(
    q: ValueFunction,
    params: Params,
    target_params: Params,
    transition: Transition,
    options: Float[Array, "n action"],
    discount: Float[Array, ""] | float,
    chooser: ValueFunction | None = None,
) -> Float[Array, ""]:
    """r + discount * Q'(s', argmax_a Q(s', a)): the online network chooses, the target network values.

    `target_params` None means that nothing bootstraps (a discount of 0): the target is the reward. `chooser` computes
    the values among which is chosen, where that is done less precisely than by `q`.
    """
    if target_params is None:
        return transition.reward
    choice = greedy(chooser or q, params, transition.next_obs, options)
    value = q(target_params, transition.next_obs, choice)[0]
    return transition.reward + discount * transition.discount * value


def n_step_return(
    rewards: Float[Array, " n"],
    discounts: Float[Array, " n"],
    ended: Float[Array, " n"],
    known: Bool[Array, " n"],
    discount: Float[Array, ""] | float,
) -> tuple[Float[Array, ""], Float[Array, ""], Int[Array, ""]]:
    """Discounted rewards of up to n steps of one episode (Sutton and Barto, "Reinforcement learning", Eq. 7.1).

    The sum stops with the episode's last step, or with the last step that is known.

    Args:
        rewards, discounts, ended: of consecutive steps; `discounts` is 0 at termination, else 1.
        known: which of them have been made already; the first is.
        discount: discount factor.

    Returns:
        The sum; the factor of the value of the last step's next observation, short of one `discount`, as
        `Transition.discount` has it; the last step's index.
    """
    before_end = jnp.cumprod(jnp.concatenate([jnp.ones(1), 1.0 - ended[:-1]]))
    counts = before_end * known
    powers = jnp.power(jnp.asarray(discount, rewards.dtype), jnp.arange(rewards.shape[0]))
    last = counts.sum().astype(jnp.int32) - 1
    return jnp.sum(counts * powers * rewards), powers[last] * discounts[last], last


def loss(
    q: ValueFunction, params: Params, transitions: Transition, targets: Float[Array, " batch"]
) -> Float[Array, ""]:
    """Mean squared error of the values of the actions taken, over a batch."""
    values = q(params, transitions.obs, transitions.action)[..., 0]
    return jnp.mean(jnp.square(values - targets))


def optimizer(
    name: str, learning_rate: Float[Array, ""] | float, max_norm: Float[Array, ""] | float
) -> optax.GradientTransformation:
    """Gradients clipped to a global norm, then SGD or Adam. Both scalars may be traced.

    Raises ValueError for another name.
    """
    makers = {"sgd": optax.sgd, "adam": optax.adam}
    if name not in makers:
        raise ValueError(f"unknown optimizer {name!r}: choose one of {sorted(makers)}")
    return optax.chain(optax.clip_by_global_norm(max_norm), makers[name](learning_rate))


def polyak(params: Params, target_params: Params, rate: Float[Array, ""] | float) -> Params:
    """The target network moved toward the online one by `rate`."""
    return optax.incremental_update(params, target_params, rate)
