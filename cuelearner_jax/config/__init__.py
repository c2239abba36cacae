"""Configuration: options that all parts share, options of single parts, their checks, and their JSON form."""

from cuelearner_jax.config.checks import LARGEST_ROUND, check_guide, check_multiple
from cuelearner_jax.config.groups import (
    Frame,
    GuideScalars,
    GuideSizes,
    Scalars,
    Schedule,
    Sizes,
    TeacherFaults,
)
from cuelearner_jax.config.parts import (
    LARGEST,
    LARGEST_FLOAT,
    MOST_LAYERS,
    POSITIVE,
    SHARE,
    TRACED,
    Bounds,
    Layers,
    check_part,
    check_types,
    normalize_options,
    part,
    static,
)
from cuelearner_jax.config.plain import defaults, digest, from_json, plain, to_json

__all__ = [
    "LARGEST",
    "LARGEST_FLOAT",
    "LARGEST_ROUND",
    "MOST_LAYERS",
    "POSITIVE",
    "SHARE",
    "TRACED",
    "Bounds",
    "Frame",
    "GuideScalars",
    "GuideSizes",
    "Layers",
    "Scalars",
    "Schedule",
    "Sizes",
    "TeacherFaults",
    "check_guide",
    "check_multiple",
    "check_part",
    "check_types",
    "defaults",
    "digest",
    "from_json",
    "normalize_options",
    "part",
    "plain",
    "static",
    "to_json",
]
