"""The face for Python: what it gives, that it leads to rounds and a bound, and what it refuses."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import probes
import pytest

import cuelearner_jax as cl
from cuelearner_jax.api import training
from cuelearner_jax.config import GuideSizes, Scalars
from cuelearner_jax.errors import UserError
from cuelearner_jax.policies import Agent, Heuristic
from cuelearner_jax.runs import lanes
from cuelearner_jax.runs.grid import Grid
from cuelearner_jax.runs.order import Order
from cuelearner_jax.spaces import DIRECTIONS
from cuelearner_jax.storage import results
from cuelearner_jax.studies import train
from cuelearner_jax.task import Task
from cuelearner_jax.tasks import registry

TASK = dataclasses.replace(probes.make_task(), presets={})
WORLD = cl.World(TASK, probes.WindowConfig())
TEACHER = cl.teacher_of(WORLD)
ERROR = 11.7  # of the policy that is to be corrected [deg]
SIZES = GuideSizes(feedback_layers=(32, 32), fit_steps=200, fit_batch_size=32)
SCALARS = dataclasses.replace(probes.SCALARS, eps_deg=5.0, tau_deg=0.5, k_max=50)
WILD = dataclasses.replace(SCALARS, feedback_learning_rate=1e30)
rng = np.random.default_rng(0)
ANGLES = rng.integers(0, 4, 200) * (np.pi / 2)
SEEN = np.stack([np.cos(ANGLES), np.sin(ANGLES)], -1).astype(np.float32)


def turned(directions, degrees):
    angle = np.radians(degrees)
    return np.asarray(directions) @ np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]).T


def best(obs):
    return turned(obs, np.degrees(0.6))


def policy(obs):
    """Off by `ERROR`, clockwise."""
    return turned(best(obs), -ERROR)


def errors(acting):
    """Mean distance from the best actions [deg]."""
    return np.degrees(np.arccos(np.clip((acting(SEEN) * best(SEEN)).sum(-1), -1, 1))).mean()


def own_labels():
    """Answers about the policy's own actions alone: all of them say counterclockwise."""
    return cl.Labels(SEEN, policy(SEEN).astype(np.float32), np.ones(len(SEEN)))


def test_every_name_of_the_face_is_there_and_documented():
    for name in cl.__all__:
        assert getattr(cl, name).__doc__
        assert name in dir(cl)
    with pytest.raises(AttributeError, match="no attribute 'nonsense'"):
        cl.nonsense  # noqa: B018


def test_a_world_by_name():
    world = cl.make("billiards", table="one_ball", scenario="turned_strike")
    assert (world.config.table, world.config.action_turn_deg) == ("one_ball", 0.8)
    state, obs = world.reset(jax.random.key(0))
    assert obs.shape == (sum(quantity.size for quantity in world.observation),)
    assert world.step(jax.random.key(1), state, np.array([1.0, 0.0], np.float32))[1].reward.shape == ()
    for bad, says in (
        (lambda: cl.make("billards"), "did you mean 'billiards'"),
        (lambda: cl.make("billiards", tabel="easy"), "did you mean 'table'"),
        (lambda: cl.make("billiards", scenario="flood"), "unknown scenario 'flood'"),
        (lambda: cl.make("nowhere.at_all:TASK"), "no module 'nowhere'"),
    ):
        with pytest.raises(cl.UserError, match=says):
            bad()


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A run of the command, of two seeds."""
    folder = tmp_path_factory.mktemp("api") / "run"
    train.run(Order(TASK, probes.CONFIG, Grid(("relative",), (3, 5), (10,)), folder))
    return folder


def test_a_policy_of_a_run_acts_on_one_observation_and_on_many(folder):
    loaded = cl.load_policy(folder, seed=5, task=TASK)
    assert repr(loaded).startswith("CallablePolicy(Agent, obs (2,) -> action (2,), window, guidance='relative', ")
    many = loaded(SEEN)
    np.testing.assert_allclose(np.linalg.norm(many, axis=-1), 1, atol=1e-6)
    np.testing.assert_array_equal(loaded(SEEN[0]), many[0])
    assert isinstance(loaded.policy, Agent)
    np.testing.assert_array_equal(loaded.act(jax.random.key(0), None, jax.numpy.asarray(SEEN)), many)
    with pytest.raises(cl.UserError, match="no lane with seed 4"):
        cl.load_policy(folder, seed=4, task=TASK)
    with pytest.raises(cl.UserError, match=r"shape \(3,\): give \(2,\) or \(n, 2\)"):
        loaded(np.zeros(3))
    with pytest.raises(cl.UserError, match="not finite"):
        loaded(np.array([np.nan, 0.0]))
    taught = cl.teacher_of(loaded.policy)
    np.testing.assert_array_equal(taught.best_action(SEEN[0], jax.numpy.asarray(SEEN[0])), many[0])


def test_the_shipped_agent_is_loaded_without_worlds_and_without_a_training_program(monkeypatch):
    monkeypatch.setattr(Task, "environment", lambda *_: pytest.fail("an environment was made"))
    monkeypatch.setattr(lanes, "make_program", lambda *_: pytest.fail("a training program was made"))
    loaded = cl.load_policy("shipped:navigation")
    assert sum(np.size(leaf) for leaf in jax.tree.leaves(loaded.policy.view)) < 20
    size = sum(quantity.size for quantity in loaded.observation)
    np.testing.assert_allclose(np.linalg.norm(loaded(np.full(size, 0.5))), 1, atol=1e-6)


def test_labels_about_a_policys_own_actions_alone_lead_no_farther_than_they_reach():
    assert errors(policy) == pytest.approx(ERROR, abs=0.01)
    assert errors(correct(own_labels())) == pytest.approx(ERROR - 5.0, abs=0.5)


def changed(**parts):
    return own_labels()._replace(**parts)


def correct(labels, scalars=SCALARS):
    return cl.correct(policy, labels, space=DIRECTIONS, eps=5.0, guidance="relative", sizes=SIZES, scalars=scalars)


TABLE = cl.make("billiards")
OF_BILLIARDS = cl.CallablePolicy(Heuristic(TABLE.env), TABLE.env.observation)
# Each would lead to wrong numbers.
WRONG = [
    (lambda: correct(changed(answer=np.full(200, 0.5))), "an answer is none of"),
    (lambda: correct(changed(action=SEEN * 2)), "actions are no"),
    (lambda: correct(changed(obs=np.ma.masked_array(SEEN, SEEN > 0))), "masked"),
    (lambda: correct(own_labels(), scalars=WILD), "the fit of the feedback model diverged"),
    (lambda: cl.adapt(OF_BILLIARDS, WORLD, TEACHER), "this world has 2: give the world"),
    (lambda: cl.adapt(policy, WORLD, TEACHER, scalars=Scalars(eps_deg=float("nan"))), "scalars.eps_deg is nan"),
    (lambda: cl.adapt(policy, WORLD, TEACHER, labels=5), "labels is 5: give at least 20"),
    (lambda: cl.adapt(policy, WORLD, TEACHER, guidance="none"), "asks no questions"),
    (lambda: cl.adapt(policy, WORLD, TEACHER, judge_bounds=[2.0], guidance="relative"), "judge_bounds is 2"),
    (lambda: cl.adapt(policy, WORLD), "teacher is None: give one"),
    (lambda: cl.adapt(policy, WORLD, TEACHER, labels="some.parquet"), "give teacher or labels, not both"),
    (lambda: cl.adapt(policy, WORLD, TEACHER, eps_deg=200), "scalars.eps_deg is 200"),
    (lambda: cl.measure(policy, WORLD, steps=30, envs=4), "steps is 30: give a positive multiple of envs"),
    (lambda: cl.train(WORLD, None, probes.CONFIG, guidance=["relative"], seeds=1), "asks a teacher: give one"),
    (lambda: cl.train(WORLD, TEACHER, probes.CONFIG, guidance=["telepathy"]), "unknown guidance 'telepathy'"),
    (lambda: cl.train(WORLD, TEACHER, probes.CONFIG, seeds=[1, 1]), "seeds must be different"),
    (lambda: WORLD.environment("test"), "split is 'test'"),
    (lambda: WORLD.step(jax.random.key(0), SEEN[0], SEEN[0] * 0), "give an action of shape"),
    (lambda: cl.load_policy("nowhere"), "folder nowhere does not exist"),
]


@pytest.mark.parametrize(("call", "says"), WRONG, ids=[says for _, says in WRONG])
def test_what_would_lead_to_wrong_numbers_is_refused_in_one_line(call, says):
    with pytest.raises(cl.UserError, match=says) as refused:
        call()
    assert str(refused.value).isprintable()


def rows_of(rows, columns):
    return sorted(tuple(str(row[name]) for name in columns) for row in rows)


COLUMNS = ("guidance", "labels", "seed", "step", "reward", "train_loss", "guide_reward")


def test_training_from_python_gives_what_the_command_gives(folder):
    how = {"guidance": "relative", "labels": 10, "seeds": [3, 5], "progress": False}
    run = cl.train(WORLD, TEACHER, probes.CONFIG, **how)
    assert rows_of(run.results.to_pylist(), COLUMNS) == rows_of(results.read(folder).to_pylist(), COLUMNS)
    policy = run.policy(guidance="relative", seed=5)
    assert policy(SEEN).shape == (200, 2)
    assert (policy.trained, policy.world) == (run.config, WORLD)
    assert cl.read_run(folder).equals(results.read(folder))
    last = {row["seed"]: row["reward"] for row in run.results.sort_by("step").to_pylist()}
    assert run.policy().lane == {"guidance": "relative", "labels": 10, "seed": max(last, key=last.get)}
    with pytest.raises(cl.UserError, match="no lane with seed 9"):
        run.policy(seed=9)


def test_a_teacher_is_asked_itself_whatever_it_calls_policy():
    class Turning:
        policy = staticmethod(lambda obs: obs)

        def __call__(self, obs):
            return -np.asarray(obs)

    for teacher in (cl.teacher_of(Turning()), cl.api.worlds.teacher_of_world(Turning(), WORLD.actions)):
        np.testing.assert_array_equal(teacher.best_action(None, jnp.asarray(SEEN[0])), -SEEN[0])


def test_what_is_left_out_of_a_training_is_as_the_preset_has_it(monkeypatch):
    """In Python as on the command line: the kinds that can be had, the budgets and the seeds."""
    asked = []

    def in_memory(request, *others):
        asked.append(request)
        raise UserError("enough")

    monkeypatch.setattr(training.study, "in_memory", in_memory)
    preset = registry.find("billiards").presets["quickstart"]
    world = cl.make("billiards", table="one_ball")
    teacher = cl.teacher_of(world)
    for given, options in ((teacher, {}), (None, {}), (teacher, {"labels": [20], "seeds": 2})):
        with pytest.raises(UserError, match="enough"):
            cl.train(world, given, **options)
    whole, untaught, less = (request.grid for request in asked)
    seeds = tuple(range(preset.first_seed, preset.first_seed + preset.seeds))
    assert (whole.guidance, whole.labels, whole.seeds) == (preset.guidance, preset.labels, seeds)
    assert untaught.guidance == ("none",)
    assert (less.guidance, less.labels, less.seeds) == (preset.guidance, (20,), seeds[:2])
    assert all(request.config == dataclasses.replace(preset.config, task=world.config) for request in asked)


def test_a_label_file_answers_in_place_of_a_teacher(folder, tmp_path):
    """Trained on the labels of a run, an agent is what the command makes of `--labels-from`."""
    path = folder / "relative" / "labels.parquet"
    train.run(Order(TASK, probes.CONFIG, Grid(("relative",), (3,), (10,)), tmp_path / "given", labels_from=path))
    run = cl.train(WORLD, None, probes.CONFIG, guidance=["relative"], labels=path, seeds=[3], progress=False)
    assert rows_of(run.results.to_pylist(), COLUMNS) == rows_of(results.read(tmp_path / "given").to_pylist(), COLUMNS)
