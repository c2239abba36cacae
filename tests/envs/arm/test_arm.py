"""The arm's parts that need no cube: commands, the camera, the model, drawing; and the laws of an environment."""

import dataclasses

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from PIL import Image

from cuelearner_envs.anymal.model import rotation
from cuelearner_envs.arm import drawing, physics, recording
from cuelearner_envs.arm import model as arm
from cuelearner_envs.arm.config import ArmConfig
from cuelearner_envs.arm.environment import HOME, Camera
from cuelearner_envs.arm.scripts import act
from cuelearner_jax.errors import UserError
from cuelearner_jax.reading import declared_distortions
from cuelearner_jax.reading.families import undo_observation
from cuelearner_jax.tasks.arm import ARM
from cuelearner_jax.testing import check_task

F = jnp.float32
HIGH = jnp.array(HOME)


def told(action, gripper=HIGH, fingers=(0.0, 0.0), post=0.0, grasps=1.0):
    """What an action means, as NumPy arrays."""
    found = physics.command(jnp.asarray(gripper, F), jnp.array(fingers, F), jnp.array(action, F), post, grasps)
    return np.asarray(found.gripper), np.asarray(found.fingers)


@pytest.mark.long
def test_the_task_keeps_its_laws(tmp_path):
    check_task(ARM, ArmConfig(skill="reach", max_steps=5, camera_offset=(0.0, 0.02, 0.0)), steps=12, pictures=tmp_path)


def test_an_action_of_1_is_5_cm_and_opens_the_fingers():
    gripper, fingers = told([1.0, -0.5, 0.0, 1.0])
    assert np.allclose(gripper, np.array(HOME) + np.array([0.05, -0.025, 0.0]))
    assert np.allclose(fingers, arm.OPEN)
    assert np.allclose(told([0, 0, 0, -1.0], fingers=(0.03, 0.03))[1], 0.0)
    assert np.allclose(told([0, 0, 0, 1.0], grasps=0.0)[1], 0.0)


def test_targets_keep_within_the_workspace():
    assert np.isclose(told([0, 0, -1.0, 0], gripper=(1.3, 0.75, 0.42))[0][2], arm.LOWEST)
    assert np.isclose(told([1.0, 0, 0, 0], gripper=(1.59, 0.75, 0.5))[0][0], 1.6)


def test_targets_keep_out_of_the_post():
    x, y = arm.POST_PLACE
    low, _ = told([1.0, 0, 0, 0], gripper=(x - 0.06, y, 0.42), post=1.0)
    assert np.isclose(np.hypot(*(low[:2] - [x, y])), physics.KEPT_OUT, atol=1e-4)
    above, _ = told([0, 0, -1.0, 0], gripper=(x, y, physics.OVER + 0.01), post=1.0)
    assert np.isclose(above[2], physics.OVER)
    assert np.allclose(told([1.0, 0, 0, 0], gripper=(x - 0.06, y, 0.42))[0], [x - 0.01, y, 0.42])


def test_a_step_goes_3_cm_as_in_fetch():
    """Fetch's goes 3.0 cm in the first step of an action of 1, then 3.3 cm a step, and 0.2 cm after the last."""
    model = arm.load(False)
    data, x = mujoco.MjData(model), [0.0]
    for action in (1.0, 1.0, 1.0, 1.0, 0.0, 0.0):
        data.ctrl[0] = data.qpos[0] + 0.05 * action
        mujoco.mj_step(model, data, arm.SUBSTEPS)
        x.append(float(data.qpos[0]))
    steps = np.diff(x)
    assert np.allclose(steps[:4], 0.032, atol=0.003)
    assert np.abs(steps[4:]).max() < 0.004


@pytest.mark.parametrize("skill", ["reach", "pick"])
def test_a_declared_family_names_the_turn_and_the_offset(skill):
    config = ARM.configure(skill=skill, camera_turn_deg=10.0, camera_offset=(0.01, -0.02, 0.03))
    world, plain = ARM.environment(config), ARM.environment(ARM.configure(skill=skill))
    state, true = plain.reset(jax.random.key(3))
    family = declared_distortions(world)
    assert [one.name.rpartition(": ")[2] for one in family] == ["shift", "gain", "turn"]
    # The camera turns first, then shifts; a family undoes in the other order.
    found = undo_observation((family[0], family[2]), jnp.array([0.01, -0.02, 0.03, 10.0]), world.observe(state))
    assert np.abs(world.observe(state) - true).max() > 0.05
    assert np.allclose(found, true, atol=1e-5)


def test_the_teacher_sees_true_places_and_the_heuristic_what_is_seen():
    config = ARM.configure("turned_camera", skill="reach")
    env = ARM.environment(config)
    state, obs = env.reset(jax.random.key(1))
    teacher = ARM.make_teacher(config, env)
    assert np.allclose(teacher.best_action(state, obs), act("reach", env.observe(state, Camera())[None])[0])
    assert np.allclose(env.heuristic(obs), act("reach", obs[None])[0])
    assert not np.allclose(teacher.best_action(state, obs), env.heuristic(obs), atol=0.1)


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"skill": "throw"}, "task.skill is 'throw'"),
        ({"friction": 0.0}, "task.friction is 0.0: give a number from 0.01 to 10"),
        ({"preferred_side": "left", "skill": "pick"}, "that needs --task.skill push and its post"),
    ],
)
def test_what_makes_no_world_is_refused_in_one_line(changes, said):
    with pytest.raises(UserError, match=r"^[^\n]*$") as refusal:
        dataclasses.replace(ArmConfig(), **changes)
    assert said in str(refusal.value)


def test_rotations_are_told_by_fetchs_angles():
    for turn in ([0.3, 0.0, 0.0], [0.0, 0.4, 0.0], [0.0, 0.0, -0.5]):
        axis, angle = int(np.argmax(np.abs(turn))), sum(turn)
        quaternion = np.zeros(4)
        quaternion[0], quaternion[1 + axis] = np.cos(angle / 2), np.sin(angle / 2)
        assert np.allclose(physics.euler(rotation(jnp.asarray(quaternion, F))), turn, atol=1e-6)


def test_a_picture_shows_cube_post_and_goal(tmp_path):
    env = ARM.environment(ARM.configure(skill="push"))
    state, obs = env.reset(jax.random.key(3))
    recording.question(env, state, obs, jnp.array([0.0, 1.0, 0.0, 0.0]), tmp_path / "question.png")
    picture = np.asarray(Image.open(tmp_path / "question.png")).astype(int)
    assert picture.shape == (drawing.SIZE[1], drawing.SIZE[0], 3)

    def near(colour, apart=40):
        return int((np.abs(picture - np.array(colour)).max(-1) < apart).sum())

    assert near(drawing.GOAL) > 30
    assert near(drawing.ARROW) > 100
    assert near(drawing.CUBE) > 200
    assert near(drawing.POST) > 200
    sketch = recording.sketch(env, state)
    assert sketch.box == (0.0, 0.0, *drawing.SIZE)
    forward, left, up, fingers = sketch.points
    assert forward[0] > 0 > forward[1]
    assert left[0] < 0
    assert up == (0.0, -1.0)
    assert fingers is None
