import jax
import jax.numpy as jnp
import numpy as np
from billiards_scenes import BATCH, EASY, KEY, SCENE, balls, observe, step_many, toward

from cuelearner_envs.billiards import simulate
from cuelearner_envs.billiards.config import BilliardsConfig, make_environment
from cuelearner_envs.billiards.sketch import record
from cuelearner_envs.billiards.table import rack
from cuelearner_jax.policies import Heuristic
from cuelearner_jax.spaces import directions

step = jax.jit(lambda env, key, state, action: env.step(key, state, action))
reset = jax.jit(lambda env, key: env.reset(key))
shoot = jax.jit(simulate)


CORNER = balls([(0.2, 0.0), (0.35, 0.15), (-0.3, 0.1), (-0.3, -0.1)])  # ball 1 lies between the cue ball and a corner
FOUL = balls([(0.3, 0.1), (-0.2, 0.0), (-0.3, 0.1), (-0.3, -0.1)])  # nothing lies between the cue ball and a corner
CORNERWARDS, NOWHERE = toward(45.0), toward(90.0)  # NOWHERE: in all these scenes the cue ball stays on a line across
PARKED = [
    (-0.32, 0.26),
    (-0.26, 0.26),
    (-0.20, 0.26),
]  # beside the easy table: 1.5 diameters apart, as far above the edge


def test_the_observation_lists_the_cue_ball_then_targets_from_the_top_and_from_the_left():
    expected = [-0.2, 0.0, -0.5, 0.0, 0.1, -0.5, 0.3, 0.1, -0.5, 0.1, -0.1, -0.5]
    np.testing.assert_allclose(observe(EASY, SCENE), expected, atol=1e-7)


def test_pocketed_balls_come_first_and_stand_in_a_row_beside_the_table():
    seen = observe(EASY, balls([(-0.2, 0.0), (0.1, -0.1), (9.0, -9.0), (9.0, 9.0)], (False, False, True, True)))
    expected = [(-0.2, 0.0, -0.5), (*PARKED[0], 0.5), (*PARKED[1], 0.5), (0.1, -0.1, -0.5)]
    np.testing.assert_allclose(seen, np.ravel(expected), atol=1e-7)


def test_a_sensor_bias_shifts_the_balls_on_the_table_and_not_those_beside_it():
    biased = make_environment(BilliardsConfig("easy", observation_bias=(0.0071, 0.003)))
    state = balls(SCENE.positions, (False, False, False, True))
    seen = np.asarray(observe(biased, state) - observe(EASY, state)).reshape(4, 3)
    shifted = [0.0071, 0.003, 0.0]
    np.testing.assert_allclose(seen, [shifted, [0.0, 0.0, 0.0], shifted, shifted], atol=1e-7)


def test_a_ball_shot_into_a_corner_is_worth_one():
    after, result = step(EASY, KEY, CORNER, CORNERWARDS)
    assert float(result.reward) == 1.0
    assert after.pocketed.tolist() == [False, True, False, False]
    assert {name: float(value) for name, value in result.metrics.items()} == {"scored": 1, "foul": 0, "exhausted": 0}
    assert (bool(result.terminated), bool(result.truncated), int(after.shots)) == (False, False, 1)


def test_the_reward_counts_the_balls_of_this_shot_alone():
    _, result = step(EASY, KEY, balls(CORNER.positions, (False, False, False, True)), CORNERWARDS)
    assert float(result.reward) == 1.0  # another one has fallen before
    scene = balls([(0.2, 0.0), (0.33, 0.16), (0.37, 0.14), (-0.3, -0.1)])  # two before the same corner
    after, result = step(EASY, KEY, scene, toward(47.0))  # 45.7 .. 48.0
    assert float(result.reward) == 2.0
    assert after.pocketed.tolist() == [False, True, True, False]


def test_a_foul_puts_every_ball_back_and_the_cue_ball_somewhere_free_on_the_left():
    fouls = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (BATCH, *leaf.shape)), FOUL)
    after, result = step_many(EASY, jax.random.split(KEY, BATCH), fouls, jnp.tile(CORNERWARDS, (BATCH, 1)))
    assert (result.metrics["foul"] == 1).all()
    assert (result.reward == 0).all()
    assert (after.shots == 1).all()
    np.testing.assert_array_equal(after.positions[:, 1:], jnp.tile(FOUL.positions[1:], (BATCH, 1, 1)))
    cue, edge = np.asarray(after.positions[:, 0]), 0.02 + 0.004  # a ball's and a cushion's radius
    assert (cue >= [-0.4 + edge - 1e-6, -0.2 + edge - 1e-6]).all()
    assert (cue <= [-0.2, 0.2 - edge + 1e-6]).all()
    assert np.linalg.norm(cue[:, None] - np.asarray(FOUL.positions[1:]), axis=-1).min() >= 2 * 0.02 - 1e-6
    assert (cue.max(0) - cue.min(0) > [0.16, 0.33]).all()  # all over the quarter of 0.176 m x 0.352 m


def test_a_foul_takes_back_what_the_same_shot_pocketed():
    scene = balls([(0.28, 0.1), (0.355, 0.15), (-0.3, 0.1), (-0.3, -0.1)], (False, False, True, False))
    angle = jnp.deg2rad(58.8)  # 58.3 .. 59.3
    assert shoot(EASY.table, scene.positions, scene.pocketed, angle).pocketed.tolist() == [True, True, True, False]
    after, result = step(EASY, KEY, scene, directions.from_angle(angle))
    assert (float(result.metrics["foul"]), float(result.reward)) == (1, 0)
    assert after.pocketed.tolist() == [False, False, True, False]
    np.testing.assert_array_equal(after.positions[1:], scene.positions[1:])


def test_a_cleared_table_terminates_and_a_new_rack_follows():
    for shots in (3, 9):  # 9: also the last shot of the episode
        after, result = step(EASY, KEY, balls(CORNER.positions, (False, False, True, True), shots), CORNERWARDS)
        assert float(result.reward) == 1.0
        assert (bool(result.terminated), bool(result.truncated)) == (True, False)
        final = np.asarray(result.final_obs).reshape(4, 3)
        np.testing.assert_allclose(final[1:], [(*place, 0.5) for place in PARKED], atol=1e-7)
        assert not after.pocketed.any()
        assert int(after.shots) == 0
        np.testing.assert_allclose(after.positions, rack(EASY.table), atol=0.01)
        np.testing.assert_array_equal(result.obs, observe(EASY, after))


def test_an_episode_is_truncated_after_its_last_shot():
    (state, obs), ends = reset(EASY, KEY), []
    np.testing.assert_array_equal(obs, observe(EASY, state))
    for number in range(11):
        before = state
        state, result = step(EASY, jax.random.fold_in(KEY, number), state, NOWHERE)
        ends.append((bool(result.terminated), bool(result.truncated)))
        if number == 9:
            np.testing.assert_allclose(state.positions[0], [-0.2, 0.0], atol=1e-6)  # a new rack ...
            assert int(state.shots) == 0
            np.testing.assert_array_equal(result.obs, observe(EASY, state))
            left = np.asarray(result.final_obs).reshape(4, 3)  # ... while the shot led elsewhere
            assert abs(left[0, 1]) > 0.01
            np.testing.assert_array_equal(left[1:], observe(EASY, before).reshape(4, 3)[1:])
        else:
            np.testing.assert_array_equal(result.obs, result.final_obs)
    assert ends == [(False, number == 9) for number in range(11)]


def test_records_hold_the_path_of_every_shot_and_what_the_environment_paid():
    paths, rewards = record(EASY, Heuristic(EASY), jax.random.key(2), 12)
    assert len(paths) == len(rewards) == 12
    assert sum(rewards) > 0
    for number, (path, reward) in enumerate(zip(paths, rewards, strict=True)):
        state = balls(path.positions[0], tuple(path.pocketed[0].tolist()))
        _, result = step(EASY, KEY, state, directions.retract(jnp.asarray(path.velocities[0, 0])))
        assert float(result.reward) == reward
        fallen = path.pocketed[-1] & ~path.pocketed[0]
        assert reward == (0 if fallen[0] else fallen.sum())
        if number > 0 and not paths[number - 1].pocketed[-1][0] and path.pocketed[0].any():
            np.testing.assert_allclose(path.positions[0], paths[number - 1].positions[-1], atol=1e-6)
