"""Calls of the face that make no sense: each is refused in one line that names the argument, before any compile."""

import dataclasses

import jax
import numpy as np
import probes
import pytest

import cuelearner_jax as cl
from cuelearner_jax.config import GuideSizes, Scalars
from cuelearner_jax.policies import Uniform

TASK = dataclasses.replace(probes.make_task(), presets={})
WORLD = cl.World(TASK, probes.WindowConfig())
TEACHER = cl.teacher_of(WORLD)
SEEN = np.float32([[1, 0], [0, 1], [-1, 0], [0, -1]])
LABELS = cl.Labels(SEEN, SEEN, np.float32([1, 0, -1, 1]))
KEY = jax.random.key(0)
POLICY = cl.CallablePolicy(Uniform(), WORLD.env.observation)
ADAPTED = cl.AdaptedPolicy(Uniform(), WORLD.env.observation, outcome=None, named="chance")
MODEL = cl.FeedbackModel(None, None, Scalars(), LABELS, GuideSizes())
RUN = cl.Run(WORLD, probes.CONFIG, None, {})
NAN, INF, HUGE, ESCAPE = float("nan"), float("inf"), 10**30, "\x1b[31mred\nline"


class Broken:
    """Has what a policy has, and is no pytree."""

    def act(self, key, states, obs):
        return obs


# Of every whole number, angle, name, flag and place; what is no number of one kind is one of another.
NO_NUMBERS = (None, "3", b"3", [1], {}, 1j, np.zeros(2), object())
NO_WHOLE = (*NO_NUMBERS[1:], 0.5, True, NAN, INF, -1, HUGE)
NO_SEEDS = tuple(value for value in NO_WHOLE if not isinstance(value, list))
NO_ANGLES = (*NO_NUMBERS[1:], NAN, INF, -1.0, 0.0, True, HUGE, 181.0)
NO_NAMES = (3, b"agent", ["none"], ESCAPE, "", True)
NO_PATHS = (None, 3, b"runs", "", "a\0b", [], True, 0.5)
NO_WORLDS = (None, 3, "navigation", cl.World, TASK, probes.WindowConfig(), [])
NO_POLICIES = (None, 3, "agent", [], np.zeros((4, 2)), Broken(), b"", WORLD)
NO_TEACHERS = (3, "navigation", probes.Expert, lambda obs: obs[:, :1], [])
NO_SIZES = (3, "small", GuideSizes, {}, Scalars(), GuideSizes(fit_steps=0.5), GuideSizes(feedback_layers=("a",)))
NO_SCALARS = (3, "small", Scalars, {}, GuideSizes(), Scalars(eps_deg="5"), Scalars(k_max=None), Scalars(eps_deg=True))
NO_ROWS = (
    *("x", 3, np.zeros((4, 0)), np.zeros((2, 2, 2)), np.full((4, 2), NAN), np.full((4, 2), INF), SEEN + 1j),
    *(SEEN.astype(str), [[1.0], [1.0, 2.0]], None, np.full((4, 2), 1e39), np.full((4, 2), object())),
)
NO_LABELS = (
    *(None, b"labels", {}, [], (SEEN, SEEN), cl.Labels, "missing.parquet", "a\0b", ""),
    *(LABELS._replace(obs=rows) for rows in (*NO_ROWS, [1, 2], SEEN[:0])),
    *(LABELS._replace(action=rows) for rows in (*NO_ROWS, SEEN * 0, SEEN * 2)),
    *(LABELS._replace(answer=rows) for rows in (None, "x", 3, [0.5] * 4, [NAN] * 4, [1, 2], [1j] * 4, [[1], []])),
)


def asked(policy=POLICY, world=WORLD, teacher=TEACHER, labels=5, **others):
    return cl.ask(policy, world, teacher, labels=labels, **others)


def adapted(policy=POLICY, world=WORLD, teacher=TEACHER, **others):
    return cl.adapt(policy, world, teacher, **others)


def measured(policy=POLICY, world=WORLD, **others):
    return cl.measure(policy, world, **others)


def trained(world=WORLD, teacher=TEACHER, config=probes.CONFIG, **others):
    return cl.train(world, teacher, config, **{"progress": False, **others})


def loaded(folder="nowhere", **others):
    return cl.load_policy(folder, **others)


def fitted(labels=LABELS, **others):
    return cl.fit_feedback(labels, **others)


def refined(policy=POLICY, model=MODEL, **others):
    return cl.refine(policy, model, **others)


def exported(policy=POLICY, out="nowhere/new", world=WORLD, format="numpy"):
    return cl.export_policy(policy, out, world, format)


def stepped(key=KEY, state=SEEN[0], action=SEEN[0]):
    return WORLD.step(key, state, action)


def made(name="navigation", **others):
    return cl.make(name, **others)


def acted(obs=SEEN, key=KEY):
    return POLICY(obs, key)


def saved(folder="nowhere/new", overwrite=False):
    return ADAPTED.save(folder, overwrite)


def world_of(task=TASK, config=WORLD.config):
    return cl.World(task, config)


NO_KEYS = (3, "key", np.zeros(2), jax.random.split(KEY, 2), None, NAN)
# Of each call: an argument, and what it cannot be.
TABLE = {
    made: {
        "name": (None, 3, b"navigation", "", "navigaton", "a:b:c", ESCAPE, dataclasses.dataclass, NAN, ["billiards"]),
        "scenario": (*NO_NAMES, "flood"),
        "robot": (*NO_NAMES, "spot", "simple:folder"),
        "style": ("kitchen", 3, None, ["rooms"], b"rooms", np.zeros(2), ESCAPE),
        "stile": ("rooms",),
        "worlds": (*NO_WHOLE, None, 0, 2**40),
        "world_seed": (*NO_WHOLE, None),
        "max_steps": (0, NAN, "many", 10**7),
        "goal_radius": (0.0, -1.0, NAN, INF, "wide", None, HUGE),
        "lidar_rotation_deg": (NAN, INF, "15", None, True),
        "goal_rotation_deg": (NAN, INF, "15", None, True),
        "lidar_dropout": (-0.1, 1.1, NAN, "none"),
        "mirrors": (1, "yes", None, NAN, []),
        "preferred_side": ("up", "left", 1, None),
    },
    world_of: {"task": (None, "navigation", 3, type(TASK)), "config": (None, {}, probes.WindowConfig, "regulation")},
    WORLD.environment: {"split": (*NO_NAMES, None, "test")},
    WORLD.reset: {"key": NO_KEYS},
    stepped: {
        "key": NO_KEYS,
        "state": (None, 3, "x", np.zeros(3), {}),
        "action": (*NO_ROWS, SEEN, SEEN[0] * 0, np.ones(3)),
    },
    cl.teacher_of: {"source": (None, 3, "navigation", cl.World, probes.WindowConfig(), np.zeros(2), [], b"")},
    acted: {"obs": (*NO_ROWS, np.zeros(3), np.zeros((4, 3))), "key": NO_KEYS[:4]},
    loaded: {
        "folder": (*NO_PATHS, "nowhere", __file__),
        "base": NO_POLICIES[1:],
    },
    adapted: {
        "policy": NO_POLICIES,
        "world": (*NO_WORLDS, Uniform()),
        "teacher": (*NO_TEACHERS, None),
        "labels": (*NO_LABELS[1:], 0, -1, 0.5, True, NAN, 2**40, HUGE),
        "bound_deg": NO_ANGLES,
        "eps_deg": NO_ANGLES,
        "guidance": (*NO_NAMES, "telepathy", "none"),
        "changes": (3, "shift", [], [3]),
        "sizes": NO_SIZES,
        "scalars": NO_SCALARS,
        "seed": (*NO_WHOLE, None),
        "judge_by": (*NO_NAMES, "luck"),
        "judge_episodes": (*NO_WHOLE, None, 0, 10**9),
        "judge_bounds": (3, "half", [0], [2], [NAN], [None], ["x"], [True], 0.5, [[0.5]]),
    },
    measured: {
        "policy": NO_POLICIES,
        "world": NO_WORLDS,
        "steps": (*NO_WHOLE, 0, 30),
        "envs": (*NO_WHOLE, 0, 3),
        "episodes": (*NO_WHOLE, 0, 5),
        "engine": (*NO_NAMES, "mujoco"),
    },
    asked: {
        "policy": NO_POLICIES,
        "world": NO_WORLDS,
        "teacher": (*NO_TEACHERS, None),
        "labels": (*NO_WHOLE, None, 0, 2**40),
        "bound_deg": NO_ANGLES,
        "eps_deg": NO_ANGLES,
        "sizes": NO_SIZES,
        "scalars": NO_SCALARS,
        "seed": (*NO_WHOLE, None),
    },
    refined: {"policy": NO_POLICIES, "model": (None, 3, "model", cl.FeedbackModel, LABELS), "bound_deg": NO_ANGLES},
    fitted: {
        "labels": (*NO_LABELS, 3, True, NAN, LABELS._replace(obs=SEEN[:1], action=SEEN[:1], answer=[1])),
        "eps_deg": NO_ANGLES,
        "sizes": NO_SIZES,
        "scalars": NO_SCALARS,
        "seed": (*NO_WHOLE, None),
    },
    trained: {
        "world": NO_WORLDS,
        "teacher": NO_TEACHERS,
        "config": (None, 3, "quickstat", type(probes.CONFIG), {}, probes.config(sizes={"num_envs": 2.5})),
        "guidance": ("none", 3, None, [None], ["telepathy"], [3], ["none", "none"], b"none", [""]),
        "labels": (100, b"many", "many", *([bad] for bad in (*NO_WHOLE, None, 0, 2**40)), [5, 5]),
        "seeds": (0, *NO_SEEDS, *([bad] for bad in (*NO_WHOLE, None)), [], [1, 1]),
        "split": (*NO_NAMES, None, "test"),
        "progress": (1, "yes", None, []),
    },
    exported: {
        "policy": NO_POLICIES,
        "out": (*NO_PATHS, __file__),
        "world": NO_WORLDS,
        "format": (*NO_NAMES, None, "tflite"),
    },
    cl.load_exported: {"folder": (*NO_PATHS, "nowhere", __file__)},
    saved: {"folder": (*NO_PATHS, __file__), "overwrite": (1, "yes", None)},
    RUN.policy: {"guidance": NO_NAMES, "labels": NO_WHOLE, "seed": NO_WHOLE},
}
OTHERWISE = {"name": "task", "config": "sizes"}  # messages of what lies below say what it is, not the argument


def refused(call, name, value):
    with pytest.raises(cl.UserError, match=rf"\b({OTHERWISE.get(name, name)}|{name})\b") as refusal:
        call(**{name: value})
    assert str(refusal.value).isprintable()  # no line break, no escape sequence
    assert len(str(refusal.value)) < 400


@pytest.mark.parametrize("call", TABLE, ids=lambda call: getattr(call, "__name__", type(call).__name__))
def test_nonsense_is_refused_in_one_line_that_names_the_argument(call):
    """One value of each argument."""
    for name, values in TABLE[call].items():
        refused(call, name, values[0])


@pytest.mark.long
@pytest.mark.parametrize("call", TABLE, ids=lambda call: getattr(call, "__name__", type(call).__name__))
def test_all_nonsense_is_refused(call):
    for name, values in TABLE[call].items():
        for value in values:
            refused(call, name, value)
