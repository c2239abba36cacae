"""Policies: pytrees that act, for evaluation, pictures, labelling and adaptation.

A policy's `act` sees many environments at once. Its `axes` say which of its leaves a block of lanes has one of each
(`evaluate.rollout_lanes` maps over them); what lanes share is there once.
"""

# ruff: noqa: F401 (what other modules import from here)
from cuelearner_jax.policies.policy import (
    BY_LANE,
    SHARED,
    Agent,
    Common,
    Corrected,
    Guided,
    Heuristic,
    NearAims,
    PolicyNode,
    Taught,
    Uniform,
    asked_from,
    best_actions,
    call_policy,
    describe,
    innermost,
    lanes_in,
    layers,
    policy_name,
    uniform_in,
)
from cuelearner_jax.policies.user import FILES, ONNX, Opaque, Teaching, policy_of, teaching
from cuelearner_jax.types import Policy
