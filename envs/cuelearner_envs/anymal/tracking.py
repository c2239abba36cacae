"""Measure how well a walking policy tracks random commands, in MJX and in C MuJoCo, by one protocol.

Commands change every 4 s. The last 2 s of each count as settled. An error is a mean over all settled stretches of
robots that stand: `error` is that of the stretch's mean velocity, `momentary_error` that of the velocity at each
moment, which includes the gait's sway.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Key, PRNGKeyArray

from cuelearner_envs.anymal import model as robot
from cuelearner_envs.anymal.judged import MujocoAnymal
from cuelearner_envs.anymal.locomotion import Trial, push_randomly, random_command, random_ground
from cuelearner_envs.anymal.physics import AnymalGround, AnymalState, control, standing
from cuelearner_envs.anymal.policy import WalkingPolicy, add_noise, observe

HELD, SETTLING = 200, 100  # control steps for which a command is held, and how many of them are not yet settled
STEPS = 1000  # of control that a robot walks: 20 s
TRIALS = {"clean": Trial(), "disturbed": Trial(noise=1.0, push=0.5), "varied": Trial(friction=(0.5, 1.25), payload=6.0)}


def _choose(
    policy: WalkingPolicy, trial: Trial, key: PRNGKeyArray, index: Array, qpos: Array, qvel: Array, last: Array
) -> tuple[Array, Array, PRNGKeyArray]:
    """Return a robot's action and command in a step, and the key of its pushes."""
    command = random_command(jax.random.fold_in(key, index // HELD), trial)
    k_noise, k_push = jax.random.split(jax.random.fold_in(jax.random.fold_in(key, 1), index))
    return policy(add_noise(k_noise, observe(qpos, qvel, last, command), trial.noise)), command, k_push


def _begin(trial: Trial, key: PRNGKeyArray, robots: int) -> tuple[AnymalGround, Key[Array, " robots"]]:
    """Return the ground and the key of each robot."""
    k_ground, k_run = jax.random.split(key)
    grounds = jax.vmap(partial(random_ground, trial=trial))(jax.random.split(k_ground, robots))
    return grounds, jax.random.split(k_run, robots)


@partial(jax.jit, static_argnames=("robots", "steps"))
def walk(
    policy: WalkingPolicy, trial: Trial, key: PRNGKeyArray, robots: int, steps: int
) -> tuple[Float[Array, "steps robots 3"], Float[Array, "steps robots 3"], Bool[Array, "steps robots"]]:
    """Velocities (`model.planar_velocity`), commands and who has fallen, step by step, in MJX."""
    grounds, keys = _begin(trial, key, robots)

    @partial(jax.vmap, in_axes=(0, 0, 0, None))
    def one(ground: AnymalGround, key: PRNGKeyArray, state: tuple, index: jax.Array) -> tuple[tuple, tuple]:
        body, last_action, down = state
        action, command, k_push = _choose(policy, trial, key, index, body.qpos, body.qvel, last_action)
        after, felt = control(push_randomly(k_push, body, trial), action, ground)
        down = down | felt.fallen
        body = jax.tree.map(partial(jnp.where, down), body, after)  # a fallen robot stays where it is
        return (body, action, down), (robot.planar_velocity(body.qpos, body.qvel), command, down)

    start: AnymalState = standing(jnp.zeros(2), 0.0)
    begun = (start, jnp.zeros(robot.JOINTS), jnp.array(False))
    states = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (robots, *leaf.shape)), begun)
    return jax.lax.scan(partial(one, grounds, keys), states, jnp.arange(steps))[1]


def walk_in_mujoco(
    policy: WalkingPolicy, trial: Trial, key: PRNGKeyArray, robots: int, steps: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """`walk` in C MuJoCo at its finer step."""
    grounds, keys = _begin(trial, key, robots)
    judge = MujocoAnymal(np.asarray(grounds.friction).tolist(), np.asarray(grounds.payload).tolist())

    @jax.jit
    @partial(jax.vmap, in_axes=(0, None, 0, 0, 0))
    def before(key: PRNGKeyArray, index: Array, qpos: Array, qvel: Array, last: Array) -> tuple[Array, Array, Array]:
        """Return the action, the command and the push of a step."""
        action, command, k_push = _choose(policy, trial, key, index, qpos, qvel, last)
        after = push_randomly(k_push, AnymalState(qpos, qvel, qvel), trial).qvel
        return action, command, after[:2] - qvel[:2]

    measure = jax.jit(jax.vmap(robot.planar_velocity))
    last = np.zeros((robots, robot.JOINTS), np.float32)
    rows = []
    for index in range(steps):
        last, command, change = jax.device_get(before(keys, jnp.int32(index), judge.qpos, judge.qvel, last))
        for number in np.flatnonzero(change.any(-1)):
            judge.push(int(number), change[number])
        judge.control(last)
        rows.append((np.asarray(measure(judge.qpos, judge.qvel)), command, judge.fallen.copy()))
    velocities, commands, down = (np.stack(column) for column in zip(*rows, strict=True))
    return velocities, commands, down


def figures(
    velocities: Float[np.ndarray, "steps robots 3"],
    commands: Float[np.ndarray, "steps robots 3"],
    down: Bool[np.ndarray, "steps robots"],
) -> dict[str, float]:
    """Errors of settled walking [m/s, rad/s] and the share of robots that fell."""
    velocities, commands, down = (np.asarray(leaf) for leaf in (velocities, commands, down))
    stretches = len(velocities) // HELD

    def settled(leaf: np.ndarray) -> np.ndarray:
        """(stretches, settled steps, robots, ...)"""
        return leaf[: stretches * HELD].reshape(stretches, HELD, *leaf.shape[1:])[:, SETTLING:]

    off, standing = settled(velocities - commands), ~settled(down).any(1)
    mean = off.mean(1)

    def over(values: np.ndarray) -> float:
        return float(values[standing].mean()) if standing.any() else float("nan")

    return {
        "error": over(np.linalg.norm(mean[..., :2], axis=-1)),
        "momentary_error": over(np.linalg.norm(off[..., :2], axis=-1).mean(1)),
        "turning_error": over(np.abs(mean[..., 2])),
        "falls": float(down[-1].mean()),
        "robots": down.shape[1],
        "seconds": len(down) * robot.CONTROL_PERIOD,
    }


def examine(policy: WalkingPolicy, key: PRNGKeyArray, robots: int) -> Iterator[tuple[str, dict[str, float]]]:
    """Figures of every trial of `TRIALS` in both engines, one after the other as they are measured."""
    for engine in ("mjx", "mujoco"):
        for name, trial in TRIALS.items():
            yield f"{engine}, {name}", measure(policy, engine, trial, key, robots)


def measure(policy: WalkingPolicy, engine: str, trial: Trial, key: PRNGKeyArray, robots: int) -> dict[str, float]:
    """Figures of 20 s of random commands in `mjx` or `mujoco`."""
    play = {"mjx": walk, "mujoco": walk_in_mujoco}[engine]
    return figures(*jax.device_get(play(policy, trial, key, robots=robots, steps=STEPS)))
