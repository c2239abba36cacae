"""On which side obstacles are passed: counted by hand, and a teacher that keeps to one side."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import rooms

from cuelearner_envs.navigation.environment import Navigation
from cuelearner_envs.navigation.geometry import line_clearance
from cuelearner_envs.navigation.layouts import BOXES, CIRCLES
from cuelearner_envs.navigation.roadmap import make_teacher
from cuelearner_envs.navigation.world import closed, count_passed
from cuelearner_jax.evaluate import episodes, evaluate_policy
from cuelearner_jax.policies import Taught

# A corridor of 20 m by 4.6 m with a box in the middle, a circle at x = 5 and the walls of all worlds.
BOX, CIRCLE, SIZE = [0, 0.1, 0.3, 0.4, 0.3], [5.0, 0.0, 0.4], (20.0, 4.6)
STARTS, GOALS = [[-6.0, 0.0]] * 16, [[8.0, 0.0]] * 16
WORLD = rooms.world([*rooms.walls(*SIZE), BOX], [CIRCLE], SIZE, STARTS, GOALS, rows=(BOXES, CIRCLES))
passes = jax.jit(count_passed)

STEPS = [  # ahead, before, after, (passed on the left, on the right)
    (1, (-0.1, 1.0), (0.1, 1.0), (1, 0)),  # toward larger x and above the box: it stays on the right
    (1, (-0.1, -1.0), (0.1, -1.0), (0, 1)),
    (-1, (0.1, 1.0), (-0.1, 1.0), (0, 1)),  # the other way round above is on the right
    (1, (0.1, 1.0), (-0.1, 1.0), (0, 0)),  # backward
    (1, (0.0, 1.0), (0.0, 1.4), (0, 0)),  # along the line itself
    (1, (-0.2, -0.5), (0.0, 1.0), (1, 0)),  # ends on the line, which counts once
    (1, (-0.1, -0.9), (0.1, 0.9), (0, 1)),  # crosses it at 0, which is below the box's middle
    (1, (-0.1, 1.0), (5.1, -1.0), (1, 1)),  # both at once: at 0.96 and at -0.96
    (1, (4.9, -0.01), (5.1, -0.01), (0, 1)),
]


@pytest.mark.parametrize(("ahead", "before", "after", "counted"), STEPS)
def test_an_obstacle_is_passed_where_the_line_through_its_middle_is_crossed_forward(ahead, before, after, counted):
    np.testing.assert_array_equal(passes(WORLD, jnp.float32(ahead), jnp.array(before), jnp.array(after)), counted)


def test_a_closed_side_lets_nothing_through_and_the_other_stays_open():
    room = jax.jit(line_clearance)
    for side in (1.0, -1.0):
        barred = closed(WORLD, side)
        for x in (0.0, 5.0):
            ends = [jnp.array([x - 0.5, 1.5 * side]), jnp.array([x + 0.5, 1.5 * side])]
            assert room(barred, *ends) <= 0 < room(WORLD, *ends)
            ends = [jnp.array([x - 0.5, -1.5 * side]), jnp.array([x + 0.5, -1.5 * side])]
            assert room(barred, *ends) == room(WORLD, *ends)


# The corridor twice, walked through in either direction.
BACK = WORLD.replace(starts=WORLD.goals, goals=WORLD.starts)
TWO = Navigation(jax.tree.map(lambda *leaves: jnp.stack(leaves), WORLD, BACK), max_steps=jnp.int32(120), sides=True)


walked = jax.jit(lambda teacher, env: evaluate_policy(env, Taught(teacher), episodes("tuning"), 20, 20 * 120))


@pytest.mark.long
@pytest.mark.parametrize(("wish", "side"), [("left", 1.0), ("right", -1.0)])
def test_a_teacher_passes_where_it_is_wanted(wish, side):
    found = walked(make_teacher(TWO, jnp.float32(side)), TWO)
    assert found["success"] == 1
    assert found[f"passed_{wish}"] == 1
