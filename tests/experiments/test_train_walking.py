"""Training a walker by brax's PPO on a task that needs no physics: a point is told which velocity to have."""

import json
from typing import ClassVar, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import train_walking
from brax import envs
from small_runs import listing

from cuelearner_envs.anymal import policy, tracking
from cuelearner_jax.errors import NotFinite, UserError
from cuelearner_jax.storage.folders import claimed

SMALL = train_walking.Training(
    steps=20_000,
    robots=16,
    layers=(16,),
    unroll=5,
    minibatches=2,
    batch_size=16,
    learning_rate=3e-3,
    episode=20,
    measurements=4,
    measured_robots=8,
)


class Point(envs.Env):
    """Pays for an action near the command that it shows."""

    observation_size, action_size, backend = 1, 1, "none"
    metrics: ClassVar[dict] = {}

    def reset(self, rng):
        command = jax.random.uniform(rng, (1,), minval=-0.8, maxval=0.8)
        return envs.State(None, command, jnp.zeros(()), jnp.zeros(()), {}, {})

    def step(self, state, action):
        return state.replace(reward=jnp.exp(-10 * jnp.sum(jnp.square(action - state.obs))))


class Normaliser(NamedTuple):
    """Of observations, as brax has it."""

    mean: jax.Array
    std: jax.Array


def error(params):
    """Mean distance between command and the policy's mean action, over the commands."""
    commands = jnp.linspace(-0.8, 0.8, 33)[:, None]
    normaliser, dense = params[0], params[1]["params"]
    x = (commands - normaliser.mean) / normaliser.std
    x = jax.nn.swish(x @ dense["hidden_0"]["kernel"] + dense["hidden_0"]["bias"])
    x = x @ dense["hidden_1"]["kernel"] + dense["hidden_1"]["bias"]
    return float(jnp.abs(jnp.tanh(x[:, :1]) - commands).mean())


def walker(after_measure=lambda: None):
    """The point with a walker's functions; its "policy" is how far it is off."""

    def measure(policy, key, robots):
        after_measure()
        return {"error": policy["error"], "turning_error": 0.0, "falls": 0.0, "robots": robots}

    def save(folder, policy, about):
        folder.mkdir(parents=True, exist_ok=True)
        (folder / "policy.json").write_text(json.dumps({**policy, **about}))

    return train_walking.Walker(
        environment=Point(),
        policy=lambda params: {"error": error(params)},
        measure=measure,
        examine=lambda policy, key, robots: iter([("trial", {"error": policy["error"], "robots": robots})]),
        save=save,
        load=lambda folder: json.loads((folder / "policy.json").read_text()),
    )


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    out, told = tmp_path_factory.mktemp("walkers") / "point", []
    about = train_walking.train(walker(), SMALL, out, 0, "the command", told.append)
    return out, about, told


@pytest.mark.long
def test_it_learns_what_is_commanded(trained):
    _, about, _ = trained
    before, *errors = (row[2] for row in about["history"]["rows"])
    assert np.median(errors) < 0.5 * before  # not each: so large a step size throws it back now and then


@pytest.mark.long
def test_it_says_how_it_went_and_what_made_it(trained):
    out, about, told = trained
    kept = json.loads((out / "policy.json").read_text())
    assert kept["finished"]
    assert kept["command"] == "the command"
    assert kept["config"]["robots"] == 16
    assert kept["figures"]["trial"]["robots"] == 8
    rows = kept["history"]["rows"]
    assert len(rows) == SMALL.measurements + 1
    assert [row[0] for row in rows] == sorted({row[0] for row in rows})
    assert kept["trained_steps"] == rows[-1][0] >= SMALL.steps
    assert len(told) == len(rows) + 3  # that it compiles, that it examines, one trial
    assert about == {name: kept[name] for name in about}


@pytest.mark.long
def test_a_folder_in_use_is_left_alone(trained):
    out, _, _ = trained
    before = listing(out)
    with pytest.raises(UserError, match="not empty: give another --out"):
        train_walking.train(walker(), SMALL, out, 0, "again")
    assert listing(out) == before


def test_a_folder_that_another_process_writes_in_is_left_alone(tmp_path):
    with claimed(tmp_path), pytest.raises(UserError, match="is being written by"):
        train_walking.train(walker(), SMALL, tmp_path, 0, "at the same time")


def test_a_policy_that_is_not_finite_is_not_written(tmp_path, monkeypatch):
    def diverge(robot, config, seed, look):
        layers = {name: {"kernel": jnp.ones((1, 1)), "bias": jnp.zeros(1)} for name in ("hidden_0", "hidden_1")}
        for steps, weight in enumerate((1.0, 1.0, jnp.nan)):
            normaliser = Normaliser(jnp.zeros(1), jnp.ones(1))
            look(steps, None, [normaliser, {"params": jax.tree.map(lambda leaf, by=weight: leaf * by, layers)}])

    monkeypatch.setattr(train_walking, "_ppo", diverge)
    with pytest.raises(NotFinite, match=r"by step 2, and was not written; .* holds the policy of the meas"):
        train_walking.train(walker(), SMALL, tmp_path / "wild", 0, "the command", lambda line: None)
    assert len(json.loads((tmp_path / "wild" / "policy.json").read_text())["history"]["rows"]) == 2


@pytest.mark.long
def test_training_that_dies_leaves_the_newest_policy(tmp_path):
    count = []

    def die():
        count.append(1)
        if len(count) == 3:
            raise RuntimeError("the machine is taken away")

    with pytest.raises(RuntimeError, match="taken away"):
        train_walking.train(walker(die), SMALL, tmp_path / "cut", 0, "the command", lambda line: None)
    kept = json.loads((tmp_path / "cut" / "policy.json").read_text())
    assert not kept["finished"]
    assert len(kept["history"]["rows"]) == 2


@pytest.mark.parametrize(
    ("changed", "says"),
    [
        ({"robots": 0}, "train.robots is 0: give a positive number"),
        ({"batch_size": 10}, "train.batch_size times train.minibatches is 20: give a multiple of train.robots"),
        ({"layers": ()}, "give at least one layer"),
        ({"seconds": -1.0}, "can't be negative"),
        ({"layers": (0,)}, "positive width"),
        ({"learning_rate": float("nan")}, "give a finite number"),
        ({"steps": 10**10}, "train.steps is 10000000000: give at most"),
        ({"robots": 10**9}, "train.robots is 1000000000: give at most"),
    ],
)
def test_what_cannot_work_is_refused(tmp_path, changed, says):
    config = train_walking.Training(**{**SMALL.__dict__, **changed})
    with pytest.raises(UserError, match=says):
        train_walking.train(walker(), config, tmp_path / "new", 0, "x")
    assert not (tmp_path / "new").exists()


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["evaluate", "nowhere"], "no walking policy in nowhere: train one with"),
        (["evaluate", "--robots", "0"], "--robots is 0: give a number from 1"),
        (["evaluate", "--out", "kept.json"], "exists: give another --out"),
        (["train", "--out", "."], "not empty: give another --out"),
    ],
)
def test_its_command_refuses_in_one_line(tmp_path, monkeypatch, capsys, arguments, says):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "kept.json").write_text("mine")
    assert train_walking.main(arguments) == 2
    assert says in capsys.readouterr().err
    assert (tmp_path / "kept.json").read_text() == "mine"


def test_a_policy_is_measured_trial_by_trial(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(tracking, "TRIALS", {"clean": tracking.CLEAN})
    monkeypatch.setattr(tracking, "SECONDS", 4.0)
    monkeypatch.setattr(tracking, "ENGINES", ("mujoco",))  # MJX compiles for long
    out = tmp_path / "figures.json"
    assert train_walking.main(["evaluate", str(policy.SHIPPED), "--robots", "3", "--out", str(out)]) == 0
    figures = json.loads(out.read_text())["figures"]
    assert list(figures) == ["mujoco, clean"]
    assert figures["mujoco, clean"]["robots"] == 3
    assert "mujoco, clean" in capsys.readouterr().out
