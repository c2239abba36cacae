import jax
import jax.numpy as jnp
import numpy as np
import pytest

from cuelearner_envs.billiards import simulate
from cuelearner_envs.billiards.config import BilliardsConfig, make_environment
from cuelearner_envs.billiards.environment import Balls, Billiards
from cuelearner_envs.billiards.recording import record
from cuelearner_envs.billiards.table import Table, rack
from cuelearner_jax import actions

EASY = make_environment(BilliardsConfig("easy"))
KEY = jax.random.key(0)
step = jax.jit(lambda env, key, state, action: env.step(key, state, action))
reset_many = jax.jit(lambda env, keys: jax.vmap(env.reset)(keys))
observe = jax.jit(lambda env, balls: env.observe(balls))


def balls(positions, pocketed=(False, False, False, False), shots=0):
    return Balls(jnp.array(positions, jnp.float32), jnp.array(pocketed), jnp.array(shots, jnp.int32))


SCENE = balls([(-0.2, 0.0), (0.1, -0.1), (0.3, 0.1), (0.0, 0.1)])
CORNER = balls([(0.2, 0.0), (0.35, 0.15), (-0.3, 0.1), (-0.3, -0.1)])  # ball 1 lies between the cue ball and a corner
INTO_CORNER = actions.from_angle(jnp.array(jnp.pi / 4))


def test_the_observation_lists_the_cue_ball_then_targets_from_the_top_and_from_the_left():
    expected = [-0.2, 0.0, -0.5, 0.0, 0.1, -0.5, 0.3, 0.1, -0.5, 0.1, -0.1, -0.5]
    np.testing.assert_allclose(observe(EASY, SCENE), expected, atol=1e-7)
    assert EASY.obs_size == 12


def test_equal_positions_look_equal_whichever_ball_fell():
    places = np.array([(-0.2, 0.0), (0.1, -0.1), (0.3, 0.1), (9.0, 9.0)])
    first = observe(EASY, balls(places, (False, False, False, True)))
    second = observe(EASY, balls(places[[0, 3, 1, 2]], (False, True, False, False)))
    np.testing.assert_array_equal(first, second)
    assert first[5] == 0.5  # the pocketed one comes first
    assert float(first[4]) > float(EASY.table.height) / 2  # beside the table


def test_a_sensor_bias_shifts_what_is_seen_and_not_what_happens():
    biased = EASY.replace(observation_bias=jnp.array([0.0071, 0.0071]))
    seen = np.asarray(observe(biased, SCENE) - observe(EASY, SCENE)).reshape(4, 3)
    np.testing.assert_allclose(seen, np.tile([0.0071, 0.0071, 0.0], (4, 1)), atol=1e-7)
    after, _ = step(EASY, KEY, SCENE, INTO_CORNER)
    after_biased, _ = step(biased, KEY, SCENE, INTO_CORNER)
    np.testing.assert_array_equal(after.positions, after_biased.positions)


def test_a_ball_shot_into_a_corner_is_worth_one():
    after, result = step(EASY, KEY, CORNER, INTO_CORNER)
    assert float(result.reward) == 1.0
    assert after.pocketed.tolist() == [False, True, False, False]
    assert float(result.metrics["scored"]) == 1.0


def test_a_shot_that_pockets_nothing_is_worth_nothing():
    _, result = step(EASY, KEY, CORNER, actions.from_angle(jnp.array(-1.6)))
    assert float(result.reward) == 0.0


def test_a_foul_puts_every_ball_back_and_the_cue_ball_somewhere_free_on_the_left():
    scene = balls([(0.3, 0.1), (-0.2, 0.0), (-0.3, 0.1), (-0.3, -0.1)])
    keys = jax.random.split(KEY, 200)
    after, result = jax.vmap(lambda key: step(EASY, key, scene, INTO_CORNER))(keys)
    assert (result.metrics["foul"] == 1).all()
    assert (result.reward == 0).all()
    np.testing.assert_array_equal(after.positions[:, 1:], jnp.tile(scene.positions[1:], (200, 1, 1)))
    cue = np.asarray(after.positions[:, 0])
    assert (cue[:, 0] <= -0.2).all()
    assert (cue[:, 0] >= -0.4 + 0.024 - 1e-6).all()
    assert (np.abs(cue[:, 1]) <= 0.2 - 0.024 + 1e-6).all()
    gaps = np.linalg.norm(cue[:, None] - np.asarray(scene.positions[1:]), axis=-1)
    assert gaps.min() >= 2 * 0.02 - 1e-6
    assert np.std(cue, axis=0).min() > 0.02  # not always the same place


def test_a_foul_takes_back_what_the_same_shot_pocketed():
    scene = balls([(0.28, 0.1), (0.355, 0.15), (-0.3, 0.1), (-0.3, -0.1)])  # both can fall into the same corner
    directions = actions.evenly_spaced(1440)
    shots = jax.vmap(lambda angle: simulate(EASY.table, scene.positions, scene.pocketed, angle).pocketed)
    both = np.asarray(jax.jit(shots)(actions.to_angle(directions)))[:, :2].all(-1)
    assert both.any()
    after, result = jax.vmap(lambda action: step(EASY, KEY, scene, action))(directions[both])
    fouls = np.asarray(result.metrics["foul"]) == 1
    assert fouls.all()
    assert (np.asarray(result.reward)[fouls] == 0).all()
    assert not np.asarray(after.pocketed)[fouls].any()


def test_an_episode_terminates_when_cleared_and_truncates_after_its_shots():
    cleared = balls(CORNER.positions, (False, False, True, True))
    after, result = step(EASY, KEY, cleared, INTO_CORNER)
    assert (bool(result.terminated), bool(result.truncated)) == (True, False)
    late = balls(CORNER.positions, shots=9)
    after, result = step(EASY, KEY, late, actions.from_angle(jnp.array(-1.6)))
    assert (bool(result.terminated), bool(result.truncated)) == (False, True)
    assert int(after.shots) == 0
    np.testing.assert_allclose(after.positions[0], [-0.2, 0.0], atol=1e-6)  # a new rack ...
    np.testing.assert_array_equal(result.obs, observe(EASY, after))
    assert not np.array_equal(result.final_obs, result.obs)  # ... while the shot led elsewhere
    assert make_environment(BilliardsConfig("one_ball")).max_shots == 1
    assert make_environment(BilliardsConfig("regulation")).max_shots == 10


def test_the_rack_is_a_triangle_a_quarter_from_either_end():
    spacing = 1.05 * 2 * 0.01125
    expected = [
        (-0.22, 0.0),
        (0.22, 0.0),
        (0.22 + spacing * np.sqrt(3) / 2, -spacing / 2),
        (0.22 + spacing * np.sqrt(3) / 2, spacing / 2),
    ]
    np.testing.assert_allclose(np.asarray(rack(Table.regulation())), expected, atol=1e-7)


@pytest.mark.parametrize("name", ["one_ball", "easy", "regulation"])
def test_racked_balls_are_displaced_a_little_and_never_overlap(name):
    env = make_environment(BilliardsConfig(name))
    states, _ = reset_many(env, jax.random.split(KEY, 2000))
    moved = np.asarray(states.positions - rack(env.table))
    assert (moved[:, 0] == 0).all()  # the cue ball stands still
    jitter = float(env.table.rack_jitter)
    assert 0.8 * jitter < moved[:, 1:].std() < 1.2 * jitter
    places = np.asarray(states.positions)
    gaps = np.linalg.norm(places[:, :, None] - places[:, None], axis=-1) + np.eye(env.table.balls)
    assert gaps.min() >= 2 * float(env.table.ball_radius)


def test_a_turned_strike_is_the_turned_action():
    turned = EASY.replace(action_turn=jnp.deg2rad(0.8))
    after, _ = step(turned, KEY, SCENE, actions.from_angle(jnp.array(0.3)))
    same, _ = step(EASY, KEY, SCENE, actions.from_angle(0.3 + jnp.deg2rad(0.8)))
    np.testing.assert_allclose(after.positions, same.positions, atol=1e-5)


def test_changed_worlds_compile_nothing_new():
    before = step._cache_size()
    tilted = EASY.replace(table=EASY.table.replace(acceleration=jnp.array([0.0, 0.005]), friction=jnp.array(0.1)))
    compiled = []
    for world in (tilted, tilted.replace(table=tilted.table.replace(friction=jnp.array(0.2)))):
        after, _ = step(world, KEY, SCENE, actions.from_angle(jnp.array(-2.8)))
        compiled.append(step._cache_size())
    assert compiled[0] == compiled[1] <= before + 1  # a friction given as an array instead of a number compiles once
    assert float(after.positions[2, 1]) > float(SCENE.positions[2, 1]) + 1e-3  # a resting ball rolls down


MIRRORED = EASY.replace(mirrors=True)


def random_states(count):
    keys = jax.random.split(jax.random.key(5), count)
    states, _ = reset_many(EASY, keys)
    play = jax.jit(jax.vmap(lambda key, state, action: EASY.step(key, state, action)[0]))
    for number in range(4):
        states = play(jax.vmap(jax.random.fold_in, (0, None))(keys, number), states, actions.uniform(keys[0], (count,)))
    return states


def test_mirrored_shots_have_mirrored_results():
    states = random_states(300)
    fallen = jnp.arange(300)[:, None] % 4 == jnp.arange(4)
    states = states.replace(pocketed=states.pocketed | (fallen & (jnp.arange(4) > 0)))
    strikes = actions.uniform(jax.random.key(6), (300,))
    closest = jax.vmap(EASY.heuristic)(jax.vmap(EASY.observe)(states))
    strikes = jnp.where(jnp.arange(300)[:, None] % 2 == 0, closest, strikes)
    play = jax.jit(jax.vmap(lambda state, action: EASY.step(KEY, state, action)[1].reward))
    plain = np.asarray(play(states, strikes))
    assert plain.sum() > 10
    for which, signs in ((1, (-1, 1)), (2, (1, -1)), (3, (-1, -1))):
        image = play(states.replace(positions=states.positions * jnp.array(signs)), strikes * jnp.array(signs))
        assert (np.asarray(image) != plain).sum() <= 2  # float32 decides grazing contacts either way
        obs = jax.vmap(EASY.observe)(states)
        seen, vector = jax.vmap(MIRRORED.mirror, (None, 0, 0))(jnp.array(which), obs, strikes)
        mirrored_states = states.replace(positions=states.positions * jnp.array(signs))
        np.testing.assert_allclose(seen, jax.vmap(EASY.observe)(mirrored_states), atol=1e-6)
        np.testing.assert_allclose(vector, strikes * jnp.array(signs))
        back, _ = jax.vmap(MIRRORED.mirror, (None, 0, 0))(jnp.array(which), seen, vector)
        np.testing.assert_allclose(back, obs, atol=1e-6)


def test_the_identity_comes_first_and_symmetries_are_an_option():
    obs, vector = MIRRORED.mirror(jnp.array(0), observe(EASY, SCENE), jnp.array([0.6, 0.8]))
    np.testing.assert_array_equal(obs, observe(EASY, SCENE))
    np.testing.assert_allclose(vector, [0.6, 0.8])
    assert (MIRRORED.symmetries, EASY.symmetries) == (4, 1)


def test_the_heuristic_points_at_the_closest_ball_that_is_left():
    closest = EASY.heuristic(observe(EASY, SCENE))
    np.testing.assert_allclose(closest, np.array([0.2, 0.1]) / np.hypot(0.2, 0.1), atol=1e-6)
    left = EASY.heuristic(observe(EASY, balls(SCENE.positions, (False, False, False, True))))
    np.testing.assert_allclose(left, np.array([0.3, -0.1]) / np.hypot(0.3, 0.1), atol=1e-6)


def test_features_give_the_balls_along_and_across_the_strike():
    scene = balls([(0.1, 0.0), (0.1, 0.1), (0.3, 0.0), (0.0, 0.0)], (False, False, False, True))
    seen = np.asarray(EASY.features(observe(EASY, scene), jnp.array([0.0, 1.0])))
    assert seen.shape == (8 + 6 * 3,)
    np.testing.assert_allclose(seen[:4], [0.25, 0.0, 0.0, 1.0], atol=1e-6)
    pocketed, ahead, aside = seen[8:].reshape(3, 6)  # in the observation's order
    np.testing.assert_array_equal(pocketed, np.zeros(6))
    np.testing.assert_allclose(ahead, [0.25, 0.0, 0.0, 0.25, 0.25, 1.0], atol=1e-6)
    np.testing.assert_allclose(aside, [0.0, -0.5, np.arctan(-0.2 / 0.04), 0.75, 0.0, 1.0], atol=1e-6)


def test_a_record_holds_a_path_and_a_reward_for_each_shot():
    paths, rewards = record(EASY, lambda key, state, obs: jax.vmap(EASY.heuristic)(obs), KEY, 3)
    assert len(paths) == len(rewards) == 3
    fallen = [bool(path.pocketed[-1][1:].sum() > path.pocketed[0][1:].sum()) for path in paths]
    assert fallen == [reward > 0 for reward in rewards]


def test_the_environment_is_a_pytree_of_its_world():
    assert isinstance(EASY, Billiards)
    again = jax.tree.map(lambda leaf: leaf, EASY)
    assert again.table.balls == 4
