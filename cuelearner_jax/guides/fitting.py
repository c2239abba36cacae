"""Networks of guides, and their fit to labels of any form: by least squares (paper, Eq. 3) or another loss.

The model of a guide is one network, or an ensemble whose members' mean predicts and whose variance is disagreement.
Members differ by their random initial parameters and by the batches that they are fitted to, as in Lakshminarayanan,
Pritzel, Blundell, "Simple and scalable predictive uncertainty estimation using deep ensembles", NeurIPS 2017. Their
parameters have a leading axis of members; of one member there is no such axis, and nothing is different from a network.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
from flax import struct
from jaxtyping import Array, Bool, Float, Key, PRNGKeyArray

from cuelearner_jax.agents import networks
from cuelearner_jax.config import GuideScalars, GuideSizes
from cuelearner_jax.environment import Spaces
from cuelearner_jax.spaces import Space, is_answered
from cuelearner_jax.types import GuidanceModel, Params

Init = Callable[[PRNGKeyArray], Params]
Predict = Callable[[Any, Params, Array, Array], Array]  # (env, params, obs (n, ...), actions (n, ...)) -> (n, outputs)
Augment = Callable[[PRNGKeyArray, Any], Any]  # (key, batch (n, ...) of rows) -> what to train on in its place

LEAST = 1e-5  # standard deviation of an entry of observations below which it is jitter
NOTHING = 1e30  # variance by which an entry is left out
VALIDATION_STRIDE = 5  # every fifth label is a validation label: the 80/20 split of the paper's public code


class GuideModel(NamedTuple):
    """A network of observation and action, or an ensemble of such, as pure functions."""

    init: Init
    predict: Predict  # the members' mean; of parameters with any number of members
    disagreement: Callable[..., Array]  # the variance of several members, summed over outputs (n,)


def ensemble(members: int, init: Init, predict: Predict) -> GuideModel:
    """Return the model of so many members, from one member's parameters and outputs."""
    each = jax.vmap(predict, in_axes=(None, 0, None, None))

    def mean(env: Any, params: Params, obs: Array, actions: Array) -> Array:
        return each(env, params, obs, actions).mean(0)

    def disagreement(env: Any, params: Params, obs: Array, actions: Array, less: Array | None = None) -> Array:
        values = each(env, params, obs, actions)
        if less is not None:  # the mean over these actions (m, action)
            about = lambda action: each(env, params, obs, jnp.broadcast_to(action, actions.shape))  # noqa: E731
            values = values - jax.lax.map(about, less).mean(0)
        return jnp.sum(values.var(0), -1)

    return GuideModel(lambda key: for_each(members, init, key), predict if members == 1 else mean, disagreement)


def guide_model(sizes: GuideSizes, spaces: Spaces, outputs: int | None = None, beside: int = 0) -> GuideModel:
    """Return the networks of these sizes. Raises UserError for a frame in which the environment cannot be seen.

    `outputs`: their number, such as 1 for an action's value; None: a vector to be added to the action, whichever frame
    it is seen in. `beside`: entries of actions, at their end, that the networks see beside observation and action.
    """
    space, size, is_raw = spaces.actions, spaces.actions.size, sizes.frame == "raw"
    network = networks.MLP(sizes.feedback_layers, size if outputs is None else outputs, start=sizes.feedback_start)
    own, turned = networks.widths(sizes.frame, spaces)

    def init(key: PRNGKeyArray) -> Params:
        params = network.init(key, jnp.zeros(own), jnp.zeros(turned + beside))
        if not (is_raw and sizes.normalise_obs):
            return params
        return {**params, "obs": {"mean": jnp.zeros(own), "variance": jnp.ones(own)}}

    def predict(
        env: Any, params: Params, obs: Float[Array, "*n obs"], actions: Float[Array, "m action"]
    ) -> Float[Array, "m outputs"]:
        """Return predictions for m situations with an action each, or for one situation with m actions."""
        bare, base = jnp.split(actions, [size], -1)
        obs = networks.normalised(obs, jax.lax.stop_gradient(params.get("obs")), 0.0)
        of_obs, of_action = networks.network_inputs(sizes.frame, space, env, obs, bare)
        of_action = jnp.concatenate([of_action, base], -1) if beside else of_action
        return networks.as_function(network)(params, of_obs, of_action)

    model = ensemble(sizes.ensemble, init, predict)
    if outputs is not None:
        return model

    def residual(env: Any, params: Params, obs: Array, actions: Array) -> Array:
        """Return the outputs, which are half ranges or turns from the action, as vectors to add to it."""
        vector = model.predict(env, params, obs, actions)
        return vector * space.half_ranges(vector) if is_raw else space.outward(vector, actions[..., :size])

    return model._replace(predict=residual)


def for_each(members: int, function: Callable[..., Any], key: PRNGKeyArray, *parameters: Any) -> Any:
    """Return a function's result (a tree) for every member, each from its own random key and parameters.

    A single member uses the common `key` directly, and its parameters have no leading axis of members.
    """
    if members == 1:
        return function(key, *parameters)
    return jax.vmap(function)(jax.random.split(key, members), *parameters)


class Example(struct.PyTreeNode):
    """A label's target: what a network is to predict of it."""

    obs: Float[Array, " obs"]
    action: Float[Array, " action"]
    target: Float[Array, " outputs"]
    valid: Bool[Array, ""]
    cues: Bool[Array, " cues"] | None = None  # the cues along which errors count; None: errors count as a whole
    space: Space | None = struct.field(pytree_node=False, default=None)  # of a target that is an action or a change


def squared_errors(rows: Example, predicted: Float[Array, "n outputs"]) -> Float[Array, " n"]:
    """Return the squared errors of predictions, L = |f - y|^2 (paper, Eq. 3), in half ranges where entries have bounds.

    Where labels may leave cues out, L is the sum over the cues of which something was said of (d log (f - y))^2, the
    error along that cue in the space's unit. A cue of which nothing was said adds nothing, whatever is predicted.
    """
    off = predicted - rows.target
    if rows.cues is None:
        return jnp.sum(jnp.square(off if rows.space is None else off / rows.space.half_ranges(off)), -1)
    assert rows.space is not None  # `Guide.examples` gives both
    along = jax.vmap(rows.space.along)(rows.action[..., : rows.space.size], off)
    return jnp.sum(jnp.square(along), -1, where=rows.cues)


def optimizer(scalars: GuideScalars) -> optax.GradientTransformation:
    """Return the optimiser of every guidance model: gradients clipped to a global norm, then Adam (paper, appendix)."""
    return optax.chain(optax.clip_by_global_norm(scalars.max_grad_norm), optax.adam(scalars.feedback_learning_rate))


def held_out(count: int) -> Bool[np.ndarray, " count"]:
    """Return which of so many labels are held out for validation."""
    return np.arange(count) % VALIDATION_STRIDE == VALIDATION_STRIDE - 1


def silent_cues(answers: Float[Array, "n cues"], valid: Bool[Array, " n"], holds_out: bool) -> Bool[Array, "1 cues"]:
    """Return the cues that no label to fit names."""
    rows = valid & ~held_out(len(valid)) if holds_out else valid
    return ~is_answered(answers).any(0, where=rows[:, None], keepdims=True)


def with_moments(params: Params, obs: Float[Array, "n obs"], rows: Bool[Array, " n"]) -> Params:
    """Return parameters of a network that sees normalised observations with the moments of some; others as they are.

    An entry that is constant, but for a simulator's jitter or rounding, is left out: nothing is known of it.
    """
    if not (isinstance(params, dict) and "obs" in params):
        return params
    mean, variance = networks.moments_of(obs, rows).values()
    moments = {"mean": mean, "variance": jnp.where(variance > LEAST**2 + jnp.square(1e-6 * mean), variance, NOTHING)}
    return {**params, "obs": jax.tree.map(lambda new, old: jnp.broadcast_to(new, old.shape), moments, params["obs"])}


def fit_model(
    key: PRNGKeyArray,
    rows: Any,
    scalars: GuideScalars,
    *,
    init: Init,
    losses: Callable[[Params, Any], Float[Array, " n"]],
    sizes: GuideSizes,
    augment: Augment = lambda key, batch: batch,
) -> GuidanceModel:
    """Fit a model from scratch, and keep the parameters with the least validation loss.

    A fixed number of Adam steps, so that vmapped seeds take equally long. With fewer than five labels nothing
    validates: the last parameters are kept. A fit that diverged before anything validated gives parameters that are
    NaN. Without a valid label to train on, the model's `fitted` is False.

    `rows` are what is learned from (slots, ...), such as examples, of which the `valid` ones count; `init` gives the
    parameters of `sizes.ensemble` members, which are fitted each by itself; `losses` gives the loss of each row.
    """
    if sizes.ensemble > 1:
        # A member is fitted as an ensemble of one, whose mean is its own prediction.
        one: dict[str, Any] = {"losses": losses, "sizes": dataclasses.replace(sizes, ensemble=1), "augment": augment}
        one["init"] = lambda key: jax.tree.map(lambda leaf: leaf[:1], init(key))
        each = jax.vmap(lambda key: fit_model(key, rows, scalars, **one))(jax.random.split(key, sizes.ensemble))
        return GuidanceModel(jax.tree.map(lambda leaf: leaf[:, 0], each.params), each.fitted.all())
    held = held_out(rows.valid.shape[0])
    validation, training = rows.valid & held, rows.valid & ~held
    order, count = jnp.argsort(~training, stable=True), jnp.maximum(training.sum(), 1)
    k_init, k_steps = jax.random.split(key)
    adam = optimizer(scalars)

    def loss(params: Params, batch: Any) -> jax.Array:
        return jnp.mean(losses(params, batch))

    def step(carry: tuple[Params, optax.OptState], key: PRNGKeyArray) -> tuple[tuple[Params, optax.OptState], None]:
        params, opt_state = carry
        k_draw, k_augment = jax.random.split(key)
        # One draw for every leaf: the compiler merges them
        draw = lambda: order[jax.random.randint(k_draw, (sizes.fit_batch_size,), 0, count)]  # noqa: E731
        batch = augment(k_augment, jax.tree.map(lambda leaf: leaf[draw()], rows))
        updates, opt_state = adam.update(jax.grad(loss)(params, batch), opt_state, params)
        return (optax.apply_updates(params, updates), opt_state), None

    def stretch(carry: tuple, keys: Key[Array, " steps"]) -> tuple[tuple, None]:
        running, best, best_score = carry
        running, _ = jax.lax.scan(step, running, keys)
        score = jnp.sum(losses(running[0], rows), where=validation)
        better = (score < best_score) | ~validation.any()
        best = jax.tree.map(lambda new, old: jnp.where(better, new, old), running[0], best)
        return (running, best, jnp.where(better, score, best_score)), None

    params = init(k_init)
    if hasattr(rows, "obs"):
        params = with_moments(params, rows.obs, rows.valid)
    keys = jax.random.split(k_steps, (sizes.fit_steps // sizes.validate_every, sizes.validate_every))
    (_, best, score), _ = jax.lax.scan(stretch, ((params, adam.init(params)), params, jnp.inf), keys)
    diverged = ~jnp.isfinite(score) & validation.any()
    best = jax.tree.map(lambda leaf: jnp.where(diverged, jnp.nan, leaf), best)
    return GuidanceModel(best, training.any())
