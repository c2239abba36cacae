"""Values as other libraries have them work; what only looks like one is refused."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import probes
import pytest
from flax import struct

import cuelearner_jax as cl
from cuelearner_jax.api import arguments
from cuelearner_jax.config import GuideSizes, Scalars
from cuelearner_jax.policies import Heuristic, Opaque
from cuelearner_jax.spaces import DIRECTIONS

TASK = dataclasses.replace(probes.make_task(), presets={})
WORLD = cl.World(TASK, probes.WindowConfig())
TEACHER = cl.teacher_of(WORLD)
SEEN = np.float32([[1, 0], [0, 1], [-1, 0], [0, -1]])
POLICY = cl.CallablePolicy(Heuristic(WORLD.env), WORLD.env.observation)
SIZES = GuideSizes(feedback_layers=(8,), fit_steps=20, fit_batch_size=8)
LABELS = cl.Labels(SEEN, SEEN, np.float32([1, 0, -1, 1]))
WAYS = {
    "bfloat16": lambda rows: jnp.asarray(rows, jnp.bfloat16),
    "float16": lambda rows: rows.astype(np.float16),
    "big-endian": lambda rows: rows.astype(">f8"),
    "of Fortran": np.asfortranarray,
    "backwards": lambda rows: rows[::-1][::-1],
    "nothing masked": np.ma.asarray,
    "lists": np.ndarray.tolist,
    "a view": memoryview,
}


@pytest.mark.parametrize("way", WAYS)
def test_observations_of_every_make_are_the_same_and_actions_can_be_written_in(way):
    actions = POLICY(WAYS[way](SEEN))
    np.testing.assert_array_equal(actions, POLICY(SEEN))
    actions[:] = 0.0
    assert POLICY(SEEN).any()


class Lying:
    """Says that it is long, and has nothing."""

    def __len__(self):
        return 10**12

    def __getitem__(self, index):
        raise IndexError


def deleted():
    array = jnp.asarray(SEEN) + 0
    array.delete()
    return array


@pytest.mark.parametrize(
    "rows", [np.ma.masked_array(SEEN, SEEN > 0), Lying(), deleted()], ids=["masked", "long", "gone"]
)
def test_what_only_looks_like_an_array_is_refused(rows):
    with pytest.raises(cl.UserError, match=r"^obs is a"):
        POLICY(rows)


@pytest.mark.parametrize("kind", [np.float16, np.float32, np.float64, np.int8, jnp.float32, np.array])
def test_a_number_of_numpy_or_jax_is_a_number(kind):
    assert arguments.amount("bound_deg", kind(5), DIRECTIONS) == 5.0
    assert arguments.settings("scalars", Scalars(eps_deg=kind(5)), Scalars).eps_deg == 5.0
    assert cl.World(TASK, probes.WindowConfig(kind(28))).config.half_width_deg == 28.0


@pytest.mark.parametrize("layers", [[8], (np.int64(8),), np.array([8])])
def test_layers_may_be_a_list_or_an_array_and_are_kept_as_a_tuple(layers):
    sizes = arguments.settings("sizes", dataclasses.replace(SIZES, feedback_layers=layers), GuideSizes)
    assert sizes == SIZES
    assert hash(sizes) == hash(SIZES)


class Odd(struct.PyTreeNode):
    """A teacher that gives what no teacher gives."""

    given: object = struct.field(pytree_node=False, default=None)

    def best_action(self, state, obs):
        return self.given


class NoPytree:
    def best_action(self, state, obs):
        return obs


class OtherArguments(struct.PyTreeNode):
    def best_action(self, state):
        return state


TABLE = cl.make("billiards")
OF_BILLIARDS = cl.CallablePolicy(Heuristic(TABLE.env), TABLE.env.observation)
TEACHERS = [Odd(None), Odd("east"), Odd((1j, 0.0)), Odd(((1.0,), ())), NoPytree(), OtherArguments()]


@pytest.mark.parametrize("teacher", [*TEACHERS, cl.teacher_of(OF_BILLIARDS)], ids=lambda one: type(one).__name__)
def test_a_teacher_of_something_else_is_refused(teacher):
    with pytest.raises(cl.UserError, match=r"teacher|Billiards.heuristic raised"):
        cl.ask(POLICY, WORLD, teacher, labels=5, sizes=SIZES)


def test_no_more_bounds_are_tried_than_anyone_can_wait_for():
    shares = np.linspace(0.01, 0.99, 100_000)
    with pytest.raises(cl.UserError, match="judge_bounds has 100,000 shares, each played by itself: give at most 16"):
        cl.adapt(POLICY, WORLD, TEACHER, labels=5, guidance="relative", sizes=SIZES, judge_bounds=shares)


def test_a_policy_of_another_world_is_refused():
    for policy, says in (
        (OF_BILLIARDS, "this world has 2: give the world"),
        (Heuristic(TABLE.env), r"Billiards.heuristic raised|^policy cannot act in this wo"),
    ):
        for call in (
            lambda policy=policy: cl.ask(policy, WORLD, TEACHER, labels=5, sizes=SIZES),
            lambda policy=policy: cl.adapt(policy, WORLD, TEACHER, labels=5, guidance="relative", sizes=SIZES),
            lambda policy=policy: cl.export_policy(policy, "nowhere", WORLD, "numpy"),
        ):
            with pytest.raises(cl.UserError, match=says):
                call()


def test_models_with_parts_of_something_else_are_refused():
    model = cl.FeedbackModel(None, None, Scalars(), LABELS, SIZES)
    with pytest.raises(cl.UserError, match=r"^model.guidance is None"):
        cl.refine(POLICY, model)
    wide = cl.fit_feedback(LABELS._replace(obs=np.ones((4, 5), np.float32)), sizes=SIZES)
    with pytest.raises(cl.UserError, match="model takes observations with 5 entries, the policy's have 2"):
        cl.refine(POLICY, wide)
    with pytest.raises(cl.UserError, match="state"):
        WORLD.step(jax.random.key(0), np.array(["a", "b"]), [1, 0])


@pytest.mark.parametrize("name", ["a" * 5000, "\x1b[31mred\nline", "\u202eback", "\udcff"])
def test_a_message_is_one_line_whatever_a_path_holds(name):
    for call in (cl.load_policy, cl.load_exported, cl.fit_feedback):
        with pytest.raises(cl.UserError) as refused:
            call(name)
        assert str(refused.value).isprintable()


@pytest.mark.parametrize("error", [ValueError("\x1b[31mred\n" * 1000)], ids=["red"])
def test_what_a_function_raises_is_told_in_one_line(error):
    def failing(obs):
        raise error

    with pytest.raises(cl.UserError, match="failing raised") as refused:
        cl.CallablePolicy(Opaque(failing, on_host=True))(SEEN)
    assert str(refused.value).isprintable()
    assert len(str(refused.value)) < 1200
