"""The walking policy: its file, its network against brax's, its tracking in C MuJoCo, and the counting by hand."""

import itertools
import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from cuelearner_envs.anymal import model as robot
from cuelearner_envs.anymal import policy, tracking


def test_the_network_is_the_mean_of_braxs_policy():
    from brax.training.acme import running_statistics, specs
    from brax.training.agents.ppo import networks

    made = networks.make_ppo_networks(
        policy.OBS, robot.JOINTS, running_statistics.normalize, policy_hidden_layer_sizes=(32, 16)
    )
    seen = running_statistics.init_state(specs.Array((policy.OBS,), jnp.dtype("float32")))
    obs = jax.random.normal(jax.random.key(1), (64, policy.OBS)) * 3 + 1
    seen = running_statistics.update(seen, obs)
    params = (seen, made.policy_network.init(jax.random.PRNGKey(0)), None)
    wanted, _ = networks.make_inference_fn(made)(params, deterministic=True)(obs, jax.random.PRNGKey(2))
    np.testing.assert_allclose(policy.from_brax(params)(obs), wanted, atol=1e-5)


def test_a_saved_policy_acts_as_before(tmp_path):
    rng, sizes = np.random.default_rng(0), (policy.OBS, 16, 8, robot.JOINTS)
    layers = [(rng.normal(size=pair) / 8, rng.normal(size=pair[1]) / 8) for pair in itertools.pairwise(sizes)]
    own = policy.WalkingPolicy(rng.normal(size=policy.OBS), rng.uniform(0.5, 2.0, policy.OBS), tuple(layers))
    single = jax.tree.map(lambda leaf: jnp.asarray(leaf, jnp.float32), own)
    policy.save(tmp_path / "kept", single, {"seed": 3})
    obs = jax.random.normal(jax.random.key(0), (100, policy.OBS))
    np.testing.assert_allclose(policy.load(tmp_path / "kept")(obs), single(obs), atol=5e-3)  # kept in half precision
    assert json.loads((tmp_path / "kept" / policy.ABOUT).read_text()) == {"seed": 3}
    assert sorted(path.name for path in (tmp_path / "kept").iterdir()) == [policy.ABOUT, policy.WEIGHTS]


def test_errors_count_where_commands_are_settled_and_the_robot_stands():
    steps, settling = 2 * tracking.HELD, tracking.SETTLING
    velocities, commands = np.zeros((steps, 2, 3)), np.zeros((steps, 2, 3))
    commands[..., 0] = 1.0
    velocities[:settling, :, 0] = -5.0  # before it is settled: does not count
    velocities[settling : tracking.HELD, :, 0] = np.where(np.arange(settling) % 2, 1.3, 0.9)[:, None]  # sways about 1.1
    velocities[tracking.HELD :, :, 0], velocities[tracking.HELD :, :, 2] = 1.0, 0.2
    down = np.zeros((steps, 2), bool)
    down[tracking.HELD + settling + 1 :, 1] = True  # the second robot falls during its second command
    found = tracking.figures(velocities, commands, down)
    assert found["error"] == pytest.approx((0.1 + 0.1 + 0.0) / 3)
    assert found["momentary_error"] == pytest.approx((0.2 + 0.2 + 0.0) / 3)
    assert found["turning_error"] == pytest.approx(0.2 / 3)
    assert found["falls"] == 0.5
    assert found["seconds"] == 8.0


@pytest.fixture(scope="module")
def shipped():
    return policy.load()


@pytest.mark.long
@pytest.mark.parametrize(("trial", "error", "falls"), [("clean", 0.05, 0), ("disturbed", 0.08, 1), ("varied", 0.08, 1)])
def test_the_shipped_policy_tracks_random_commands(shipped, trial, error, falls):
    robots = 12
    found = tracking.measure(shipped, "mujoco", tracking.TRIALS[trial], jax.random.key(7), robots)
    assert found["error"] < error
    assert found["falls"] * robots <= falls
