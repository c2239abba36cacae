"""Policies: pytrees that act, for evaluation, pictures, labelling and adaptation.

A policy's `act` sees many environments at once. Its `axes` say which of its leaves a block of lanes has one of each
(`evaluate.rollout_lanes` maps over them); what lanes share is there once.
"""

# ruff: noqa: F401 (what other modules import from here)
from cuelearner_jax.policies.layers import (
    Agent,
    Common,
    Corrected,
    Guided,
    Heuristic,
    Middle,
    NearAims,
    Taught,
    Teaching,
    Uniform,
    asked_from,
    best_actions,
    teaching,
    uniform_in,
    wanted_actions,
)
from cuelearner_jax.policies.node import BY_LANE, SHARED, PolicyNode, describe, lanes_in, layers
from cuelearner_jax.policies.opaque import Opaque, call_policy, policy_name, policy_of
from cuelearner_jax.types import Policy
