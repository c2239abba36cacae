"""Billiards on a two-dimensional table: exact event-driven physics, one shot at a time."""

from cuelearner_envs.billiards.physics import Shot, Trajectory, positions_at, simulate, simulate_many, trace
from cuelearner_envs.billiards.table import Table

__all__ = ["Shot", "Table", "Trajectory", "positions_at", "simulate", "simulate_many", "trace"]
