"""Training a walker by brax's PPO on a task that needs no physics: a point is told which velocity to have."""

import json
from typing import ClassVar, NamedTuple

import jax
import jax.numpy as jnp
import pytest
import train_walking
from brax import envs

from cuelearner_envs.anymal import policy, tracking
from cuelearner_jax.errors import NotFinite

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


def test_a_policy_is_measured_trial_by_trial(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(tracking, "TRIALS", {"clean": tracking.TRIALS["clean"]})
    monkeypatch.setattr(tracking, "STEPS", 200)
    monkeypatch.setattr(tracking, "ENGINES", ("mujoco",))  # MJX compiles for long
    out = tmp_path / "figures.json"
    assert train_walking.main(["evaluate", str(policy.SHIPPED), "--robots", "3", "--out", str(out)]) == 0
    figures = json.loads(out.read_text())["figures"]
    assert list(figures) == ["mujoco, clean"]
    assert figures["mujoco, clean"]["robots"] == 3
    assert "mujoco, clean" in capsys.readouterr().out
