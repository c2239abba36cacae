"""Exported decisions of a box: refined by the space's log and exp, and the contract that names its cues and units."""

import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from box_task import GRIPPER, SCALARS, Reach
from probes import AGENT, SIZES

import cuelearner_jax as cl
from cuelearner_jax.environment import spaces_of
from cuelearner_jax.export import contract, runner
from cuelearner_jax.guides import registry as guidances
from cuelearner_jax.policies import Agent, Guided, Opaque

ENV = Reach(GRIPPER)
ANGLES = np.linspace(0.0, 6.0, 24)
DRAWN = np.stack([np.cos(ANGLES), np.sin(ANGLES)], -1).astype(np.float32)
BOUND = 0.2
GRAPHS = ("numpy", "onnx")


def guided(kind="relative"):
    """An untrained guide moves the actions of an untrained agent as a trained one does."""
    functions = AGENT.make("raw", spaces_of(ENV))
    base = Agent(functions.init(jax.random.key(4))[0], functions, ENV)
    guidance = guidances.make(kind, SIZES, ENV)
    model = guidance.init(jax.random.key(5)).replace(fitted=jnp.array(True))
    return Guided(base, model, ENV, SCALARS, guidance, jnp.float32(BOUND)), base


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    home = tmp_path_factory.mktemp("exported")
    for format in GRAPHS:
        contract.write(guided()[0], ENV, lambda: DRAWN, format, home / format, {"subject": "test"})
    return home


@pytest.mark.parametrize("format", GRAPHS)
def test_a_decision_in_a_box_is_the_policys_within_its_bound(folder, format):
    policy, base = guided()
    wanted, own = (np.asarray(one.act(jax.random.key(0), None, jnp.asarray(DRAWN))) for one in (policy, base))
    decide = cl.load_exported(folder / format)
    found = decide(DRAWN)
    apart = np.abs(found - wanted).max(-1)
    assert (apart <= 1e-5).mean() >= 0.9, apart  # where two values tie, either is right
    moved = np.abs(GRIPPER.log(own, found))
    assert moved.max() > 0.01
    assert np.quantile(moved, 0.9) <= BOUND + 1e-5
    assert decide(DRAWN[0]).shape == (3,)
    with pytest.raises(runner.ContractError, match="that are not directions"):
        decide.angle(DRAWN[0])


def test_the_contract_names_the_cues_of_the_space(folder):
    told = json.loads((folder / "numpy" / runner.CONTRACT).read_text())["action"]
    assert (told["name"], told["size"], told["about"]) == ("reach", 3, "a vector of the box")
    assert told["space"] == GRIPPER.to_json()
    assert [cue["words"] for cue in told["space"]["cues"]] == [["left", "right"], ["up", "down"], ["open", "close"]]
    assert (told["clip_radius"], told["clip_radius_unit"]) == (pytest.approx(BOUND), "shares")
    assert "angle" not in told


def test_zero_is_an_action_of_a_box(tmp_path):
    policy = Opaque(lambda obs: jnp.zeros((len(obs), 3)), actions=GRIPPER)
    contract.write(policy, ENV, lambda: DRAWN, "numpy", tmp_path / "still", {})
    np.testing.assert_array_equal(runner.Decision(tmp_path / "still")(DRAWN[0]), 0.0)
