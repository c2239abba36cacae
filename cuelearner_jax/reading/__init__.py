"""Read relative answers as intervals: what changed between a policy and its world, and the corrected policy."""

from cuelearner_jax.reading.families import Distortion, Unknown, declared_distortions
from cuelearner_jax.reading.policy import ReadingPolicy
from cuelearner_jax.reading.result import Estimate, Result
from cuelearner_jax.reading.session import Reading
from cuelearner_jax.reading.walk import Walk

__all__ = [
    "Distortion",
    "Estimate",
    "Reading",
    "ReadingPolicy",
    "Result",
    "Unknown",
    "Walk",
    "declared_distortions",
]
