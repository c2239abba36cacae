"""The zoo: what robots observe, what is wrong in their worlds, what teachers answer, and the laws of an environment."""

from functools import cache, partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from cuelearner_envs import zoo
from cuelearner_envs.zoo.environment import ZooEnvironment, ZooTeacher
from cuelearner_envs.zoo.robots import decode, draw, encode
from cuelearner_envs.zoo.worlds import execute, sight_of
from cuelearner_jax.errors import UserError
from cuelearner_jax.spaces import UNSAID
from cuelearner_jax.tasks import registry
from cuelearner_jax.testing import check_environment

ERRORS = jnp.arange(len(zoo.ERRORS))
KEY = jax.random.key(3)


@cache
@jax.jit
def situations():
    """A robot of three cues, its worlds of all errors, and a state amid an episode in each."""
    robot = draw(jax.random.key(3), 3)
    worlds = jax.vmap(lambda error: zoo.change(KEY, robot, error))(ERRORS)
    states = jax.vmap(lambda world: zoo.reset(KEY, world))(worlds)
    states, _ = jax.vmap(zoo.step)(worlds, states, jax.vmap(zoo.right)(worlds, states))
    return robot, worlds, states


def test_observations_hold_all_quantities():
    robot, worlds, states = situations()
    sights = jax.jit(jax.vmap(sight_of))(worlds, states)
    both = jax.jit(lambda robot, sights: jax.vmap(lambda sight: decode(robot, encode(robot, sight)))(sights))
    for true in (False, True):
        again = both(robot.replace(relative=jnp.array(true)), sights)
        jax.tree.map(partial(np.testing.assert_allclose, atol=1e-4), again, sights)


def test_the_right_action_has_the_effect_that_the_unchanged_policys_has():
    robot, worlds, states = situations()

    @jax.jit
    def found():
        effects = jax.vmap(execute)(worlds, states.position, jax.vmap(zoo.right)(worlds, states))
        sight = sight_of(*jax.tree.map(lambda leaf: leaf[0], (worlds, states)))
        return effects, zoo.policy(robot, encode(robot, sight))

    effects, wanted = found()
    for name, effect, other in zip(zoo.ERRORS, effects, worlds.other, strict=True):
        assert other == name.startswith("other")
        if not other:
            np.testing.assert_allclose(effect, wanted, atol=1e-4 * float(robot.half.max()), err_msg=name)


def test_each_error_changes_what_is_executed_or_what_is_observed():
    robot, worlds, states = situations()
    action = robot.retract(0.3 * robot.high)

    def differences(world, state):
        seen = (zoo.observe(world, state) - encode(robot, sight_of(world, state))) / robot.unit[robot.order]
        return jnp.abs(execute(world, state.position, action) - action).max(), jnp.abs(seen).max()

    executes, observes = (np.asarray(size) > 1e-3 for size in jax.jit(jax.vmap(differences))(worlds, states))
    changes = {name for name, at in zip(zoo.ERRORS, executes, strict=True) if at} | {"region"}  # where that is reached
    assert changes == {"constant", "gain", "mixing", "region", "waves", "two"}
    assert {name for name, at in zip(zoo.ERRORS, observes, strict=True) if at} == {
        "seen_shift", "seen_turn", "two", "other_way_shift",
    }  # fmt: skip


def test_answers_say_where_the_right_action_lies_and_teachers_err_as_they_are_told_to():
    _, worlds, states = situations()
    world, state = jax.tree.map(lambda leaf: leaf[1], (worlds, states))
    right, half, eps = zoo.right(world, state), world.robot.half, 0.1
    answer = partial(zoo.answer, KEY, world, state, right + 2 * half * jnp.array([-0.2, 0.3, 0.04]), eps)
    np.testing.assert_array_equal(answer(), [1, -1, 0])
    np.testing.assert_array_equal(answer(wrong=1.0), [-1, 1, 0])
    np.testing.assert_array_equal(answer(one_cue=True), [UNSAID, -1, UNSAID])


def test_a_world_keeps_the_laws_of_an_environment():
    _, worlds, _ = situations()
    env = ZooEnvironment.of(jax.tree.map(lambda leaf: leaf[4], worlds))
    check_environment(env, zoo.STEPS + 2, tolerance=1e-4)
    state, obs = env.reset(KEY)
    right, action = ZooTeacher(env.world).best_action(state, obs), env.heuristic(obs)
    np.testing.assert_allclose(env.actions.log(action, right), env.world.robot.log(action, right), rtol=1e-5)


def test_a_world_is_found_by_its_name():
    task = registry.resolve("zoo:2")
    configs = [task.configure(number=4, error="gain", **more) for more in ({}, {"split": "held_out"})]
    env, other = jax.jit(lambda: [task.environment(config) for config in configs])()
    assert (env.actions.size, env.world.error) == (2, zoo.ERRORS.index("gain"))
    assert not np.array_equal(env.world.robot.unit, other.world.robot.unit)
    with pytest.raises(UserError, match="unknown robots 'zoo:9': give zoo:1"):
        registry.resolve("zoo:9")
    with pytest.raises(UserError, match=r"task\.cues is 1: name zoo:1 in place of zoo:2"):
        task.environment(task.configure(cues=1))
    with pytest.raises(UserError, match=r"task\.error is 'gains'"):
        task.configure(error="gains")


@pytest.mark.long
def test_policies_succeed_errors_cost_and_right_actions_restore():
    """On robots half of whose policies are networks."""
    group = jax.jit(zoo.robots, static_argnums=(1, 2))(KEY, 2, 10)
    assert not group.neural[::2].any()
    assert group.neural[1::2].any()

    def one(robot, error):
        """Success and return of the policy where nothing is wrong and where something is, and of the teacher there."""
        world, act = zoo.change(KEY, robot, error), partial(zoo.policy, robot)
        plays = [
            lambda key: zoo.rollout(key, zoo.unchanged(robot), act)[2:],
            lambda key: zoo.rollout(key, world, act)[2:],
            lambda key: zoo.rollout(key, world, partial(zoo.right, world), knows=True)[2:],
        ]
        means = [jax.tree.map(jnp.mean, jax.vmap(play)(jax.random.split(KEY, 20))) for play in plays]
        return jnp.array([[success, total] for total, success in means])

    scores = jax.jit(jax.vmap(jax.vmap(one, (None, 0)), (0, None)))(group, ERRORS)
    unchanged, unadapted, teacher = jnp.moveaxis(scores, 2, 0)
    assert unchanged[..., 0].mean() > 0.9
    assert teacher[..., 0].mean(0).min() > 0.95 * unchanged[..., 0].mean()
    harm = jnp.array([name not in ("nothing", "other_way") for name in zoo.ERRORS])
    assert unadapted[..., 0].mean(0)[harm].max() < 0.6
    assert (unadapted[..., 1].mean(0) < teacher[..., 1].mean(0) - 1)[harm].all()
    np.testing.assert_array_equal(unadapted[:, ~harm, 0], unchanged[:, ~harm, 0])
