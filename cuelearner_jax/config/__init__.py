"""Configuration of the method: its groups of values, what of them can work, and how they are kept."""

from cuelearner_jax.config.checks import (
    LARGEST,
    LARGEST_FLOAT,
    LARGEST_ROUND,
    check,
    check_agent,
    check_guide,
    check_types,
    check_whole,
)
from cuelearner_jax.config.groups import (
    AgentScalars,
    AgentSizes,
    Frame,
    GuideScalars,
    GuideSizes,
    RunConfig,
    Scalars,
    Schedule,
    Sizes,
    TeacherFaults,
)
from cuelearner_jax.config.plain import defaults, digest, from_json, to_json

__all__ = [
    "LARGEST",
    "LARGEST_FLOAT",
    "LARGEST_ROUND",
    "AgentScalars",
    "AgentSizes",
    "Frame",
    "GuideScalars",
    "GuideSizes",
    "RunConfig",
    "Scalars",
    "Schedule",
    "Sizes",
    "TeacherFaults",
    "check",
    "check_agent",
    "check_guide",
    "check_types",
    "check_whole",
    "defaults",
    "digest",
    "from_json",
    "to_json",
]
