"""Floating point operations of training, counted from the sizes of its networks: a multiply and an add are two.

Counted is the matrix arithmetic of the action values alone. The environment, the guidance, the optimiser (a few
operations a weight, against 6 a weight and row of a batch) and activations are not, so that a share of the machine's
matmul rate is what the networks get of it. Of an argmax near peaks, the values that are taken are counted.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import NamedTuple

from cuelearner_jax.agents import networks
from cuelearner_jax.agents.choice import values_per_choice
from cuelearner_jax.environment import Spaces
from cuelearner_jax.run_config import RunConfig


class Operations(NamedTuple):
    """Floating point operations of one environment step of one seed, with the gradient steps that follow it."""

    acting: int  # the values among which the argmax is taken
    gradient: int  # forward and backward through the batch
    targets: int  # the argmax inside targets and the value of its choice; 0 where nothing bootstraps

    @property
    def total(self) -> int:
        """Sum of all parts."""
        return sum(self)


def step_operations(config: RunConfig, spaces: Spaces) -> Operations:
    """Operations of one environment step, of a run of double DQN in an environment with these spaces."""
    own, widths = config.agent, networks.widths(config.sizes.frame, spaces)
    rows = own.batch_size * (2 if own.n_step > 1 else 1) if config.bootstraps else 0
    return Operations(
        acting=forward(own.q_layers, widths, values_per_choice(own.directions, own.coarse_directions, own.peaks)),
        gradient=own.batch_size * forward_and_backward(own.q_layers, widths),
        targets=rows * (forward(own.q_layers, widths, own.target_directions) + forward(own.q_layers, widths, 1)),
    )


def forward(layers: Sequence[int], widths: tuple[int, int], actions: int) -> int:
    """Values of so many actions in one state. What hangs on no action enters the first layer once a state."""
    first, later = _weights(layers, widths[1])
    return 2 * (widths[0] * layers[0] + actions * (first + later))


def forward_and_backward(layers: Sequence[int], widths: tuple[int, int]) -> int:
    """The value of one action and its gradient: 2 a weight forward, 4 backward (gradients of weights and of inputs).

    Nobody asks for the gradient of the first layer's inputs.
    """
    first, later = _weights(layers, widths[1])
    return 4 * (widths[0] * layers[0] + first) + 6 * later


def _weights(layers: Sequence[int], turned: int) -> tuple[int, int]:
    """Weights from the entries of an action to the first layer, and of all later layers with the output."""
    return turned * layers[0], sum(a * b for a, b in pairwise([*layers, 1]))
