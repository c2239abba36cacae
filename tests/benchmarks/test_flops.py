"""The operations that benchmarks count, by hand and by XLA."""

import jax
import jax.numpy as jnp
import pytest
from _flops import forward, forward_and_backward

from cuelearner_jax.agents import ddqn
from cuelearner_jax.agents.replay import Transition
from cuelearner_jax.environment import Spaces
from cuelearner_jax.spaces import DIRECTIONS

LAYERS, OBS = (64, 48), 10
SPACES = Spaces(OBS, DIRECTIONS)
WIDTHS = (OBS, DIRECTIONS.size)


def traced_operations(function, *arguments):
    """XLA's own count, of the program before a backend's library calls, whose operations it does not know."""
    return jax.jit(function).lower(*arguments).cost_analysis()["flops"]


def test_operations_are_those_that_xla_counts():
    options = ddqn.DdqnConfig(q_layers=LAYERS, directions=72, target_directions=72)
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
