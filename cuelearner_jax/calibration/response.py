"""A policy's response to changed observations: asked at few nodes, interpolated between them by kriging.

A policy is expensive to call, its actions jump, and every family needs it for the same changes of the observation. So
the policy is called at few nodes in the unknowns of all families. Between the nodes a Gaussian process with a linear
trend and a nugget (Rasmussen and Williams, 2006, chapter 2) gives mean and variance. Rows share length and nugget; each
row has its own size.
"""

from __future__ import annotations

from itertools import product
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from cuelearner_jax.calibration.families import Family, unknowns_of
from cuelearner_jax.calibration.meaning import Meaning

Floats = np.ndarray
AXIS = (0.35, 1.2)  # distances of the first nodes from no change, in prior scales
MOST = 28  # nodes
CLIP = 10.0  # [eps]: larger offsets are clipped
TREND = 100.0  # variance of the trend, relative to the residual variance
LENGTHS, NUGGETS = (0.15, 0.5, 2.0), (1e-3, 0.1, 0.6)  # lengths in prior scales; nuggets as shares of the variance
LEAST = 0.05  # [eps]: least standard deviation of a row
RELEVANT = 0.02  # weight of nodes that are unlikely given the answers


class Response(NamedTuple):
    """A policy's actions in some situations at nodes."""

    nodes: Float[Floats, "nodes unknowns"]  # in prior scales
    centre: Float[Floats, "n action"]  # actions that offsets start from
    offset: Float[Floats, "nodes n cues"]  # [eps]
    relevance: Float[Floats, " nodes"]  # weight of each node in the estimate of a row's size
    length: float
    nugget: float

    def at(self, theta: Float[Floats, "samples unknowns"]) -> tuple[Floats, Floats]:
        """Return mean and standard deviation (samples, n, cues) of the offset [eps] at thetas in prior scales."""
        if len(self.nodes) == 1:
            mean = np.broadcast_to(self.offset, (len(theta), *self.offset.shape[1:]))
            return mean, np.zeros_like(mean)
        inverse = np.linalg.inv(_covariance(self.nodes, self.length, self.nugget))
        cross = _kernel(theta, self.nodes, self.length)
        own = 1 + TREND * (1 + np.square(theta).sum(-1))
        variance = np.maximum(own - np.einsum("sk,kl,sl->s", cross, inverse, cross), 0.0) + self.nugget
        weights = np.einsum("kl,lnc->knc", inverse, self.offset)
        left_out = np.square(weights) / np.diag(inverse)[:, None, None]  # scaled squared leave-one-out errors
        size = np.einsum("k,knc->nc", self.relevance / self.relevance.sum(), left_out) + LEAST**2
        return np.einsum("sk,knc->snc", cross, weights), np.sqrt(variance[:, None, None] * size)


class Responses:
    """Asks a policy at nodes, and caches its answers.

    Args:
        meaning: the policy.
        asks: all distortions that change what is seen, or what an action leads to.
        scales: prior scales of their unknowns.
        eps: strength of an answer, as `space.log` counts.
    """

    def __init__(self, meaning: Meaning, asks: Family, scales: dict[str, float], eps: float) -> None:
        self.meaning, self.asks, self.eps = meaning, asks, eps
        self.names = [one.name for one in unknowns_of(asks)]
        self.scale = np.array([scales[name] for name in self.names])
        size = len(self.names)
        axis = np.concatenate([side * far * np.eye(size) for far in AXIS for side in (-1, 1)])
        self.nodes: Floats = np.concatenate([np.zeros((1, size)), axis])[: 1 + 4 * size]
        self.relevance = np.ones(len(self.nodes))
        self.smooth = (LENGTHS[1], NUGGETS[1])
        self.known: dict[tuple[bytes, bytes], Floats] = {}

    def add_nodes(self, draws: Float[Floats, "draws unknowns"], fresh: int, random: np.random.Generator) -> None:
        """Take draws of the posterior, in prior scales: add nodes there, and drop the nodes farthest away."""
        if not self.names:
            return
        spread = np.sqrt(draws.var(0) + 0.1**2)
        for _ in range(fresh):
            apart = np.square((draws[:, None] - self.nodes[None]) / spread).sum(-1).min(1)
            chosen = random.choice(len(draws), p=(apart + 1e-9) / (apart + 1e-9).sum())
            self.nodes = np.concatenate([self.nodes, draws[chosen][None]])
        apart = np.square((draws[:, None] - self.nodes[None]) / spread).sum(-1)
        self.relevance = np.exp(-0.5 * apart).mean(0) + RELEVANT
        kept = np.sort(np.concatenate([[0], 1 + np.argsort(-self.relevance[1:], kind="stable")[: MOST - 1]]))
        self.nodes, self.relevance = self.nodes[kept], self.relevance[kept]

    def covering(self, draws: Float[Floats, "draws unknowns"], count: int) -> Int[Floats, " nodes"]:
        """Return the numbers of so many nodes, spread over the posterior."""
        apart = np.square(draws[:, None] - self.nodes[None]).sum(-1)
        chosen = [int(self.relevance.argmax())]
        while len(chosen) < min(count, len(self.nodes)):
            left = np.setdiff1d(np.arange(len(self.nodes)), chosen)
            farthest = apart[:, chosen].min(1).argmax()
            chosen.append(int(left[apart[farthest, left].argmin()]))
        return np.array(chosen)

    def respond(
        self, obs: Float[Floats, "n obs"], among: Int[Floats, " nodes"] | None = None, learn: bool = True
    ) -> Response:
        """Return the policy's response in these situations; `learn`: also fit length and nugget to them."""
        among = np.arange(len(self.nodes)) if among is None else among
        nodes, relevance = self.nodes[among], self.relevance[among]
        actions = self._asked(nodes, obs)
        centre = actions[relevance.argmax()]
        none = np.zeros((len(nodes), 0))
        offset = np.clip(self.meaning.offsets((), none, actions, centre) / self.eps, -CLIP, CLIP)
        if learn and len(nodes) > 1:
            self.smooth = _smoothness(nodes, offset.reshape(len(nodes), -1))
        return Response(nodes, centre, offset, relevance, *self.smooth)

    def _asked(self, nodes: Floats, obs: Floats) -> Floats:
        """Return actions (nodes, n, action); ask the policy only for those that are not cached."""
        keys = [[(node.tobytes(), row.tobytes()) for row in obs] for node in nodes]
        missing = np.array([[key not in self.known for key in row] for row in keys])
        for pattern in np.unique(missing, axis=1).T:  # nodes with the same missing rows are asked together
            rows = np.flatnonzero((missing == pattern[:, None]).all(0))
            if not pattern.any():
                continue
            wanted = np.flatnonzero(pattern)
            found = self.meaning.actions(self.asks, nodes[wanted] * self.scale, obs[rows])
            self.known.update(
                {keys[node][row]: found[i, j] for i, node in enumerate(wanted) for j, row in enumerate(rows)}
            )
        return np.array([[self.known[key] for key in row] for row in keys])


def _kernel(one: Floats, other: Floats, length: float) -> Floats:
    apart = np.sqrt(np.square(one[:, None] - other[None]).sum(-1))
    return np.exp(-apart / length) + TREND * (1 + one @ other.T)


def _covariance(nodes: Floats, length: float, nugget: float) -> Floats:
    return _kernel(nodes, nodes, length) + nugget * np.eye(len(nodes))


def _smoothness(nodes: Floats, rows: Float[Floats, "nodes rows"]) -> tuple[float, float]:
    """Return the maximum-likelihood length and nugget, with each row's own size."""

    def log_likelihood(length: float, nugget: float) -> float:
        covariance = _covariance(nodes, length, nugget)
        fit = (rows * np.linalg.solve(covariance, rows)).sum(0) + len(nodes) * LEAST**2
        return -0.5 * (len(nodes) * np.log(fit).sum() + rows.shape[1] * np.linalg.slogdet(covariance)[1])

    return max(product(LENGTHS, NUGGETS), key=lambda pair: log_likelihood(*pair))
