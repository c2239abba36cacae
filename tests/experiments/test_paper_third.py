"""The study of the paper's third: its pieces would begin, and its own kind and teacher do what they say."""

import _from_chance as from_chance
import jax.numpy as jnp
import numpy as np
import paper_third
import probes
import pytest
from _agent_teacher import TASK, AgentTeacher
from _coarse_step import STEP, Chipmunk
from _pieces import sweep_command

from cuelearner_envs.billiards.config import BilliardsConfig
from cuelearner_envs.billiards.table import Table
from cuelearner_jax.cli import main
from cuelearner_jax.environment import spaces_of
from cuelearner_jax.errors import UserError
from cuelearner_jax.guides import registry
from cuelearner_jax.runs.order import make_plan
from cuelearner_jax.spaces.directions import evenly_spaced
from cuelearner_jax.studies import train

ENV, OBS = probes.Window(), evenly_spaced(4)


@pytest.fixture(autouse=True)
def own_kinds():
    """Those that an experiment brings along are gone after it."""
    kinds = dict(registry._KINDS)
    yield
    registry._KINDS.clear()
    registry._KINDS.update(kinds)


@pytest.mark.long
def test_its_pieces_are_sweeps_that_would_begin_on_the_same_seeds(monkeypatch, tmp_path):
    orders = []
    monkeypatch.setattr(train, "run", lambda order: orders.append(make_plan(order).order))
    pieces = [piece for piece in paper_third.PIECES if piece.world == "third" and piece.run != "by-an-agent"]
    for piece in pieces:
        assert main(sweep_command(paper_third.EXPERIMENT.task, piece, tmp_path, resume=False)) == 0, piece.path
    assert {order.grid.seeds for order in orders} == {tuple(range(4000, 4016))}
    assert {order.config.sizes.frame for order in orders} == {"raw"}
    assert [order.config.sizes.fit_steps * 500 / 800 for order in orders][-1] == 10_000  # epochs


def test_uniform_actions_are_refined_the_same_in_the_same_situation():
    guide = from_chance.KIND.make(probes.SIZES, spaces_of(ENV))
    model, active = guide.init(from_chance.key_of(OBS[0])), jnp.array([True, True, True, False])
    still = guide.act(model, ENV, OBS, OBS, active, probes.SCALARS)
    np.testing.assert_array_equal(still.actions, OBS)  # nothing is fitted yet
    fitted = model.replace(fitted=jnp.array(True))
    one, other = (guide.act(fitted, ENV, OBS, base, active, probes.SCALARS).actions for base in (OBS, OBS[::-1]))
    np.testing.assert_array_equal(one[:3], other[:3])  # whatever the agent did
    np.testing.assert_array_equal(other[3], OBS[0])
    assert len({round(float(x), 3) for x in one[:3, 0]}) == 3


def test_an_agent_means_its_own_action():
    class Agent:
        def act(self, key, states, obs):
            return -obs

    np.testing.assert_array_equal(AgentTeacher(Agent()).best_action(None, OBS[1]), -OBS[1])


def test_chipmunk_plays_what_is_on_the_table():
    from pymunk_table import PymunkTable, scenes

    places, angles = scenes(Table.regulation(), 3, 0)
    pocketed = np.array([[False] * 4, [False, True, False, False], [False, False, True, True]])
    played = Chipmunk("regulation", STEP)(places.astype(np.float32), pocketed, angles)
    game = PymunkTable(Table.regulation(), STEP)
    for place, out, angle, rests, fell, lasted in zip(places, pocketed, angles, *played[:3], strict=True):
        own = game.play(place[~out].astype(np.float32), float(angle))
        np.testing.assert_allclose(rests[~out], own[0], atol=1e-6)
        np.testing.assert_array_equal(fell[~out], own[1])
        assert fell[out].all()
        assert lasted == pytest.approx(own[2])


def test_chipmunk_is_a_body_of_the_study_and_refuses_a_tilt():
    there = TASK.on("chipmunk")
    assert there.environment(BilliardsConfig("regulation")).engine == Chipmunk("regulation", 0.02)
    with pytest.raises(UserError, match="the table in Chipmunk is level: leave out --task"):
        there.environment(BilliardsConfig(acceleration=(0.0, 0.005)))
