"""Calibration: estimate from relative answers what changed in the world."""

from cuelearner_jax.calibration.asking import calibrate, read_answers
from cuelearner_jax.calibration.estimation import Calibration
from cuelearner_jax.calibration.families import Distortion, Unknown, declared_distortions
from cuelearner_jax.calibration.policy import Calibrated
from cuelearner_jax.calibration.result import CHANGED, UNCHANGED, UNEXPLAINED, Estimate, Result
from cuelearner_jax.calibration.simulator import simulator_distortion
from cuelearner_jax.calibration.walk import Walk

__all__ = [
    "CHANGED",
    "UNCHANGED",
    "UNEXPLAINED",
    "Calibrated",
    "Calibration",
    "Distortion",
    "Estimate",
    "Result",
    "Unknown",
    "Walk",
    "calibrate",
    "declared_distortions",
    "read_answers",
    "simulator_distortion",
]
