"""Posterior of what changed: a linear model and a Gaussian process, known through intervals.

    f_c(s) = offset_c(s) + x_c(s) . u + g_c(s),   u_i ~ N(0, size of i),   g_c ~ GP(0, amplitude_c^2 k)

q(u, g) is the normal distribution with the largest evidence bound. It is held as pseudo-measurements: of each answer a
mean and a precision (`Sites`), from which one Cholesky factor a cue and one of the weights follow. Sizes, amplitudes,
length scales and the teacher's habits are raised along the same bound by Adam, each under a broad prior, in the same
iterations.

Source: Khan, Lin, "Conjugate-computation variational inference", AISTATS 2017; Adam et al., "Dual parameterization of
sparse variational Gaussian processes", NeurIPS 2021; sizes by evidence: MacKay, Neural Computation 1992.
"""

from __future__ import annotations

from functools import partial
from typing import Any, NamedTuple, cast

import jax
import jax.numpy as jnp
import optax
from flax import struct
from jaxtyping import Array, Float

from cuelearner_jax.devices import each_lane
from cuelearner_jax.reading.likelihood import Answers, Habits, curvature, expected_log_likelihood

ITERATIONS = 30
STEP = 0.15  # Adam's step of logarithms
DAMPING = 0.5  # share of a new site in each iteration
LEAST_PRECISION = 1e-3
SMALL = 64  # rows of a triangle that is inverted in one piece


class Data(struct.PyTreeNode):
    """Answers with the linear model at them; a change of 1 is `linear.SCALE` eps."""

    offset: Float[Array, "n cues"]  # from the action asked about to the policy's
    features: Float[Array, "n cues p"]
    inputs: Float[Array, "n z"]  # what the process sees
    answers: Answers
    group: tuple[int, ...] = struct.field(pytree_node=False)  # number of the group whose size a weight shares


class ModelParts(struct.PyTreeNode):
    """Which parts of the model a hypothesis has."""

    weights: Float[Array, " p"]  # 1, or 0 for a weight that the hypothesis lacks
    process: bool = struct.field(pytree_node=False)  # whether it has the Gaussian process


class Hyper(struct.PyTreeNode):
    """Logarithms of what the evidence decides; at zero each is its prior's middle."""

    groups: Float[Array, " groups"]
    sizes: Float[Array, " p"]
    amplitude: Float[Array, " cues"]
    amplitudes: Float[Array, ""]
    length: Float[Array, ""]  # of all entries of the observation
    lengths: Float[Array, " z"]
    tau: Float[Array, ""]
    width: Float[Array, ""]
    lapse: Float[Array, ""]
    actions: int = struct.field(pytree_node=False)  # entries of an action, the last of the process's inputs


# Middles of the priors of `Hyper`
SIZE = 0.55  # of a weight
AMPLITUDE = 0.5
LENGTH = 1.0  # times the root of the number of inputs
TAU = 0.5  # of eps
WIDTH = 0.5  # of eps
LAPSE = 0.05
# Spreads of the priors' logarithms
SPREADS = {"groups": 1.5, "sizes": 1.0, "amplitude": 1.0, "amplitudes": 0.5}
SPREADS |= {"length": 1.5, "lengths": 0.7, "tau": 0.7, "width": 0.7, "lapse": 0.7}


class Posterior(struct.PyTreeNode):
    """Normal posterior of the weights and the process, with the factors that predictions need."""

    mean: Float[Array, " p"]  # of the weights
    root: Float[Array, "p p"]  # covariance = root @ root.T
    alpha: Float[Array, "n cues"]  # the process is k(., inputs) alpha
    precision: Float[Array, "n cues"]  # of each answer's pseudo-measurement
    target: Float[Array, "n cues"]  # mean of it, a change from the action asked about
    hyper: Hyper
    bound: Float[Array, ""]  # of the log evidence


class _Solved(NamedTuple):
    mean: Array  # (n, cues) of f
    variance: Array
    weights: Array
    root: Array
    alpha: Array
    log_z: Array


def habits(hyper: Hyper, eps: Float[Array, ""] | float) -> Habits:
    """Return a teacher's habits; `eps`: strength of an answer in the unit of the changes."""
    lapse = jnp.clip(LAPSE * jnp.exp(hyper.lapse), 0.005, 0.6)
    return Habits(TAU * eps * jnp.exp(hyper.tau), WIDTH * eps * jnp.exp(hyper.width), lapse)


@jax.jit
def lengths(hyper: Hyper) -> Float[Array, " z"]:
    """Return the length scale of each input of the process."""
    size = len(hyper.lengths)
    return LENGTH * size**0.5 * jnp.exp(hyper.lengths + (jnp.arange(size) < size - hyper.actions) * hyper.length)


@jax.jit
def correlation(
    length: Float[Array, " z"], one: Float[Array, "n z"], other: Float[Array, "m z"]
) -> Float[Array, "n m"]:
    """Return the correlation of the process at two sets of inputs."""
    one, other = one / length[None], other / length[None]
    return jnp.exp(-0.5 * jnp.maximum((one**2).sum(-1)[:, None] + (other**2).sum(-1)[None] - 2 * one @ other.T, 0.0))


def amplitudes(hyper: Hyper) -> Float[Array, " cues"]:
    """Return the standard deviation of the process along each cue."""
    return AMPLITUDE * jnp.exp(hyper.amplitudes + hyper.amplitude)


@jax.jit
def process(posterior: Posterior, labelled: Float[Array, "n z"], inputs: Float[Array, "m z"]) -> Float[Array, "m cues"]:
    """Return the mean of the process at `inputs`; `labelled`: those of the answers."""
    amplitude = amplitudes(posterior.hyper)[None]
    return amplitude**2 * (correlation(lengths(posterior.hyper), inputs, labelled) @ posterior.alpha)


def _solve(hyper: Hyper, parts: ModelParts, data: Data, precision: Array, target: Array) -> _Solved:
    """Return the posterior under pseudo-measurements `target` (n, cues) of f with `precision`."""
    size = parts.weights * SIZE * jnp.exp(hyper.groups[jnp.array(data.group)] + hyper.sizes)
    x = data.features * size[None, None]  # (n, cues, p)
    residual, away = target - data.offset, jnp.moveaxis(x, 1, 0)  # (cues, n, p)
    root = jnp.sqrt(precision).T  # (cues, n)
    hx, hr = root[:, :, None] * away, root * residual.T
    whitened = hx, hr, jnp.zeros_like(root)  # without the process there is noise alone, which is 1 in its own units
    logs, prior = jnp.zeros(()), jnp.zeros(residual.shape[1])
    if parts.process:
        prior = amplitudes(hyper)
        correlations = correlation(lengths(hyper), data.inputs, data.inputs)
        *whitened, logs = each_lane(partial(_whitened, correlations))(hx, hr, root, prior)
    of_x, of_r, own = whitened
    inner = jnp.linalg.cholesky(jnp.eye(len(size)) + jnp.einsum("cnp,cnq->pq", hx, of_x))
    solve = partial(jax.scipy.linalg.solve_triangular, inner, lower=True)
    vector = solve(jnp.einsum("cnp,cn->p", hx, of_r))
    weights = jax.scipy.linalg.solve_triangular(inner.T, vector, lower=False)  # in units of size
    rest = of_r - of_x @ weights  # (cues, n)
    noise = jnp.where(root > 0, 1 / jnp.where(root > 0, root, 1.0), 0.0)  # none of what was not answered
    mean = data.offset + x @ weights + (noise * (hr - hx @ weights - rest)).T
    away = away - noise[:, :, None] * (hx - of_x)
    variance = jnp.where(root > 0, own * noise**2, (prior**2)[:, None])
    spread = (solve(away.reshape(-1, len(size)).T) ** 2).sum(0).reshape(away.shape[:2])
    log_z = -0.5 * (logs.sum() + 2 * jnp.log(jnp.diag(inner)).sum() + (hr * of_r).sum() - (vector**2).sum())
    covariance_root = size[:, None] * jax.scipy.linalg.solve_triangular(inner.T, jnp.eye(len(size)), lower=False)
    variance = jnp.maximum((variance + spread).T, 1e-8)
    alpha = (root * rest).T if parts.process else jnp.zeros_like(residual)
    return _Solved(mean, variance, size * weights, covariance_root, alpha, log_z)


def _whitened(
    correlations: Array, hx: Array, hr: Array, root: Array, amplitude: Array
) -> tuple[Array, Array, Array, Array]:
    """Return one cue's features and residuals times the inverse of process and noise, in units of the noise.

    Also the diagonal of 1 minus that inverse, which is the variance of the process in these units, and the logarithm
    of its determinant.
    """
    inverse, logs = _inverse(jnp.eye(len(root)) + amplitude**2 * root[:, None] * correlations * root[None])
    return _product(inverse, hx), _product(inverse, hr), 1 - jnp.diag(inverse), logs


@jax.custom_vjp
def _inverse(whole: Float[Array, "n n"]) -> tuple[Float[Array, "n n"], Float[Array, ""]]:
    """Return the inverse of a positive definite matrix, and the logarithm of its determinant.

    Their slopes are two products of matrices, where those of a Cholesky factor are several slow solutions.
    """
    factor = jnp.linalg.cholesky(whole)
    root = _inverse_of_triangle(factor)
    return _product(root.T, root), 2 * jnp.log(jnp.diag(factor)).sum()


def _slopes(inverse: Array, slopes: tuple[Array, Array]) -> tuple[Array]:
    of_inverse, of_logs = slopes
    return (of_logs * inverse - _product(_product(inverse, of_inverse), inverse),)


_inverse.defvjp(lambda whole: (both := _inverse(whole), both[0]), _slopes)
_product = partial(jnp.matmul, precision="highest")  # on a GPU too


def _inverse_of_triangle(factor: Float[Array, "n n"]) -> Float[Array, "n n"]:
    """Return the inverse of a lower triangle, by halves: products of matrices are the fastest there is."""
    half = len(factor) // 2
    if half < SMALL:
        return jax.scipy.linalg.solve_triangular(factor, jnp.eye(len(factor)), lower=True)
    first, last = _inverse_of_triangle(factor[:half, :half]), _inverse_of_triangle(factor[half:, half:])
    below = -_product(_product(last, factor[half:, :half]), first)
    return jnp.block([[first, jnp.zeros((half, len(last)))], [below, last]])


def _log_prior(hyper: Hyper, parts: ModelParts) -> Array:
    own = hyper.replace(sizes=hyper.sizes * parts.weights)
    return -0.5 * jnp.stack([((getattr(own, name) / spread) ** 2).sum() for name, spread in SPREADS.items()]).sum()


def infer(data: Data, parts: ModelParts, eps: Float[Array, ""], start: Posterior) -> Posterior:
    """Return the posterior of one hypothesis, and its evidence.

    `eps`: strength of an answer, in the unit of the changes. `start`: `unread`, or what was read before.
    """
    answers = data.answers
    optimizer = optax.adam(STEP)
    # Only who claims no change learns tau: a change beside a wide tau has several optima, some far from the truth.
    learns_tau = 0.0 if parts.process else 1.0 * ~parts.weights.any()

    def bound(hyper: Hyper, precision: Array, target: Array) -> tuple[Array, _Solved]:
        solved = _solve(hyper, parts, data, precision, target)
        likelihood = expected_log_likelihood(solved.mean, solved.variance, answers, habits(hyper, eps)).sum()
        fit = 0.5 * (precision * ((target - solved.mean) ** 2 + solved.variance)).sum()
        return likelihood + fit + solved.log_z + _log_prior(hyper, parts), solved

    def update(carry: tuple, _: None) -> tuple[tuple, None]:
        hyper, state, precision, target = carry
        (_, solved), slope = jax.value_and_grad(bound, has_aux=True)(hyper, precision, target)
        first, second = curvature(solved.mean, solved.variance, answers, habits(hyper, eps))
        site = jnp.where(answers.valid, jnp.maximum(-second, LEAST_PRECISION), 0.0)
        both = (1 - DAMPING) * precision + DAMPING * site
        natural = (1 - DAMPING) * precision * target + DAMPING * (site * solved.mean + first)
        target = jnp.where(both > 0, natural / jnp.maximum(both, 1e-12), 0.0)
        slope = slope.replace(tau=learns_tau * slope.tau)
        changes, state = optimizer.update(jax.tree.map(jnp.negative, slope), state)
        return (jax.tree.map(jnp.add, hyper, changes), state, both, target), None

    first = (start.hyper, optimizer.init(cast(Any, start.hyper)), start.precision, start.target)
    (hyper, _, precision, target), _ = jax.lax.scan(update, first, None, ITERATIONS)
    worth, solved = bound(hyper, precision, target)
    return Posterior(solved.weights, solved.root, solved.alpha, precision, target, hyper, worth)


def unread(data: Data, hyper: Hyper) -> Posterior:
    """Return the posterior before the first iteration."""
    p = data.features.shape[-1]
    precision = jnp.where(data.answers.valid, jnp.full_like(data.offset, LEAST_PRECISION), 0.0)  # not weakly typed
    zero = jnp.zeros(())
    return Posterior(jnp.zeros(p), jnp.zeros((p, p)), jnp.zeros_like(data.offset), precision, data.offset, hyper, zero)


def predict(
    posterior: Posterior, data: Data, parts: ModelParts, features: Float[Array, "m cues p"], inputs: Float[Array, "m z"]
) -> tuple[Float[Array, "m cues"], Float[Array, "m cues"]]:
    """Return mean and variance of x . u + g in other situations."""
    mean, eye = features @ posterior.mean, jnp.eye(len(data.inputs))
    if not parts.process:
        return mean, jnp.maximum(((features @ posterior.root) ** 2).sum(-1), 1e-8)
    hyper, amplitude = posterior.hyper, amplitudes(posterior.hyper)
    cross = correlation(lengths(hyper), data.inputs, inputs)  # (n, m)
    correlations = correlation(lengths(hyper), data.inputs, data.inputs)

    def of_cue(x: Array, train: Array, w: Array, a: Array) -> Array:
        root = jnp.sqrt(w)
        factor = jnp.linalg.cholesky(eye + root[:, None] * (a**2 * correlations) * root[None])
        half = partial(jax.scipy.linalg.solve_triangular, factor, lower=True)
        hk, hx = half(root[:, None] * a**2 * cross), half(root[:, None] * train)
        return a**2 - (hk**2).sum(0) + (((x - hk.T @ hx) @ posterior.root) ** 2).sum(-1)

    rows = jnp.moveaxis(features, 1, 0), jnp.moveaxis(data.features, 1, 0), posterior.precision.T, amplitude
    mean = mean + process(posterior, data.inputs, inputs)
    return mean, jnp.maximum(each_lane(of_cue)(*rows).T, 1e-8)
