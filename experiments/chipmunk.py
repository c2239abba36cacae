"""Billiards as the paper's public code has it, in all that differs from this package: `chipmunk:TASK` and its parts.

Source: the public code of arXiv 2507.04730, as read in its simulator, trainer and networks. The simulator is Chipmunk
with a fixed step of 0.02 s, in which balls overlap by up to a radius; here the same algorithm runs in JAX. Pockets and
rest are tested every 20 steps. An episode ends with a cleared table alone. The rack's rows are 2.1 radii apart.
`Agent` learns from 80% of its replay. In guided episodes `Kind` refines a uniform action, and its targets have no unit.
All networks start as PyTorch's layers do.
"""

from __future__ import annotations

import dataclasses
import math
from functools import partial
from pathlib import Path
from typing import Any, ClassVar, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from cuelearner_envs.billiards.config import BilliardsConfig, make_environment
from cuelearner_envs.billiards.contacts import RIM_PER_IMPULSE, TANGENT_PER_DISC
from cuelearner_envs.billiards.environment import Balls, Billiards
from cuelearner_envs.billiards.physics import Shot
from cuelearner_envs.billiards.table import corner_gap, parking
from cuelearner_jax import teachers
from cuelearner_jax.agents.ddqn import DDQNConfig, DDQNState, DoubleDQN, optimizer
from cuelearner_jax.agents.replay import RingBuffer
from cuelearner_jax.config import Frame, GuideScalars, part
from cuelearner_jax.environment import Features, Spaces
from cuelearner_jax.guides.base import Actions, Guide, Observations, Rows
from cuelearner_jax.guides.fitting import Example, fit_model
from cuelearner_jax.guides.refining import Refinement
from cuelearner_jax.guides.relative import Relative
from cuelearner_jax.task import Body
from cuelearner_jax.tasks.billiards import BILLIARDS
from cuelearner_jax.types import GuidanceModel, Label, Params, Teacher

STEP, STEPS = 0.02, 20  # [s], and steps between two tests of pockets and rest
SWEEPS, TESTS = 2, 60  # of impulses in a step, where Chipmunk makes 10; largest number of tests in a shot
TRAINING_SHARE = 5  # every fifth row of replay is kept for validation
Ball = dict[str, Array]  # x, y [m]; ux, uy [m/s]; rim: spin as speed of the rim [m/s]; out: pocketed?


def fixed_step(table: Any, balls: list[Ball]) -> list[Ball]:
    """Return the balls 0.02 s later: positions, then contacts, drag and impulses, as Chipmunk orders them.

    Contacts keep no impulses from step to step: for a single contact that changes nothing.
    """
    balls = [{**ball, "x": ball["x"] + STEP * ball["ux"], "y": ball["y"] + STEP * ball["uy"]} for ball in balls]
    contacts = [_between(table, balls, a, b) for a in range(len(balls)) for b in range(a)]
    contacts += [_at_cushion(table, balls, a) for a in range(len(balls))]
    bounces = [table.restitution * _speeds(balls, contact)[0] for contact in contacts]
    kept = table.speed_kept**STEP
    balls = [{**ball, **{name: kept * ball[name] for name in ("ux", "uy", "rim")}} for ball in balls]
    none = [jnp.zeros_like(contact[-1]) for contact in contacts]
    now = _Impulses(balls, none, none)
    for _ in range(SWEEPS):
        now = _sweep(table, contacts, bounces, now)
    return now.balls


class _Impulses(NamedTuple):
    """The state of Chipmunk's solver within a step."""

    balls: list[Ball]
    normal: list[Array]  # sums of impulses at each contact
    along: list[Array]


def _sweep(table: Any, contacts: list[tuple[Any, ...]], bounces: list[Array], now: _Impulses) -> _Impulses:
    """Return the state after an impulse at every contact, one after another."""
    balls, normal, along = list(now.balls), [], []
    for contact, bounce, jn, jt in zip(contacts, bounces, now.normal, now.along, strict=True):
        (a, b, nx, ny, depth), discs = contact, 1.0 if contact[1] is None else 2.0
        off, slip = _speeds(balls, contact)
        pushed = jnp.where(depth > 0, jnp.maximum(jn - (bounce + off) / discs, 0.0), 0.0)
        most = table.friction * pushed
        rubbed = jnp.clip(jt - slip / (TANGENT_PER_DISC * discs), -most, most)
        more_n, more_t = pushed - jn, rubbed - jt
        for which, sign in ((a, 1.0), (b, -1.0)):
            if which is not None:
                ball = dict(balls[which])
                ball["ux"] += sign * (more_n * nx - more_t * ny)
                ball["uy"] += sign * (more_n * ny + more_t * nx)
                ball["rim"] += RIM_PER_IMPULSE * more_t
                balls[which] = ball
        normal.append(pushed)
        along.append(rubbed)
    return _Impulses(balls, normal, along)


def _speeds(balls: list[Ball], contact: tuple[Any, ...]) -> tuple[Array, Array]:
    """Return the speeds with which ball a leaves b or a cushion, and slips along it."""
    a, b, nx, ny, _ = contact
    still = dict.fromkeys(("ux", "uy", "rim"), jnp.zeros_like(nx))
    one, other = balls[a], still if b is None else balls[b]
    vx, vy = one["ux"] - other["ux"], one["uy"] - other["uy"]
    return vx * nx + vy * ny, vy * nx - vx * ny - one["rim"] - other["rim"]


def _contact(a: int, b: int | None, dx: Array, dy: Array, reach: Any, absent: Array) -> tuple[Any, ...]:
    length = jnp.sqrt(dx * dx + dy * dy)
    scale = 1.0 / jnp.where(length > 0, length, 1.0)
    return a, b, dx * scale, dy * scale, jnp.where(absent, -1.0, reach - length)


def _between(table: Any, balls: list[Ball], a: int, b: int) -> tuple[Any, ...]:
    one, other = balls[a], balls[b]
    absent = one["out"] | other["out"]
    return _contact(a, b, one["x"] - other["x"], one["y"] - other["y"], 2 * table.ball_radius, absent)


def _at_cushion(table: Any, balls: list[Ball], a: int) -> tuple[Any, ...]:
    """Return a ball's contact with the nearest point of a cushion's centre line."""
    ball, gap, hole = balls[a], corner_gap(table), jnp.asarray(table.hole_width)
    x, y, half_x, half_y = ball["x"], ball["y"], table.width / 2, table.height / 2
    least = hole if table.side_pockets else 0.0
    near_x = jnp.where(x < 0, -1.0, 1.0) * jnp.clip(jnp.abs(x), least, half_x - gap)
    if not table.side_pockets:
        near_x = jnp.clip(x, -(half_x - gap), half_x - gap)
    near_y, side_x, side_y = jnp.clip(y, -(half_y - gap), half_y - gap), jnp.sign(x) * half_x, jnp.sign(y) * half_y
    at_long, at_end = (x - near_x, y - side_y), (x - side_x, y - near_y)
    is_long = at_long[0] ** 2 + at_long[1] ** 2 <= at_end[0] ** 2 + at_end[1] ** 2
    dx, dy = (jnp.where(is_long, *pair) for pair in zip(at_long, at_end, strict=True))
    return _contact(a, None, dx, dy, table.ball_radius + table.cushion_radius, ball["out"])


class ChipmunkBilliards(Billiards, kw_only=True):
    """Billiards in which Chipmunk's algorithm plays, and no limit of shots ends an episode."""

    def reset(self, key: PRNGKeyArray) -> tuple[Balls, Float[Array, " obs"]]:
        """Rack the balls in rows 2.1 radii apart; the heads' row stands where it does in this package."""
        balls, _ = super().reset(key)
        row = jnp.asarray([0, 0, 1, 1][: self.table.balls])
        shift = row * 2.1 * self.table.ball_radius * (1 - math.sqrt(0.75))
        balls = balls.replace(positions=balls.positions.at[:, 0].add(shift))
        return balls, self.observe(balls)

    def simulate(self, balls: Balls, angle: Float[Array, ""]) -> Shot:
        """Play one shot in steps; the balls' speeds are zero at its end."""
        table, zero = self.table, jnp.zeros_like(angle)
        place = parking(table)

        def start(number: int) -> Ball:
            speed = table.strike_speed if number == 0 else 0.0
            of = {"x": balls.positions[number, 0], "y": balls.positions[number, 1], "rim": zero}
            return {**of, "ux": speed * jnp.cos(angle), "uy": speed * jnp.sin(angle), "out": balls.pocketed[number]}

        def test(carry: tuple[list[Ball], Array, Array]) -> tuple[list[Ball], Array, Array]:
            now, count, _ = carry
            now = jax.lax.fori_loop(0, STEPS, lambda _, balls: fixed_step(table, balls), now)
            half_x, half_y = table.width / 2 + table.pocket_margin, table.height / 2 + table.pocket_margin
            for number, ball in enumerate(now):
                out = ball["out"] | (jnp.abs(ball["x"]) > half_x) | (jnp.abs(ball["y"]) > half_y)
                speeds = {name: jnp.where(out, 0.0, ball[name]) for name in ("ux", "uy", "rim")}
                places = {name: jnp.where(out, place[number, i], ball[name]) for i, name in enumerate("xy")}
                now[number] = {**places, **speeds, "out": out}
            speed = jnp.stack([jnp.hypot(ball["ux"], ball["uy"]) for ball in now]).max()
            return now, count + 1, speed < table.stop_speed

        begin = [start(number) for number in range(table.balls)], jnp.zeros((), jnp.int32), jnp.zeros((), bool)
        now, count, is_over = jax.lax.while_loop(lambda carry: ~carry[2] & (carry[1] < TESTS), test, begin)
        positions = jnp.stack([jnp.stack([ball["x"], ball["y"]]) for ball in now])
        pocketed = jnp.stack([ball["out"] for ball in now])
        return Shot(positions, pocketed, count * STEPS * STEP, count * STEPS, ~is_over)

    def features(self, obs: Float[Array, " obs"], actions: Float[Array, "*n 2"]) -> Features:
        """Return raw coordinates, so that a teacher's network sees them too."""
        return Features(obs, actions)


def torch_start(params: Params, key: PRNGKeyArray) -> Params:
    """Return the parameters of dense layers as PyTorch draws them: uniform within 1 / sqrt(inputs), biases too."""
    layers, inner = {}, params["params"]
    for name, k_layer in zip(inner, jax.random.split(key, len(inner)), strict=True):
        limit = 1.0 / math.sqrt(inner[name]["kernel"].shape[0])
        draw = partial(jax.random.uniform, minval=-limit, maxval=limit)
        keys = dict(zip(("kernel", "bias"), jax.random.split(k_layer), strict=True))
        layers[name] = {end: draw(keys[end], inner[name][end].shape) for end in keys}
    return {"params": layers}


class TrainingRows(RingBuffer):
    """Replay of which every fifth row is never drawn."""

    def __init__(self, own: RingBuffer) -> None:
        self.__dict__ = dict(own.__dict__)

    def draw(self, key: PRNGKeyArray, rows: Array, step: Array, batch_size: int) -> Array:
        """Draw numbers of rows."""
        kept = TRAINING_SHARE - 1
        number = jax.random.randint(key, (batch_size,), 0, jnp.clip(step, 1, rows.shape[0]) * kept // TRAINING_SHARE)
        return number + number // kept


class PublicDQN(DoubleDQN):
    """Double DQN that starts as PyTorch's layers do and learns from 80% of its replay."""

    def init(self, key: PRNGKeyArray) -> tuple[Params, DDQNState]:
        """Return parameters; targets do not bootstrap here."""
        params = torch_start(super().init(key)[0], key)
        return params, DDQNState(None, optimizer(self.options.optimizer, 0.0, 0.0).init(params))

    def update(self, *arguments: Any) -> tuple[Params, DDQNState, Array, Array]:
        """Make one gradient step on the rows for training."""
        *others, memory, key = arguments
        return super().update(*others, memory._replace(buffer=TrainingRows(memory.buffer)), key)


@part
class Agent(DDQNConfig):
    """Options of the public code's agent."""

    NAME: ClassVar[str] = "public"
    ABOUT: ClassVar[str] = "double DQN as the paper's public code has it"

    def make(self, frame: Frame, spaces: Spaces, bootstraps: bool = False) -> PublicDQN:
        """Return the agent for an environment's spaces."""
        return PublicDQN(self, frame, spaces, bootstraps)


def key_of(obs: Float[Array, " obs"]) -> PRNGKeyArray:
    """Return a random key of a situation."""
    bits = jax.lax.bitcast_convert_type(obs, jnp.uint32)
    places = jnp.arange(1, len(bits) + 1, dtype=jnp.uint32) * jnp.uint32(0x9E3779B1)  # Knuth's multiplicative hash
    return jax.random.key(jnp.sum(bits * places, dtype=jnp.uint32))


class Kind(Relative):
    """Relative feedback that refines uniform actions; targets are in no unit, and networks start as PyTorch's do."""

    name: ClassVar[str] = "public"

    def init(self, key: PRNGKeyArray) -> GuidanceModel:
        """Return an unfitted model."""
        return GuidanceModel(torch_start(self.network.init(key), key), jnp.array(False))

    def examples(self, labels: Label, scalars: GuideScalars) -> Example:
        """Return labels (slots, ...) with differences of unit vectors as targets."""
        return Guide.examples(self, labels, scalars)

    def fit(self, key: PRNGKeyArray, env: Any, labels: Label, former: Any, scalars: GuideScalars) -> GuidanceModel:
        """Return the model of labels (slots, ...)."""
        rows, losses = self.examples(labels, scalars), partial(self.losses, env, scalars)
        return fit_model(
            key, rows, scalars, init=lambda key: self.init(key).params, losses=losses, sizes=self.sizes,
            augment=self.augmented,
        )  # fmt: skip

    def act(
        self, model: GuidanceModel, env: Any, obs: Observations, actions: Actions, active: Rows, scalars: GuideScalars
    ) -> Refinement:
        """Refine a uniform action of each situation, in active rows of a fitted model."""
        space, begins = self.spaces.actions, active & model.fitted
        uniform = jax.vmap(lambda row: space.sample(key_of(row), ()))(obs)
        phi = partial(self.predict, env, model.params, obs)
        return self.refined(phi, jnp.where(begins[:, None], uniform, actions), begins, scalars)


def _environment(config: BilliardsConfig, split: str) -> ChipmunkBilliards:
    own = make_environment(config)
    fields: dict[str, Any] = {field.name: getattr(own, field.name) for field in dataclasses.fields(own)}
    fields["max_shots"] = 1 << 30
    return ChipmunkBilliards(**fields)


def _teacher(config: BilliardsConfig, env: Any) -> Teacher:
    """Return a network's plain best action, or the search of the package."""
    search = config.teacher == "search"
    return BILLIARDS.make_teacher(config, env) if search else teachers.load(Path(config.teacher), env, 0.0, 0.0)


BODY = Body("chipmunk", "strikes on a table simulated by Chipmunk's algorithm in steps of 0.02 s", _environment)
TASK = dataclasses.replace(
    BILLIARDS,
    name="chipmunk",
    bodies=(BODY,),
    teacher=_teacher,
    files=lambda config: {} if config.teacher == "search" else {"teacher": teachers.digest(Path(config.teacher))},
)
