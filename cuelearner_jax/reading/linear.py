"""The linear model of a change: what a policy would do if what it sees, and what it does, were changed a little.

    a*(s) = exp(a, scale B(a) beta),   a = undo(theta, pi(undo(theta, o) + M (o - centre)))

`theta` are the unknowns of a family of distortions (`families`), or, where a world declares none, a shift of each entry
of the observation; `M` mixes the entries on which the policy depends most. The policy is a black box: it is asked at
both sides of each unknown (`sides`), and `data` makes the central differences of its answers. Where it has no action
at one side, the other side tells the slope; where it has none about the undone observation, it is taken to act as it
does about the observation itself.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Bool, Float, Int

from cuelearner_jax.reading.families import Family, has_effects, undo_action, undo_observation, unknowns_of
from cuelearner_jax.reading.likelihood import Answers, intervals
from cuelearner_jax.reading.posterior import TAU, Data
from cuelearner_jax.spaces import DIRECTIONS, Space
from cuelearner_jax.types import Actions, Number, Observations

Acts = Callable[[Observations], Actions]
SCALE = 3.0  # unit of changes of an action, in eps: the size of a usual correction
STEP = 0.35  # of the central differences of an entry, in its standard deviations
MIXED = 8  # largest number of entries that may mix, of the observation and of the action
PARTS = ("seen", "mixed", "shift", "gain")  # groups of weights: of what is seen, and of the action
JUMP = 4.0  # change of an action, in `SCALE` eps, from which a bend is a jump
STEP_SITUATIONS = 16  # in which the size of an unknown is looked for
STEP_SIZES = np.geomspace(1e-4, 1e3, 29)  # tried, in the unknown's unit
LARGEST_STEP = 1 / 4  # largest mean change of the actions, as a share of the space's reach
LARGEST = 5.0  # standard deviations at which inputs of the process are cut


class ObservationFrame(struct.PyTreeNode):
    """Units of the linear model, from the situations asked about."""

    mean: Float[Array, " obs"]
    deviation: Float[Array, " obs"]  # 1 for an entry that never changes
    varies: Float[Array, " obs"]  # 1, or 0 for an entry that never changes
    step: Float[Array, " unknowns"]  # of the differences, and unit of theta; 0 for an entry that never changes
    mixed: Int[Array, " mixed"]  # entries that may mix; none where a family is given


class Change(struct.PyTreeNode):
    """The estimate of one hypothesis."""

    theta: Float[Array, " unknowns"]
    mix: Float[Array, "obs obs"]
    centre: Float[Array, " obs"]
    action: Float[Array, "cues basis"]  # beta


class RelativeLabels(NamedTuple):
    """Relative answers in arrays of a fixed size."""

    obs: Observations
    action: Actions
    answer: Float[Array, "n cues"]
    valid: Bool[Array, " n"]


def unknowns(family: Family, obs_size: int) -> int:
    """Return the number of unknowns of what is seen."""
    return len(unknowns_of(family)) if family else obs_size


def no_change(space: Space, family: Family, obs_size: int) -> Change:
    """Return the estimate that changes nothing."""
    zeros = jnp.zeros(obs_size)
    mix = jnp.zeros((obs_size, obs_size)) if not family else jnp.zeros((0, 0))
    return Change(jnp.zeros(unknowns(family, obs_size)), mix, zeros, jnp.zeros((len(space.cues), basis_size(space))))


def groups(space: Space, family: Family, obs_size: int) -> tuple[int, ...]:
    """Return the number in `PARTS` of each weight, in the order of `weights_of`."""
    mixed = 0 if family else min(MIXED, obs_size) ** 2
    own = tuple(3 if term else 2 for term in terms(len(space.cues), basis_size(space))[1].tolist())
    return (0,) * unknowns(family, obs_size) + (1,) * mixed + own


def terms(cues: int, basis: int) -> Int[np.ndarray, "2 own"]:
    """Return cue and term of each weight of the action. Of more than `MIXED` entries, each has a shift and a gain."""
    cue, term = np.indices((cues, basis))
    return np.stack(np.nonzero((basis <= 1 + MIXED) | (term == 0) | (term == 1 + cue)))


@partial(jax.jit, static_argnums=0)
def undone(family: Family, change: Change, obs: Observations) -> Observations:
    """Return observations as they would be without the change."""
    if family:
        return jax.vmap(partial(undo_observation, family, change.theta))(obs)
    return obs - change.theta[None] + (obs - change.centre[None]) @ change.mix.T


def meant(family: Family, theta: Float[Array, " unknowns"], before: Observations, action: Actions) -> Actions:
    """Return what a policy's actions about undone observations `before` mean in the changed world."""
    return jax.vmap(partial(undo_action, family, theta))(before, action) if family else action


def basis_size(space: Space) -> int:
    """Return the number of terms of `basis`."""
    return 5 if space == DIRECTIONS else 1 + space.size


def basis(space: Space, action: Actions) -> Float[Array, "n basis"]:
    """Return 1 and the entries of actions, of the order of one; of directions also the second harmonics.

    A drift of the executed motion turns directions by a first harmonic, another gain along one axis by a second.
    """
    even = space.even(action)
    if space == DIRECTIONS:
        x, y = even[:, :1], even[:, 1:]
        even = jnp.concatenate([even, x**2 - y**2, 2 * x * y], 1)
    return jnp.concatenate([jnp.ones((len(action), 1)), even], 1)


@partial(jax.jit, static_argnums=0)
def frame_of(
    family: Family,
    labels: RelativeLabels,
    step: Float[Array, " unknowns"] | None = None,
    mixed: Int[Array, " m"] | None = None,
) -> ObservationFrame:
    """Return the units for labels; `step`: of a family's unknowns; `mixed`: entries that may mix (default: none)."""
    weight = labels.valid / jnp.maximum(labels.valid.sum(), 1)
    mean = weight @ labels.obs
    deviation = jnp.sqrt(weight @ (labels.obs - mean[None]) ** 2)
    varies = deviation > 1e-5 * (1e-3 + jnp.abs(mean))
    for distortion in family:
        varies = varies.at[slice(*distortion.effect)].set(False)
    if step is None:
        step = jnp.where(varies, STEP * deviation, 0.0)
    mixed = jnp.zeros(0, jnp.int32) if mixed is None else mixed
    return ObservationFrame(mean, jnp.where(varies, deviation, 1.0), varies * 1.0, step, mixed)


@partial(jax.jit, static_argnums=0)
def jumps(space: Space, whole: Float[Array, "k n action"], eps: Number) -> Bool[Array, "n unknowns"]:
    """Return where the policy chooses something else, at a side of an unknown, or has no action at both.

    A policy that takes the best of far-apart actions does so near ties, where a slope says nothing. `whole`: what its
    actions at `sides` mean.
    """
    size = len(whole) // 2
    near, far = space.log(whole[:1], whole[1 : 1 + size]), space.log(whole[:1], whole[1 + size :])
    largest = jnp.fmax(jnp.abs(near), jnp.abs(far)) / (SCALE * eps)
    return ((largest > JUMP) & (jnp.abs(near + far) > 0.5 * jnp.abs(near - far)) | ~jnp.isfinite(largest)).any(-1).T


def sides(frame: ObservationFrame, change: Change) -> Float[Array, "k unknowns"]:
    """Return the unknowns of an estimate, and those at both sides of each."""
    steps, theta = jnp.diag(frame.step), change.theta[None]
    return jnp.concatenate([theta, theta - steps, theta + steps])


@partial(jax.jit, static_argnums=0)
def influence(space: Space, labels: RelativeLabels, whole: Float[Array, "k n action"]) -> Int[Array, " mixed"]:
    """Return the entries on which the policy's actions depend most, from what it does at `sides`."""
    size = len(whole) // 2
    slope = jnp.nan_to_num(space.log(whole[1 : 1 + size], whole[1 + size :]))
    return jax.lax.top_k(jnp.einsum("n,unc->u", labels.valid * 1.0, slope**2), min(MIXED, size))[1]


def data(
    space: Space,
    family: Family,
    frame: ObservationFrame,
    change: Change,
    labels: RelativeLabels,
    own: Actions,
    whole: Float[Array, "k n action"],
    eps: Float[Array, ""],
) -> Data:
    """Return the linear model at labels, about the estimate `change`; its weights count from no change.

    `own`: what the policy does about the labels' observations. `whole`: what its actions at `sides` mean in the changed
    world. `eps`: strength of an answer, in the unit of `space.log`.
    """
    scale, size = SCALE * eps, len(frame.step)
    base = jnp.where(jnp.isfinite(whole[0]), whole[0], own)
    low, high = whole[1 : 1 + size], whole[1 + size :]
    slope, below, above = space.log(low, high), space.log(low, base[None]), space.log(base[None], high)
    slope = jnp.where(jnp.isfinite(slope), slope, 2 * jnp.where(jnp.isfinite(above), above, below))
    slope = jnp.moveaxis(slope, 0, -1) / (2 * scale)
    slope = jnp.where(jumps(space, whole, eps)[:, None], 0.0, slope)
    x = features(space, frame, slope, labels.obs, base)
    cut = size + len(frame.mixed) ** 2
    offset = space.log(labels.action, base) / scale - x[:, :, :cut] @ weights_of(frame, change)[:cut]
    situation = inputs(space, frame, labels.obs, base if has_effects(family) else own)
    return Data(offset, x, situation, answers_of(space, labels, eps), groups(space, family, len(frame.mean)))


def answers_of(space: Space, labels: RelativeLabels, eps: Float[Array, ""]) -> Answers:
    """Return the interval that each answer names."""
    return intervals(labels.answer, labels.valid, *space.room(labels.action), TAU * eps)


def features(
    space: Space, frame: ObservationFrame, slope: Float[Array, "n cues u"], obs: Observations, base: Float[Array, "n a"]
) -> Float[Array, "n cues p"]:
    """Return the change of each cue by each weight."""
    n, cues, _ = slope.shape
    z = ((obs - frame.mean[None]) / frame.deviation[None])[:, frame.mixed]
    mixed = (-slope[:, :, frame.mixed, None] * z[:, None, None, :]).reshape(n, cues, len(frame.mixed) ** 2)
    cue, term = terms(cues, basis_size(space))
    return jnp.concatenate([slope, mixed, jnp.eye(cues)[:, cue][None] * basis(space, base)[:, None, term]], 2)


@partial(jax.jit, static_argnums=0)
def inputs(space: Space, frame: ObservationFrame, obs: Observations, action: Actions) -> Float[Array, "n z"]:
    """Return what the process sees: the observation, and what the policy does about it."""
    z = jnp.clip((obs - frame.mean[None]) / frame.deviation[None], -LARGEST, LARGEST) * frame.varies[None]
    return jnp.concatenate([z, 2 * space.even(action)], 1)


def weights_of(frame: ObservationFrame, change: Change) -> Float[Array, " p"]:
    """Return an estimate as weights of `features`."""
    step, own = jnp.where(frame.step > 0, frame.step, 1.0), change.action[tuple(terms(*change.action.shape))]
    if not len(frame.mixed):
        return jnp.concatenate([change.theta / step, own])
    theta = change.theta - change.mix @ (frame.mean - change.centre)
    mix = (change.mix * frame.deviation[None] / step[:, None])[frame.mixed][:, frame.mixed]
    return jnp.concatenate([theta / step, mix.ravel(), own])


def change_of(frame: ObservationFrame, weights: Float[Array, " p"], like: Change) -> Change:
    """Return the estimate that `weights_of` describes."""
    size, mixed = len(like.theta), len(frame.mixed)
    theta, mix, action = jnp.split(weights, (size, size + mixed**2))
    whole = jnp.zeros_like(like.mix)
    if mixed:
        part = mix.reshape(mixed, mixed) * frame.step[frame.mixed][:, None] / frame.deviation[frame.mixed][None]
        whole = whole.at[frame.mixed[:, None], frame.mixed[None]].set(part)
    action = jnp.zeros_like(like.action).at[tuple(terms(*like.action.shape))].set(action)
    return Change(theta * frame.step, whole, frame.mean, action)


def steps_of(space: Space, family: Family, acts: Acts, obs: Observations, eps: float) -> Float[Array, " unknowns"]:
    """Return the size of each unknown: its own scale, or the least that moves actions by `SCALE` eps.

    An unknown that moves no action so far has the size that moves actions by half of the most.
    """
    obs = jnp.asarray(obs)[:: max(1, len(obs) // STEP_SITUATIONS)][:STEP_SITUATIONS]
    target = min(SCALE * eps, float(space.from_unit(LARGEST_STEP * space.reach)))
    nothing, steps = no_change(space, family, obs.shape[1]), []
    for place, unknown in enumerate(unknowns_of(family)):
        if unknown.scale is not None:
            steps.append(unknown.scale)
            continue
        sizes = STEP_SIZES[max(unknown.most / 4, STEP_SIZES[0]) >= STEP_SIZES]
        thetas = jnp.zeros((1 + len(sizes), len(unknowns_of(family)))).at[1:, place].set(jnp.asarray(sizes))
        before = jax.vmap(lambda theta: undone(family, nothing.replace(theta=theta), obs))(thetas)
        actions = acts(before.reshape(-1, before.shape[-1])).reshape(*before.shape[:2], -1)
        effects = np.asarray(_effects(space, family, thetas, before, actions))
        effects = np.minimum(np.nan_to_num(effects), 3 * target).mean(1)
        enough = np.flatnonzero(effects >= min(target, 0.5 * max(effects.max(), 1e-12)))
        steps.append(float(sizes[enough[0]]) if effects.max() > 0 else float(sizes[-1]))
    return jnp.asarray(steps, jnp.float32)


@partial(jax.jit, static_argnames=("space", "family"))
def _effects(space: Space, family: Family, thetas: Array, before: Array, actions: Array) -> Array:
    whole = jax.vmap(partial(meant, family))(thetas, before, actions)
    return jnp.abs(space.log(whole[:1], whole[1:])).max(-1)
