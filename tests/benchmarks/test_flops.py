"""The operations that benchmarks count, by hand and by XLA."""

import dataclasses

import jax
import jax.numpy as jnp
import pytest
from _flops import forward, forward_and_backward, step_operations

from cuelearner_jax.agents import ddqn
from cuelearner_jax.agents.networks import as_function, q_network
from cuelearner_jax.agents.replay import Transition
from cuelearner_jax.config import Scalars
from cuelearner_jax.environment import Spaces
from cuelearner_jax.run_config import RunConfig
from cuelearner_jax.spaces import DIRECTIONS

LAYERS, OBS = (64, 48), 10
SPACES = Spaces(OBS, DIRECTIONS)
WIDTHS = (OBS, DIRECTIONS.size)
Q = as_function(q_network(LAYERS))


def test_operations_are_those_counted_by_hand():
    # Two numbers of an action and ten of an observation to 64, 64 to 48, 48 to 1: weights 128, 640, 3072, 48.
    assert forward(LAYERS, WIDTHS, 1) == 2 * (640 + 128 + 3072 + 48)
    assert forward(LAYERS, WIDTHS, 5) == 2 * 640 + 5 * 2 * (128 + 3072 + 48)
    # Weights' gradients of all layers; inputs' of all but the first.
    assert forward_and_backward(LAYERS, WIDTHS) == 2 * 3888 + 2 * 3888 + 2 * 3120
    agent = ddqn.Config(q_layers=LAYERS, directions=36, target_directions=12, batch_size=7)

    def counted(discount, **changes):
        changed = dataclasses.replace(agent, **changes)
        return step_operations(RunConfig(None, scalars=Scalars(discount=discount), agent=changed), SPACES)

    assert counted(0.0) == (2 * 640 + 36 * 2 * 3248, 7 * (4 * 3888 + 2 * 3120), 0)
    assert counted(0.0).total == 235136 + 152544
    target = 2 * 640 + 12 * 2 * 3248 + 2 * 3888
    assert counted(0.5).targets == 7 * target
    assert counted(0.5, n_step=30).targets == 2 * 7 * target
    assert counted(0.0, n_step=30).targets == 0


def traced_operations(function, *arguments):
    """XLA's own count, of the program before a backend's library calls, whose operations it does not know."""
    return jax.jit(function).lower(*arguments).cost_analysis()["flops"]


def test_operations_are_those_that_xla_counts():
    options = ddqn.Config(q_layers=LAYERS, directions=72, target_directions=72)
    agent, batch = options.make("raw", SPACES, bootstraps=True), 32
    params, _ = agent.init(jax.random.key(0))
    items = Transition(*(jnp.ones((batch, *shape)) for shape in ((OBS,), (2,), (), (), (OBS,))))
    acting = traced_operations(lambda p, obs: agent.act(None, p, obs, jax.random.key(0)), params, jnp.ones((1, OBS)))
    assert acting == pytest.approx(forward(LAYERS, WIDTHS, 72), rel=0.05)
    loss = jax.value_and_grad(lambda p: ddqn.loss(agent.value(None, p, items.obs, items.action), items.reward))
    gradient = traced_operations(loss, params)
    assert gradient == pytest.approx(batch * forward_and_backward(LAYERS, WIDTHS), rel=0.05)
    other = jax.tree.map(lambda leaf: leaf + 1, params)
    targets = traced_operations(lambda items: agent.targets(None, options, 0.9, params, other, [items]), items)
    assert targets == pytest.approx(batch * (forward(LAYERS, WIDTHS, 72) + forward(LAYERS, WIDTHS, 1)), rel=0.05)
