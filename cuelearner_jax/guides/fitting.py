"""Fit a model to labels of any form, by least squares (paper, Eq. 3) or another loss."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
from flax import struct
from jaxtyping import Array, Bool, Float, Key, PRNGKeyArray

from cuelearner_jax.config import GuideScalars, GuideSizes
from cuelearner_jax.guides.model import fitted_members
from cuelearner_jax.spaces import Space, is_answered
from cuelearner_jax.types import GuidanceModel, Label, Params

VALIDATION_STRIDE = 5  # every fifth label is a validation label: the 80/20 split of the paper's public code


class Lesson(struct.PyTreeNode):
    """A label's target: what a network is to predict of it."""

    obs: Float[Array, " obs"]
    action: Float[Array, " action"]
    target: Float[Array, " outputs"]
    valid: Bool[Array, ""]
    said: Bool[Array, " cues"] | None = None  # the cues along which errors count; None: errors count as a whole
    space: Space | None = struct.field(pytree_node=False, default=None)  # the space of these cues


def lessons(
    labels: Label,
    target: Callable[[Label, GuideScalars], Array],
    scalars: GuideScalars,
    space: Space | None = None,
) -> Lesson:
    """Return labels (slots, ...) with their targets; `space`: of answers that may leave cues out.

    A label that names no cue is not valid.
    """
    targets = jax.vmap(lambda label: target(label, scalars))(labels)
    # Rounded here: fused with later operations, the targets' last bits would depend on the compiler.
    rows = Lesson(labels.obs, labels.action, jax.lax.optimization_barrier(targets), labels.valid)
    if space is None or len(space.cues) == 1:
        return rows
    told = is_answered(labels.answer)
    return rows.replace(valid=labels.valid & told.any(-1), said=told, space=space)


def squared_errors(rows: Lesson, predicted: Float[Array, "n outputs"]) -> Float[Array, " n"]:
    """Return the squared errors of predictions, L = |f - y|^2 (paper, Eq. 3).

    Where labels may leave cues out, L is the sum over the cues of which something was said of (d log (f - y))^2, the
    error along that cue in the space's unit. A cue of which nothing was said adds nothing, whatever is predicted.
    """
    off = predicted - rows.target
    if rows.said is None:
        return jnp.sum(jnp.square(off), -1)
    return jnp.sum(jnp.square(along_cues(rows, off)), -1, where=rows.said)


def along_cues(rows: Lesson, vectors: Float[Array, "n action"]) -> Float[Array, "n cues"]:
    """Return the change along each cue that vectors make when added to the actions of lessons."""
    assert rows.space is not None  # `lessons` gives it with `said`
    return jax.vmap(rows.space.along)(rows.action[..., : rows.space.size], vectors)


def optimizer(scalars: GuideScalars) -> optax.GradientTransformation:
    """Return the optimiser of every guidance model: gradients clipped to a global norm, then Adam (paper, appendix)."""
    return optax.chain(optax.clip_by_global_norm(scalars.max_grad_norm), optax.adam(scalars.feedback_learning_rate))


Redrawn = Callable[[PRNGKeyArray, Any], Any]  # (key, batch of rows) -> what to train on in its place


def keep_batch(key: PRNGKeyArray, batch: Any) -> Any:
    """Return the batch itself."""
    return batch


def _subset(valid: Bool[Array, " labels"]) -> Callable[[PRNGKeyArray, int], jax.Array]:
    """Return a sampler of indices among the true rows of `valid`, with replacement."""
    order = jnp.argsort(~valid, stable=True)
    count = jnp.maximum(valid.sum(), 1)
    return lambda key, size: order[jax.random.randint(key, (size,), 0, count)]


def fit_least_squares(
    key: PRNGKeyArray,
    rows: Lesson,
    scalars: GuideScalars,
    *,
    init: Callable[[PRNGKeyArray], Params],
    apply: Callable[[Params, jax.Array, jax.Array], jax.Array],
    sizes: GuideSizes,
    redrawn: Redrawn = keep_batch,
) -> GuidanceModel:
    """Fit by least squares (paper, Eq. 3), as `fit_model`.

    Lessons are never augmented by an environment's symmetries. Where several actions are equally good, a teacher's
    answer in the mirror image is mostly not the mirror image of its answer.

    Args:
        key, rows, scalars, init, sizes, redrawn: as `fit_model` has them.
        apply: (params, obs (n, obs), actions (n, action)) -> predictions (n, outputs).
    """

    def errors(params: Params, rows: Lesson) -> Float[Array, " n"]:
        return squared_errors(rows, apply(params, rows.obs, rows.action))

    return fit_model(key, rows, scalars, init=init, losses=errors, sizes=sizes, redrawn=redrawn)


def fit_model(
    key: PRNGKeyArray,
    rows: Any,
    scalars: GuideScalars,
    *,
    init: Callable[[PRNGKeyArray], Params],
    losses: Callable[[Params, Any], Float[Array, " n"]],
    sizes: GuideSizes,
    redrawn: Redrawn = keep_batch,
) -> GuidanceModel:
    """Fit a model from scratch, and keep the parameters with the least validation loss.

    A fixed number of Adam steps, so that vmapped seeds take equally long. With fewer than five nothing validates: the
    last parameters are kept. A fit that diverged before anything validated gives parameters that are NaN.

    Args:
        rows: a record of what is learned from (slots, ...), such as lessons, of which the `valid` ones count.
        init: parameters from a key; with `sizes.ensemble` those of `ensemble`, whose members are fitted each by itself.
        losses: (params, rows (n, ...)) -> the loss of each.
        redrawn: (key, batch (n, ...) of rows) -> what to train on in its place; validation rows stay.

    Returns:
        The model; its `fitted` is False if there was no valid label to train on.
    """
    fit = partial(_fit_network, rows=rows, scalars=scalars, losses=losses, redrawn=redrawn, sizes=sizes)
    return fitted_members(sizes.ensemble, fit, key, init)


def held_out(count: int) -> Bool[np.ndarray, " count"]:
    """Return which of so many labels are held out for validation."""
    return np.arange(count) % VALIDATION_STRIDE == VALIDATION_STRIDE - 1


def _fit_network(
    key: PRNGKeyArray,
    init: Callable[[PRNGKeyArray], Params],
    *,
    rows: Any,
    scalars: GuideScalars,
    losses: Callable[[Params, Any], Float[Array, " n"]],
    redrawn: Redrawn,
    sizes: GuideSizes,
) -> GuidanceModel:
    held = held_out(rows.valid.shape[0])
    validation = rows.valid & held
    training = rows.valid & ~held
    draw = _subset(training)
    key_init, key_steps = jax.random.split(key)
    adam = optimizer(scalars)

    def loss(params: Params, batch: Any) -> jax.Array:
        return jnp.mean(losses(params, batch))

    def step(carry: tuple[Params, optax.OptState], key: PRNGKeyArray) -> tuple[tuple[Params, optax.OptState], None]:
        params, opt_state = carry
        key_draw, key_redraw = jax.random.split(key)
        batch = redrawn(key_redraw, jax.tree.map(lambda leaf: leaf[draw(key_draw, sizes.fit_batch_size)], rows))
        updates, opt_state = adam.update(jax.grad(loss)(params, batch), opt_state, params)
        return (optax.apply_updates(params, updates), opt_state), None

    def validate(params: Params) -> jax.Array:
        return jnp.sum(losses(params, rows), where=validation)

    def stretch(carry: tuple, keys: Key[Array, " steps"]) -> tuple[tuple, None]:
        running, best, best_loss = carry
        running, _ = jax.lax.scan(step, running, keys)
        score = validate(running[0])
        better = (score < best_loss) | ~validation.any()
        best = jax.tree.map(lambda new, old: jnp.where(better, new, old), running[0], best)
        return (running, best, jnp.where(better, score, best_loss)), None

    params = init(key_init)
    keys = jax.random.split(key_steps, (sizes.fit_steps // sizes.validate_every, sizes.validate_every))
    start = ((params, adam.init(params)), params, jnp.inf)
    (_, best, score), _ = jax.lax.scan(stretch, start, keys)
    diverged = ~jnp.isfinite(score) & validation.any()
    best = jax.tree.map(lambda leaf: jnp.where(diverged, jnp.nan, leaf), best)
    return GuidanceModel(best, training.any())
