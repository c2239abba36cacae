"""Shots in pooltool, on our table. The only file that knows pooltool; nothing here computes with JAX.

The outline is that of `cuelearner_envs.billiards.table`: cushions with rounded ends, pockets that take a ball once its
centre has left the table between two of them. What happens on it is pooltool's: a ball slides, then rolls (Coulomb
friction with the cloth), a cushion turns speed into spin and back (Han, "Dynamics in carom and three cushion
billiards", 2005), balls meet without friction. The constants are its own of a pool table; a ball's mass and the
cushions' height are scaled with our ball's radius.
"""

# pyright: reportMissingImports=false
# The package need not be there.

from __future__ import annotations

import math
from functools import lru_cache
from typing import Any

import numpy as np
from pooltool import Ball, BallParams, Cue, System, Table, TableType, simulate
from pooltool.objects import CircularCushionSegment, CushionSegments, LinearCushionSegment, Pocket
from pooltool.objects.ball.datatypes import BallState
from pooltool.objects.table.components import CushionDirection
from pooltool.physics.engine import PhysicsEngine
from pooltool.physics.resolve.ball_ball import BallBallModel
from pooltool.physics.resolve.ball_cushion import BallCCushionModel, BallLCushionModel
from pooltool.physics.resolve.ball_pocket import BallPocketModel
from pooltool.physics.resolve.resolver import Resolver, ResolverConfig
from pooltool.physics.resolve.stick_ball import StickBallModel
from pooltool.physics.resolve.transition import BallTransitionModel

from cuelearner_envs.billiards.foreign import Played
from cuelearner_envs.pooltool import Outline

CUSHION_HEIGHT = 0.64  # of a ball's diameter: pooltool's own
RESTING, SLIDING, POCKETED = 0, 2, 4  # pooltool's names for how a ball moves
MOST_EVENTS = 1_000  # of a shot; the longest of some thousand had 60
CLEAR = 1e-6  # to which balls are moved apart that touch: overlapping ones pass through one another [m]
ASIDE = 1e-9  # by which a strike is turned that pooltool cannot compute: one exactly along a cushion, say [rad]
SIDE_POCKET = 0.1  # radius of the circle that stands for the straight edge between two cushions [m]


@lru_cache(maxsize=1)
def engine() -> PhysicsEngine:
    """Return pooltool's physics engine with models by name, independent of the user's pooltool configuration."""
    return PhysicsEngine(
        Resolver.from_config(
            ResolverConfig(
                ball_ball=BallBallModel.FRICTIONLESS_ELASTIC,
                ball_ball_params={},
                ball_linear_cushion=BallLCushionModel.HAN_2005,
                ball_linear_cushion_params={},
                ball_circular_cushion=BallCCushionModel.HAN_2005,
                ball_circular_cushion_params={},
                ball_pocket=BallPocketModel.CANONICAL,
                ball_pocket_params={},
                stick_ball=StickBallModel.INSTANTANEOUS_POINT,
                stick_ball_params={"throttle_english": True},
                transition=BallTransitionModel.CANONICAL,
                transition_params={},
            )
        )
    )


@lru_cache(maxsize=8)
def ball_params(radius: float) -> BallParams:
    """pooltool's pool ball, made smaller."""
    own = BallParams()
    return BallParams(R=radius, m=own.m * (radius / own.R) ** 3)


@lru_cache(maxsize=8)
def table(outline: Outline) -> Table:
    """The table, empty."""
    x, y, gap = outline.width / 2, outline.height / 2, outline.corner_gap
    nose = CUSHION_HEIGHT * 2 * outline.ball_radius
    inner = outline.hole_width if outline.side_pockets else 0.0
    if outline.side_pockets:
        along = [((sx * inner, sy * y), (sx * (x - gap), sy * y), (0.0, -sy)) for sx in (1, -1) for sy in (1, -1)]
    else:
        along = [((-(x - gap), sy * y), (x - gap, sy * y), (0.0, -sy)) for sy in (1, -1)]
    across = [((sx * x, -(y - gap)), (sx * x, y - gap), (-sx, 0.0)) for sx in (1, -1)]
    linear, circular = {}, {}
    for number, (start, end, inward) in enumerate(along + across):
        name, off = str(number), outline.cushion_radius * np.array(inward)
        # Which of its sides is played on: the one on which its equation is of this sign at the table's centre.
        side = CushionDirection.SIDE2 if sum(inward) > 0 else CushionDirection.SIDE1
        linear[name] = LinearCushionSegment(name, np.append(start + off, nose), np.append(end + off, nose), side)
        for tip, place in (("a", start), ("b", end)):
            jaw = name + tip
            circular[jaw] = CircularCushionSegment(jaw, np.array([*place, nose]), outline.cushion_radius)
    holes = [(sx * x, sy * y, _corner_reach(outline)) for sx in (1, -1) for sy in (1, -1)]
    if outline.side_pockets:
        holes += [(0.0, sy * (y + outline.pocket_margin + SIDE_POCKET), SIDE_POCKET) for sy in (1, -1)]
    pockets = {str(number): Pocket(str(number), np.array([px, py, 0.0]), r) for number, (px, py, r) in enumerate(holes)}
    return Table(CushionSegments(linear, circular), pockets, TableType.POCKET)


def _corner_reach(outline: Outline) -> float:
    """Return the largest distance from a corner at which a ball's centre can leave the table there [m]."""
    along = outline.corner_gap - outline.ball_radius - outline.cushion_radius
    return math.hypot(along, outline.pocket_margin)


def separate(outline: Outline, positions: np.ndarray, pocketed: np.ndarray) -> np.ndarray:
    """Places (balls, 2) at which no ball touches another or a cushion: those that do are moved by `CLEAR`, no more.

    Positions are kept in single precision; pooltool lets balls that overlap by a rounding error pass.
    """
    places = np.array(positions, np.float64)
    reach = outline.ball_radius + outline.cushion_radius
    edge = np.array([outline.width, outline.height]) / 2 - reach
    touching = np.abs(np.abs(places) - edge) < CLEAR
    places = np.where(touching, np.sign(places) * (edge - CLEAR), places)
    on_table = np.flatnonzero(~pocketed)
    for i in on_table:
        for j in on_table[on_table > i]:
            way = places[j] - places[i]
            length = math.hypot(*way)
            if 0.0 < length < 2 * outline.ball_radius + CLEAR / 2:
                short = 2 * outline.ball_radius + CLEAR - length
                places[i] -= way / length * short / 2
                places[j] += way / length * short / 2
    return places


def struck(outline: Outline, positions: np.ndarray, pocketed: np.ndarray, angle: float) -> System:
    """The table as the cue ball leaves.

    Args:
        outline: see there.
        positions: (balls, 2), origin at the table's centre, ball 0 is the cue ball [m].
        pocketed: (balls,) bool.
        angle: of the strike, counterclockwise from x [rad].
    """
    params, balls = ball_params(outline.ball_radius), {}
    for number, (place, out) in enumerate(zip(separate(outline, positions, pocketed), pocketed, strict=True)):
        motion = np.zeros((3, 3))  # place, velocity, spin
        motion[0] = *place, outline.ball_radius
        state = POCKETED if out else RESTING
        if number == 0:
            motion[1, :2] = outline.strike_speed * np.array([math.cos(angle), math.sin(angle)])
            state = SLIDING
        balls[str(number)] = Ball(str(number), state=BallState(motion, state, 0.0), params=params)
    return System(cue=Cue(V0=0.0, cue_ball_id="0"), table=table(outline).copy(), balls=balls)


def play(outline: Outline, positions: np.ndarray, pocketed: np.ndarray, angles: np.ndarray) -> Played:
    """Shots, one after the other, from strike to rest.

    Args:
        outline: of all of them.
        positions: (shots, balls, 2) [m].
        pocketed: (shots, balls) bool.
        angles: (shots,) [rad].
    """
    rows: list[tuple[Any, ...]] = []
    for place, out, angle in zip(positions, pocketed, angles, strict=True):
        shot = _simulated(outline, place, out, float(angle))
        balls = list(shot.balls.values())
        rows.append(
            (
                [ball.state.rvw[0, :2] for ball in balls],
                [ball.state.s == POCKETED for ball in balls],
                shot.t,
                len(shot.events),
                len(shot.events) > MOST_EVENTS,
            )
        )
    kinds = (np.float32, bool, np.float32, np.int32, bool)
    return Played(*(np.array(column, kind) for column, kind in zip(zip(*rows, strict=True), kinds, strict=True)))


def _simulated(outline: Outline, positions: np.ndarray, pocketed: np.ndarray, angle: float) -> System:
    """A shot. A ball that moves exactly along a cushion divides by zero there: it is then struck a little aside."""
    try:
        return simulate(struck(outline, positions, pocketed, angle), engine(), inplace=True, max_events=MOST_EVENTS)
    except ZeroDivisionError:
        aside = struck(outline, positions, pocketed, angle + ASIDE)
        return simulate(aside, engine(), inplace=True, max_events=MOST_EVENTS)
