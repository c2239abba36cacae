"""Calibration as a kind of guidance: estimate from relative answers what changed in the world.

No network is fitted and no action refined: `cuelearner_jax.calibration` reads the answers, outside compiled programs.
With theta what changed, a*(theta) the action that the policy means behind that change, in any space with cues:

    P(theta | labels) ~ P(theta) prod over labels, and cues they speak of, of P(h_c | log(a, a*(s, theta))_c / eps)
    a = a*(s, mean of theta), where the evidence says that anything changed
"""

from __future__ import annotations

from cuelearner_jax.config.parts import part
from cuelearner_jax.feedback.answers import RELATIVE
from cuelearner_jax.guides.base import Kind
from cuelearner_jax.guides.baselines import Untaught


@part
class Config:
    """Options for the changes that are derived from the world's declarations; see `calibration.families`."""

    gains: bool = False
    """Also ask whether lengths that are seen, and the actions of a box, were scaled."""
    teacher_bias: bool = False
    """A constant difference between answers and policy is the teacher's own: it is reported and not corrected."""


KIND = Kind(
    "calibration",
    "relative feedback for adaptation: what changed in the world, with an interval",
    Untaught,
    form=RELATIVE,
    colour="#B15928",
    config=Config,
    by_evidence=True,
)
