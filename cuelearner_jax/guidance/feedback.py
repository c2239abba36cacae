"""Relative feedback: the teacher's answer, and fitting a model to labels (paper, section IV-A).

Whatever the form of guidance, a label is (obs, action, target) and its model is fitted by least squares to the target,
so `fit` serves all of them.
"""

from __future__ import annotations

from collections.abc import Callable

import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from cuelearner_jax import actions as geometry
from cuelearner_jax.config import Scalars, Sizes
from cuelearner_jax.environment import Environment, random_symmetries
from cuelearner_jax.types import GuidanceModel, Label, Params

VALIDATION_STRIDE = 5  # every fifth label is a validation label: the 80/20 split of the paper's public code


def relative_feedback(
    action: Float[Array, "2"],
    best: Float[Array, "2"],
    eps: Float[Array, ""],
    indifference: Float[Array, ""] | float = 0.0,
) -> Float[Array, ""]:
    """h in {-1, 0, +1}: which of the turns by -eps, 0, +eps [rad] brings `action` nearest to `best`.

    0 ("already right") therefore means within eps / 2; `indifference` [rad] widens that.
    """
    error = geometry.difference(action, best)
    right = jnp.abs(error) <= jnp.maximum(eps / 2, indifference)
    return jnp.where(right, 0.0, jnp.sign(error))


def human_answer(
    key: PRNGKeyArray, action: Float[Array, "2"], best: Float[Array, "2"], scalars: Scalars
) -> tuple[Float[Array, ""], Bool[Array, ""]]:
    """The answer of a teacher with the faults of `scalars`: (h, answered)."""
    key_mistake, key_silence = jax.random.split(key)
    believed = geometry.rotate(best, scalars.radians("teacher_bias"))
    h = relative_feedback(action, believed, scalars.radians("eps"), scalars.radians("indifference"))
    mistaken = jax.random.bernoulli(key_mistake, scalars.mistake_probability)
    silent = jax.random.bernoulli(key_silence, scalars.silence_probability)
    return jnp.where(mistaken, -h, h), ~silent


def relative_target(action: Float[Array, "2"], h: Float[Array, ""], eps: Float[Array, ""]) -> Float[Array, "2"]:
    """eps * h of Eq. 3 as a vector in the plane: the action turned by h * eps [rad], less the action."""
    return geometry.rotate(action, h * eps) - action


def empty_labels(count: int, obs_size: int) -> Label:
    """`count` rows of padding."""
    return Label(
        obs=jnp.zeros((count, obs_size)),
        action=jnp.zeros((count, 2)),
        target=jnp.zeros((count, 2)),
        valid=jnp.zeros((count,), bool),
    )


def _subset(valid: Bool[Array, " labels"]) -> Callable[[PRNGKeyArray, int], jax.Array]:
    """Sampler of indices, with replacement, among the true rows of `valid`."""
    order = jnp.argsort(~valid, stable=True)
    count = jnp.maximum(valid.sum(), 1)
    return lambda key, size: order[jax.random.randint(key, (size,), 0, count)]


def fit(
    key: PRNGKeyArray,
    env: Environment,
    labels: Label,
    scalars: Scalars,
    *,
    init: Callable[[PRNGKeyArray], Params],
    apply: Callable[[Params, jax.Array, jax.Array], jax.Array],
    sizes: Sizes,
) -> GuidanceModel:
    """Fits a model to labels from scratch by least squares (paper, Eq. 3) and keeps the parameters that validated best.

    A fixed number of Adam steps, so that vmapped seeds take equally long. Labels are multiplied by the environment's
    symmetries where it offers them. With fewer than five labels nothing validates: the last parameters are kept.

    Args:
        labels: rows (labels, ...), of which the valid ones count.
        init: parameters from a key.
        apply: (params, obs (n, obs), actions (n, 2)) -> predictions (n, 2).

    Returns:
        The model; its `fitted` is False if there was no valid label to train on.
    """
    held_out = (jnp.arange(labels.valid.shape[0]) % VALIDATION_STRIDE) == VALIDATION_STRIDE - 1
    validation = labels.valid & held_out
    training = labels.valid & ~held_out
    draw = _subset(training)
    key_init, key_steps = jax.random.split(key)
    optimizer = optax.chain(
        optax.clip_by_global_norm(scalars.max_grad_norm), optax.adam(scalars.feedback_learning_rate)
    )

    def loss(params: Params, batch: Label) -> jax.Array:
        error = apply(params, batch.obs, batch.action) - batch.target
        return jnp.mean(jnp.sum(jnp.square(error), -1))

    def step(carry: tuple[Params, optax.OptState], key: PRNGKeyArray) -> tuple[tuple[Params, optax.OptState], None]:
        params, opt_state = carry
        key_draw, key_mirror = jax.random.split(key)
        batch = jax.tree.map(lambda leaf: leaf[draw(key_draw, sizes.fit_batch_size)], labels)
        image = random_symmetries(key_mirror, env, sizes.fit_batch_size)
        (obs, action), (_, target) = image(batch.obs, batch.action), image(batch.obs, batch.target)
        batch = batch.replace(obs=obs, action=action, target=target)
        updates, opt_state = optimizer.update(jax.grad(loss)(params, batch), opt_state, params)
        return (optax.apply_updates(params, updates), opt_state), None

    def validate(params: Params) -> jax.Array:
        error = apply(params, labels.obs, labels.action) - labels.target
        return jnp.sum(jnp.sum(jnp.square(error), -1), where=validation)

    def stretch(carry: tuple, keys: PRNGKeyArray) -> tuple[tuple, None]:
        running, best, best_loss = carry
        running, _ = jax.lax.scan(step, running, keys)
        score = validate(running[0])
        better = (score < best_loss) | ~validation.any()
        best = jax.tree.map(lambda new, old: jnp.where(better, new, old), running[0], best)
        return (running, best, jnp.where(better, score, best_loss)), None

    params = init(key_init)
    keys = jax.random.split(key_steps, (sizes.fit_steps // sizes.validate_every, sizes.validate_every))
    start = ((params, optimizer.init(params)), params, jnp.inf)
    (_, best, _), _ = jax.lax.scan(stretch, start, keys)
    return GuidanceModel(best, training.any())
