"""Robots in changed worlds: what is wrong there, how robots move, and what a teacher answers.

Errors (`ERRORS`) act on the executed action or on where goal and object are observed; in the last two, the teacher has
a way of its own. Functions take one world; `jax.vmap` serves many.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Literal, get_args

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from cuelearner_envs.zoo.robots import (
    AVOID,
    INSERT,
    RADIUS,
    SURFACE,
    TRACK,
    TWO_PHASE,
    Sight,
    Way,
    ZooRobot,
    across,
    encode,
    narrow,
    policy,
    script,
    spread_of,
)
from cuelearner_jax.spaces import UNSAID
from cuelearner_jax.spaces.directions import rotate

Error = Literal[
    "nothing",
    "constant",  # added to the executed action; directions: a turn
    "gain",  # each entry of the executed action times a factor of its own
    "mixing",  # pairs of entries of the executed action turned, in half ranges
    "seen_shift",  # goal and object observed aside
    "seen_turn",  # goal and object observed turned about a point
    "region",  # a constant where one coordinate of the position is above a threshold
    "waves",  # an error of the executed action that is a sine of the position
    "two",  # constant and seen_shift
    "other_way",  # nothing is wrong, but the teacher has another way
    "other_way_shift",  # seen_shift, and the teacher has another way
]
ERRORS: tuple[str, ...] = get_args(Error)
STEPS = 50  # of an episode
TOLERANCE = 0.07  # distance from the goal that counts as there, for n = 2
HOLD = 5  # steps in a row near the goal that make a success; 1 of directions, which cannot stop


class ZooWorld(struct.PyTreeNode):
    """A robot and what is wrong. Commands are in half ranges of the action; of directions, entry 0 is a turn [rad]."""

    robot: ZooRobot
    error: Int[Array, ""]  # index in `ERRORS`
    mixing: Float[Array, "n n"]  # of the command
    unmixing: Float[Array, "n n"]  # its inverse
    constant: Float[Array, " n"]
    region: Float[Array, " n"]  # added where the position is above `threshold` along `region_axis`
    region_axis: Float[Array, " n"]
    threshold: Float[Array, ""]
    waves: Float[Array, " n"]  # amplitudes
    wave_numbers: Float[Array, "n n"]  # [rad by unit of length]
    wave_phases: Float[Array, " n"]  # [rad]
    shift: Float[Array, " n"]  # of observed goal and object
    turn: Float[Array, "n n"]  # of observed goal and object, about `about`
    about: Float[Array, " n"]
    way: Way  # the teacher's
    other: Bool[Array, ""]  # the teacher has a way of its own


class State(struct.PyTreeNode):
    """State between steps."""

    position: Float[Array, " n"]
    velocity: Float[Array, " n"]  # [1 / step]
    anchor: Float[Array, " n"]  # the goal, or the point about which it moves
    thing: Float[Array, " n"]  # obstacle or object
    carries: Float[Array, ""]  # 1 once the object is carried
    near: Int[Array, ""]  # steps in a row near the goal; it stays once the task is done
    hit: Bool[Array, ""]  # the obstacle was touched before the task was done
    steps: Int[Array, ""]
    phase: Float[Array, ""]  # of what moves by itself [rad]


def change(key: PRNGKeyArray, robot: ZooRobot, error: int | Int[Array, ""]) -> ZooWorld:
    """Draw the world of an error, an index in `ERRORS`."""
    n, (k_wave, *keys) = robot.low.shape[0], jax.random.split(key, 15)
    error = jnp.asarray(error, jnp.int32)
    one_of = lambda *names: jnp.isin(error, jnp.asarray([ERRORS.index(name) for name in names]))  # noqa: E731
    only = lambda value, *names: jnp.where(one_of(*names), value, jnp.zeros_like(value))  # noqa: E731
    directions = robot.cues == 1
    # Sizes: commands in half ranges, turns of directions in rad
    least, most = (0.9, 2.1) if directions else (0.15, 0.5)
    gain, mixing = _gains(keys[0], n), _turns(keys[1], n, 0.9, 2.1)
    matrix = jnp.where(one_of("gain"), gain, jnp.where(one_of("mixing"), mixing, jnp.eye(n)))
    i, j = jax.random.permutation(keys[2], n)[:2]
    angle = _signed(keys[3], (), jnp.deg2rad(15.0), jnp.deg2rad(35.0))
    turn = jnp.eye(n).at[i, i].set(jnp.cos(angle)).at[j, j].set(jnp.cos(angle))
    turn = turn.at[i, j].set(-jnp.sin(angle)).at[j, i].set(jnp.sin(angle))
    region_axis = jnp.eye(n)[jax.random.randint(keys[4], (), 0, n)]
    factor = jnp.where(jax.random.bernoulli(keys[5]), 0.7, 1.4)
    way = robot.way
    other = Way(
        gain=way.gain * factor,
        cruise=way.cruise * 1.5,
        detour=way.detour * 1.3,
        side=-way.side,
        in_turn=jax.random.bernoulli(keys[6]) & (robot.task != AVOID),
    )
    has_other = one_of("other_way", "other_way_shift")
    shift = jax.random.normal(keys[7], (n,))
    shift = shift / jnp.linalg.norm(shift) * jax.random.uniform(keys[8], minval=0.12, maxval=0.35) * spread_of(n)
    return ZooWorld(
        robot=robot,
        error=error,
        mixing=matrix,
        unmixing=jnp.linalg.inv(matrix),
        constant=only(_signed(keys[9], (n,), least, most), "constant", "two"),
        region=only(_signed(keys[10], (n,), least, most), "region"),
        region_axis=region_axis,
        threshold=jax.random.uniform(keys[11], minval=-0.6, maxval=-0.2),
        waves=only(jnp.full(n, jax.random.uniform(k_wave, minval=0.5, maxval=1.1) * most), "waves"),
        wave_numbers=jax.random.normal(keys[12], (n, n)) * 4.0 / n**0.5,
        wave_phases=jax.random.uniform(keys[13], (n,), maxval=2 * jnp.pi),
        shift=only(shift, "seen_shift", "two", "other_way_shift"),
        turn=jnp.where(one_of("seen_turn"), turn, jnp.eye(n)),
        about=jnp.zeros(n).at[i].set(-1.2),
        way=jax.tree.map(lambda a, b: jnp.where(has_other, a, b), other, way),
        other=has_other,
    )


def unchanged(robot: ZooRobot) -> ZooWorld:
    """Return the world in which nothing is wrong."""
    return change(jax.random.key(0), robot, 0)


def reset(key: PRNGKeyArray, world: ZooWorld) -> State:
    """Begin an episode: the robot before the goal; what lies between them depends on the task."""
    robot, n = world.robot, world.robot.low.shape[0]
    spread, k = spread_of(n), jax.random.split(key, 6)
    ahead = _unit(jax.random.normal(k[0], (n,)))
    length = jax.random.uniform(k[1], minval=0.8, maxval=1.1) * spread
    length = jnp.where(robot.task == TWO_PHASE, 0.7 * length, length)
    centre = jax.random.uniform(k[2], (n,), minval=-0.2, maxval=0.2)
    start, goal = centre - ahead * length / 2, centre + ahead * length / 2
    _, height = across(robot, start - goal)
    start = jnp.where(robot.task == INSERT, start + robot.axis * (jnp.maximum(height, 0.45) - height), start)
    aside = jax.random.normal(k[3], (n,))
    aside = _unit(aside - jnp.dot(aside, ahead) * ahead) * spread
    anywhere = jax.random.uniform(k[4], (n,), minval=-0.8, maxval=0.8)
    thing = jnp.where(robot.task == AVOID, centre + 0.03 * aside, anywhere)
    thing = jnp.where(robot.task == TWO_PHASE, centre + 0.25 * aside, thing)
    zero, no = jnp.zeros((), jnp.int32), jnp.array(False)
    phase = jax.random.uniform(k[5], maxval=2 * jnp.pi)
    return State(start, jnp.zeros(n), goal, thing, jnp.zeros(()), zero, no, zero, phase)


def goal_of(world: ZooWorld, state: State) -> Float[Array, " n"]:
    """Return the place of the goal, which moves to and fro along the robot's axis in `track`."""
    sway = 0.2 * jnp.sin(0.07 * state.steps + state.phase) * world.robot.axis
    return state.anchor + jnp.where(world.robot.task == TRACK, sway, 0.0)


def sight_of(world: ZooWorld, state: State) -> Sight:
    """Return the true quantities of a state."""
    clutter = jnp.stack([jnp.ones(()), jnp.sin(0.05 * state.steps + state.phase), 0.01 * state.steps - 0.25])
    return Sight(state.position, goal_of(world, state), state.thing, state.velocity, state.carries, clutter)


def observe(world: ZooWorld, state: State) -> Float[Array, " obs"]:
    """Return the observation that the policy acts on."""
    sight = sight_of(world, state)
    view = lambda place: world.about + world.turn @ (place - world.about) + world.shift  # noqa: E731
    return encode(world.robot, sight.replace(goal=view(sight.goal), thing=view(sight.thing)))


def step(world: ZooWorld, state: State, action: Float[Array, " n"]) -> tuple[State, Float[Array, ""]]:
    """Execute an action; return the state and the reward: minus the distance that is left, 0 once the task is done."""
    robot, spread, success_now = world.robot, spread_of(world.robot.low.shape[0]), success(world, state)
    speed = robot.drive * execute(world, state.position, action)
    velocity = robot.lag * state.velocity + (1 - robot.lag) * speed
    position = jnp.clip(state.position + velocity, -3.0, 3.0)
    position = jnp.where(robot.task == INSERT, _stopped(world, state, position), position)
    velocity = position - state.position
    reaches = jnp.linalg.norm(position - state.thing) < TOLERANCE * spread
    carries = jnp.where((robot.task == TWO_PHASE) & reaches, 1.0, state.carries)
    thing = state.thing + carries * velocity * (state.carries > 0)
    touches = (robot.task == AVOID) & (jnp.linalg.norm(position - thing) < RADIUS * spread)
    after = state.replace(
        position=position, velocity=velocity, thing=thing, carries=carries, hit=state.hit | touches & ~success_now,
        steps=state.steps + 1,
    )  # fmt: skip
    goal = goal_of(world, after)
    carrier = jnp.where(robot.task == TWO_PHASE, thing, position)
    distance = jnp.linalg.norm(goal - carrier) / spread
    near = jnp.where(distance < TOLERANCE, state.near + 1, 0)
    after = after.replace(near=jnp.where(success_now, state.near, near))
    approach = jnp.where(robot.task == TWO_PHASE, 0.5 * jnp.linalg.norm(thing - position) / spread, 0.0)
    reward = -jnp.minimum(distance + approach, 2.0) - 0.5 * touches
    return after, jnp.where(success_now, 0.0, reward)


def success(world: ZooWorld, state: State) -> Bool[Array, ""]:
    """Return whether the robot has been near the goal for `HOLD` steps in a row, at any time, and touched nothing."""
    return (state.near >= (1 if world.robot.cues == 1 else HOLD)) & ~state.hit


def execute(world: ZooWorld, position: Float[Array, " n"], action: Float[Array, " n"]) -> Float[Array, " n"]:
    """Return what is executed in place of an action."""
    robot, error = world.robot, _error(world, position)
    if robot.cues == 1:
        return robot.retract(rotate(world.mixing @ action, error[0]))
    return (world.mixing @ (action / robot.half) + error) * robot.half


def right(world: ZooWorld, state: State) -> Float[Array, " n"]:
    """Return the teacher's action: its effect is that of the unchanged policy's (or the teacher's own) true action.

    Where no action within the bounds has this effect, it is clipped.
    """
    robot, error, sight = world.robot, _error(world, state.position), sight_of(world, state)
    own = jnp.where(world.other, script(robot, world.way, sight), policy(robot, encode(robot, sight)))
    if robot.cues == 1:
        return robot.retract(world.unmixing @ rotate(own, -error[0]))
    return robot.retract(world.unmixing @ (own / robot.half - error) * robot.half)


def answer(
    key: PRNGKeyArray,
    world: ZooWorld,
    state: State,
    action: Float[Array, " n"],
    eps: float | Float[Array, ""],
    wrong: float | Float[Array, ""] = 0.0,
    one_cue: bool | Bool[Array, ""] = False,
) -> Float[Array, " cues"]:
    """Return a relative answer about an action: h in {-1, 0, 1} for each cue, `UNSAID` where nothing is said.

    `eps` is the strength of an answer, in shares of the range or rad: differences below eps / 2 are answered by 0.
    `wrong` is the share of answers with the wrong sign. With `one_cue` the cue that differs most is answered alone.
    """
    change = world.robot.log(action, right(world, state))
    h = jnp.where(jnp.abs(change) > eps / 2, jnp.sign(change), 0.0)
    h = jnp.where(jax.random.uniform(key, h.shape) < wrong, -h, h)
    most = jnp.arange(h.shape[0]) == jnp.argmax(jnp.abs(change))
    return jnp.where(jnp.asarray(one_cue) & ~most, UNSAID, h)


def rollout(
    key: PRNGKeyArray, world: ZooWorld, act: Callable[[Any], Array], steps: int = STEPS, *, knows: bool = False
) -> tuple[Float[Array, "steps obs"], State, Float[Array, ""], Bool[Array, ""]]:
    """Play an episode; return the observations and states acted in, the return and the success.

    `act` takes an observation (obs,); with `knows`, a `State`, as a teacher does.
    """

    def one(state: State, _: None) -> tuple[State, tuple]:
        obs = observe(world, state)
        after, reward = step(world, state, act(state if knows else obs))
        return after, (obs, state, reward)

    last, (obs, states, rewards) = jax.lax.scan(one, reset(key, world), None, steps)
    return obs, states, rewards.sum(), success(world, last)


def _error(world: ZooWorld, position: Float[Array, " n"]) -> Float[Array, " n"]:
    """Return what is added to the executed command at a position."""
    inside = jnp.dot(position, world.region_axis) > world.threshold
    wave = world.waves * jnp.sin(world.wave_numbers @ position + world.wave_phases)
    return world.constant + jnp.where(inside, world.region, 0.0) + wave


def _stopped(world: ZooWorld, state: State, position: Float[Array, " n"]) -> Float[Array, " n"]:
    """Return the position that the surface around the hole, and the hole's wall, allow."""
    robot, goal = world.robot, goal_of(world, state)
    lateral, height = across(robot, position - goal)
    _, before = across(robot, state.position - goal)
    apart = jnp.linalg.norm(lateral)
    fits, was_above = apart <= narrow(robot), before >= SURFACE
    height = jnp.where((height < SURFACE) & was_above & ~fits, SURFACE, jnp.maximum(height, 0.0))
    lateral = jnp.where(was_above | fits, lateral, lateral * narrow(robot) / jnp.maximum(apart, 1e-6))
    return goal + lateral + height * robot.axis


def _signed(key: PRNGKeyArray, shape: tuple[int, ...], least: float | Array, most: float | Array) -> Array:
    """Draw sizes between two, with random signs."""
    k_size, k_sign = jax.random.split(key)
    size = jax.random.uniform(k_size, shape, minval=least, maxval=most)
    return size * jax.random.rademacher(k_sign, shape, jnp.float32)


def _gains(key: PRNGKeyArray, n: int) -> Float[Array, "n n"]:
    """Draw a factor for each entry: for the first drawn one and half of the others, a slow or a reversed one."""
    k_size, k_reverse, k_which, k_first = jax.random.split(key, 4)
    size = jax.random.uniform(k_size, (n,), minval=0.45, maxval=0.7)
    size = size * jnp.where(jax.random.uniform(k_reverse, (n,)) < 0.5, -1.0, 1.0)
    which = jax.random.bernoulli(k_which, 0.5, (n,)).at[jax.random.randint(k_first, (), 0, n)].set(True)
    return jnp.diag(jnp.where(which, size, 1.0))


def _turns(key: PRNGKeyArray, n: int, least: float, most: float) -> Float[Array, "n n"]:
    """Draw turns of pairs of entries; of an odd number of entries, one stays."""
    k_order, k_angle = jax.random.split(key)
    angles, turns = _signed(k_angle, (n // 2,), least, most), jnp.eye(n)
    for pair in range(n // 2):
        cos, sin = jnp.cos(angles[pair]), jnp.sin(angles[pair])
        at = slice(2 * pair, 2 * pair + 2)
        turns = turns.at[at, at].set(jnp.stack([jnp.stack([cos, -sin]), jnp.stack([sin, cos])]))
    order = jnp.eye(n)[jax.random.permutation(k_order, n)] if n > 2 else jnp.eye(n)
    return order.T @ turns @ order


def _unit(vector: Float[Array, " n"]) -> Float[Array, " n"]:
    return vector / jnp.maximum(jnp.linalg.norm(vector), 1e-6)
