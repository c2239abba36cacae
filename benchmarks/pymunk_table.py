"""The billiards table in Chipmunk (through pymunk), as a real engine to compare `cuelearner_envs.billiards` with.

Bodies have mass 1 and the moment of a solid disc; friction is multiplied at a contact, so each body and cushion gets
the root of the table's coefficient, and likewise the restitution. Chipmunk damps linear and angular velocity
alike. Reading places and speeds body by body was the fastest way found: pymunk's batch interface took a third longer.
"""

import math

import numpy as np
import pymunk

from cuelearner_envs.billiards import Table
from cuelearner_envs.billiards.table import cushions

FINE_STEP = 2e-4  # for parity [s]
USUAL_STEP = 0.02  # what learning on this engine uses, for speed [s]


class PymunkTable:
    """Plays shots one after another in one space at a fixed time step [s]; threads = 0: pymunk without threading."""

    def __init__(self, table: Table, step: float, threads: int = 0) -> None:
        self.step, self.table = step, table
        self.stop_speed, self.strike_speed = float(table.stop_speed), float(table.strike_speed)
        self.out_x = float(table.width / 2 + table.pocket_margin)
        self.out_y = float(table.height / 2 + table.pocket_margin)
        self.space = pymunk.Space(threaded=threads > 0)
        if threads:
            self.space.threads = threads
        self.space.damping = float(table.speed_kept)
        gx, gy = np.asarray(table.acceleration)
        self.space.gravity = (float(gx), float(gy))
        for start, end in np.asarray(cushions(table), float):
            self.space.add(
                self._solid(
                    pymunk.Segment(self.space.static_body, tuple(start), tuple(end), float(table.cushion_radius))
                )
            )
        self.balls = []
        for _ in range(table.balls):
            body = pymunk.Body(1.0, pymunk.moment_for_circle(1.0, 0.0, float(table.ball_radius)))
            self.balls.append((body, self._solid(pymunk.Circle(body, float(table.ball_radius)))))

    def _solid(self, shape: pymunk.Shape) -> pymunk.Shape:
        shape.friction, shape.elasticity = math.sqrt(self.table.friction), math.sqrt(self.table.restitution)
        return shape

    def _place(self, positions: np.ndarray, angle: float) -> None:
        for (body, shape), place in zip(self.balls[: len(positions)], positions, strict=True):
            body.position, body.velocity, body.angle, body.angular_velocity = tuple(map(float, place)), (0, 0), 0, 0
            self.space.add(body, shape)
        self.balls[0][0].velocity = (self.strike_speed * math.cos(angle), self.strike_speed * math.sin(angle))

    def play(self, positions: np.ndarray, angle: float, limit_s: float = 60.0) -> tuple[np.ndarray, np.ndarray, float]:
        """Strike ball 0 at `angle` [rad]. Final positions (balls, 2) [m], pocketed (balls,) and duration [s].

        Every ball of `positions`, the first of the table's, starts on the table; the place of a pocketed ball is where
        it fell.
        """
        self._place(positions, angle)
        out_x, out_y, stop2 = self.out_x, self.out_y, self.stop_speed**2
        balls = self.balls[: len(positions)]
        playing, steps = list(balls), 0
        while playing and steps * self.step < limit_s:
            self.space.step(self.step)
            steps += 1
            moving = False
            for ball in tuple(playing):
                x, y = ball[0].position
                if x > out_x or x < -out_x or y > out_y or y < -out_y:
                    self.space.remove(*ball)
                    playing.remove(ball)
                elif not moving:
                    vx, vy = ball[0].velocity
                    moving = vx * vx + vy * vy >= stop2
            if not moving:
                break
        for ball in playing:
            self.space.remove(*ball)
        pocketed = np.array([ball not in playing for ball in balls])
        return np.array([body.position for body, _ in balls]), pocketed, steps * self.step


def scenes(table: Table, count: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Random places of all balls inside the cushions, none overlapping (count, balls, 2) [m], and directions [rad]."""
    rng = np.random.default_rng(seed)
    reach = float(table.ball_radius + table.cushion_radius)
    half = np.array([table.width / 2 - reach, table.height / 2 - reach], float)
    places = []
    while len(places) < count:
        place = rng.uniform(-half, half, (table.balls, 2))
        apart = np.linalg.norm(place[:, None] - place[None], axis=-1)[np.triu_indices(table.balls, 1)]
        if apart.min() > 2 * table.ball_radius:
            places.append(place)
    return np.array(places), rng.uniform(-math.pi, math.pi, count)
