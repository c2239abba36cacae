"""The contract of an exported decision of a box names its cues and units."""

import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from box_task import GRIPPER, SCALARS, Reach
from probes import SIZES

from cuelearner_jax.export import contract, runner
from cuelearner_jax.guides import registry as guidances
from cuelearner_jax.policies import Guided, Opaque

ENV = Reach(GRIPPER)
ANGLES = np.linspace(0.0, 6.0, 8)
DRAWN = np.stack([np.cos(ANGLES), np.sin(ANGLES)], -1).astype(np.float32)


def test_the_contract_names_the_cues_of_the_space_and_zero_is_an_action(tmp_path):
    still, guidance = (
        Opaque(lambda obs: jnp.zeros((len(obs), 3)), actions=GRIPPER),
        guidances.make("relative", SIZES, ENV),
    )
    policy = Guided(still, guidance.init(jax.random.key(5)), ENV, SCALARS, guidance, jnp.float32(0.2))
    contract.write(policy, ENV, lambda: DRAWN, "numpy", tmp_path / "still", {})
    decide = runner.Decision(tmp_path / "still")
    np.testing.assert_array_equal(decide(DRAWN[0]), 0.0)
    with pytest.raises(runner.ContractError, match="that are not directions"):
        decide.angle(DRAWN[0])
    told = json.loads((tmp_path / "still" / runner.CONTRACT).read_text())["action"]
    assert (told["name"], told["size"], told["about"]) == ("reach", 3, "a vector of the box")
    assert told["space"] == GRIPPER.to_json()
    assert [cue["words"] for cue in told["space"]["cues"]] == [["left", "right"], ["up", "down"], ["open", "close"]]
    assert (told["clip_radius"], told["clip_radius_unit"]) == (pytest.approx(0.2), "shares")
    assert "angle" not in told
