import dataclasses
import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from cuelearner_envs.billiards.config import BilliardsConfig, make_environment
from cuelearner_envs.billiards.teacher import SearchTeacher
from cuelearner_jax import actions
from cuelearner_jax.errors import UserError
from cuelearner_jax.evaluate import episodes, rollout, teacher_policy
from cuelearner_jax.tasks import BILLIARDS, SHIPPED_TEACHERS, billiards_teacher

ONE = make_environment(BilliardsConfig("one_ball"))
STATES, OBS = jax.vmap(ONE.reset)(jax.random.split(jax.random.key(3), 30))
AIM = jnp.deg2rad(0.5)
best = jax.jit(lambda teacher, states, obs: jax.lax.map(lambda pair: teacher.best_action(*pair), (states, obs)))


@pytest.fixture(scope="module")
def chosen():
    return best(SearchTeacher(ONE, AIM, jnp.array(0.2)), STATES, OBS)


def test_search_finds_the_winning_direction(chosen):
    reward = jax.jit(jax.vmap(lambda state, action: ONE.step(jax.random.key(0), state, action)[1].reward))
    assert float(reward(STATES, chosen).mean()) > 0.9
    assert float(reward(STATES, actions.uniform(jax.random.key(1), (30,))).mean()) < 0.2


def test_a_habit_makes_the_teacher_consistent(chosen):
    angles = np.rad2deg(np.asarray(actions.to_angle(chosen)))
    assert angles.max() - angles.min() < 5
    jumping = best(SearchTeacher(ONE, AIM, jnp.array(0.0)), STATES, OBS)
    spread = np.rad2deg(np.asarray(actions.to_angle(jumping)))
    assert spread.max() - spread.min() > 50  # mirror-image windows


def test_it_aims_at_the_middle_of_a_window(chosen):
    teacher = SearchTeacher(ONE, AIM, jnp.array(0.2))
    wins = np.asarray(jax.jit(teacher.rewards)(jax.tree.map(lambda leaf: leaf[0], STATES))) > 0
    index = int(np.round(np.asarray(actions.to_angle(chosen[0])) / (2 * np.pi) * wins.size)) % wins.size
    left, right = (next(n for n in range(50) if not wins[(index + sign * n) % wins.size]) for sign in (1, -1))
    assert abs(left - right) <= 1


def test_it_looks_at_the_table_and_not_at_the_sensor(chosen):
    biased = ONE.replace(observation_bias=jnp.array([0.05, 0.05]))
    np.testing.assert_array_equal(best(SearchTeacher(biased, AIM, jnp.array(0.2)), STATES, OBS), chosen)


def test_the_shipped_teacher_plays_the_easy_table_well():
    config = BilliardsConfig("easy", teacher="learned")
    env = make_environment(config)
    teacher = billiards_teacher(config, env).replace(directions=720)  # a coarser choice, for speed
    measured = jax.jit(lambda teacher: rollout(teacher_policy(teacher), env, episodes("tuning"), 20, 200))(teacher)
    assert float(measured["reward"]) > 0.8  # 0.93 over 10,000 steps
    told = json.loads((SHIPPED_TEACHERS / "easy" / "teacher.json").read_text())
    assert told["reward"] >= 0.75
    assert told["eval_steps"] == 10_000
    assert told["command"].startswith("cuelearner teacher train billiards")
    assert told["commit"]
    assert "jax" in told["versions"]


def test_a_table_without_a_shipped_teacher_says_what_to_do():
    config = dataclasses.replace(BILLIARDS.presets["paper"].config.task, teacher="learned")
    with pytest.raises(UserError, match="cuelearner teacher train"):
        billiards_teacher(config, make_environment(config))
