"""Draw groups of robots, half of them with a small network distilled from their script (DAgger)."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Float, Int, PRNGKeyArray

from cuelearner_envs.zoo.robots import ZooRobot, decode, dimensions, draw, network, policy, run_network, script
from cuelearner_envs.zoo.worlds import STEPS, rollout, unchanged

SPLITS = {"tuning": 0, "held_out": 1}
ROUNDS = 6  # of roll-outs; the script acts in the first
EPISODES = 24  # of a round
FITTING = 400  # steps of Adam after each round
BATCH = 256
ENOUGH = 0.8  # success from which a network is used


def robots(
    key: PRNGKeyArray, cues: int, count: int, split: str = "tuning", first: int | Int[Array, ""] = 0
) -> ZooRobot:
    """Draw the robots `first`, ..., `first + count - 1` of a group. Leading axis of the result: count.

    The policies of odd robots are networks, unless a network succeeds in fewer than `ENOUGH` of the episodes. A robot
    is the same, to rounding, in whatever piece of its group it is drawn. Jit with `cues`, `count`, `split` static.

    `cues` 1: directions. `split`: "tuning" for settings, "held_out" for reports. `first` must be even.
    """
    key = jax.random.fold_in(jax.random.fold_in(key, SPLITS[split]), cues)
    keys = jax.vmap(lambda number: jax.random.fold_in(key, number))(first + jnp.arange(count))
    each = jax.vmap(lambda key: draw(key, cues))(keys)
    if count < 2:
        return each
    odd = jax.tree.map(lambda leaf: leaf[1::2], each)
    taught = jax.vmap(lambda key, robot: distil(jax.random.fold_in(key, 1), robot))(keys[1::2], odd)
    return jax.tree.map(lambda leaf, new: leaf.at[1::2].set(new), each, taught)


def distil(key: PRNGKeyArray, robot: ZooRobot) -> ZooRobot:
    """Return the robot with a network in place of its script, or the robot itself where the network succeeds less."""
    size, n = robot.unit.shape[0], dimensions(robot.cues)
    k_first, k_net, k_rounds, k_test = jax.random.split(key, 4)
    first, _ = _play(k_first, robot, EPISODES)
    flat = first.reshape(-1, size)
    scale = jnp.maximum(flat.std(0), 0.01 * robot.unit[robot.order])
    net = network(k_net, size, n) | {"mean": flat.mean(0), "scale": scale}
    adam = optax.adam(optax.cosine_decay_schedule(3e-3, ROUNDS * FITTING, 0.02))
    target = jax.vmap(lambda obs: script(robot, robot.way, decode(robot, obs)) / robot.half)

    def loss(layers: Any, obs: Array) -> Float[Array, ""]:
        outputs = jax.vmap(lambda one: run_network(net | {"layers": layers}, one))(obs)
        return jnp.mean(jnp.square(outputs - target(obs)))

    def fit(data: Array, rows: Array, carry: tuple, key: PRNGKeyArray) -> tuple[tuple, None]:
        layers, moments = carry
        obs = data[jax.random.randint(key, (BATCH,), 0, rows)]
        updates, moments = adam.update(jax.grad(loss)(layers, obs), moments)
        return (optax.apply_updates(layers, updates), moments), None

    def one_round(carry: tuple, number: Array) -> tuple[tuple, None]:
        data, layers, moments = carry
        k_fit, k_play = jax.random.split(jax.random.fold_in(k_rounds, number))
        rows = (number + 1) * EPISODES * STEPS
        steps = lambda carry, key: fit(data, rows, carry, key)  # noqa: E731
        (layers, moments), _ = jax.lax.scan(steps, (layers, moments), jax.random.split(k_fit, FITTING))
        obs, _ = _play(k_play, robot.replace(neural=jnp.array(True), net=net | {"layers": layers}), EPISODES)
        return (jax.lax.dynamic_update_slice(data, obs.reshape(-1, size), (rows, 0)), layers, moments), None

    data = jnp.zeros(((ROUNDS + 1) * EPISODES * STEPS, size)).at[: flat.shape[0]].set(flat)
    start = data, net["layers"], adam.init(net["layers"])
    (_, layers, _), _ = jax.lax.scan(one_round, start, jnp.arange(ROUNDS))
    pupil = robot.replace(neural=jnp.array(True), net=net | {"layers": layers})
    succeeds = _play(k_test, pupil, 2 * EPISODES)[1]
    return jax.tree.map(lambda new, old: jnp.where(succeeds.mean() >= ENOUGH, new, old), pupil, robot)


def _play(key: PRNGKeyArray, robot: ZooRobot, episodes: int) -> tuple[Float[Array, "episodes steps obs"], Array]:
    """Return the observations and successes of a robot's policy where nothing is wrong."""
    act = lambda obs: policy(robot, obs)  # noqa: E731
    obs, _, _, success = jax.vmap(lambda key: rollout(key, unchanged(robot), act))(jax.random.split(key, episodes))
    return obs, success
