"""The reading as a kind of guidance: answers are intervals for the right action, and say what changed in the world.

No network is fitted and no action refined: `cuelearner_jax.reading` reads the answers, outside compiled programs.
"""

from __future__ import annotations

from cuelearner_jax.feedback.answers import RELATIVE
from cuelearner_jax.guides.base import Kind
from cuelearner_jax.guides.baselines import Untaught

KIND = Kind(
    "reading",
    "relative feedback for adaptation: what changed in the world, with an interval",
    Untaught,
    form=RELATIVE,
    colour="#B15928",
    by_evidence=True,
)
