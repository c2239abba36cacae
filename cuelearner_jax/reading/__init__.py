"""Read relative answers as intervals: what changed between a policy and its world, and the corrected policy."""

# ruff: noqa: F401 (what other modules import from here)
from cuelearner_jax.reading.families import Distortion, Unknown, declared_distortions
from cuelearner_jax.reading.policy import ReadingPolicy
from cuelearner_jax.reading.result import Estimate, Result
from cuelearner_jax.reading.session import Reading
from cuelearner_jax.reading.walk import Walk
