"""Configuration: options that all parts share, options of single parts, their checks, and their JSON form."""

# ruff: noqa: F401
from cuelearner_jax.config.groups import (
    Frame,
    GuideScalars,
    GuideSizes,
    Scalars,
    Schedule,
    Sizes,
    TeacherFaults,
    check_guide,
)
from cuelearner_jax.config.parts import (
    LARGEST,
    LARGEST_FLOAT,
    POSITIVE,
    SHARE,
    TRACED,
    Bounds,
    Layers,
    check_multiple,
    check_part,
    check_types,
    normalize_options,
    part,
    static,
)
from cuelearner_jax.config.plain import defaults, digest, from_json, plain, to_json
