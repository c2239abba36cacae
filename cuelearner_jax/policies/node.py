"""The base class of policies: a pytree that acts, describes itself, and gives the policy of one lane."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from typing import Any

import jax
import jax.numpy as jnp
from flax import struct
from jax.typing import ArrayLike
from jaxtyping import Array, Float, PRNGKeyArray

from cuelearner_jax.types import EnvState

SHARED, BY_LANE = None, 0  # axis of a leaf: shared by all lanes, or one entry for each lane


class PolicyNode(struct.PyTreeNode):
    """A policy, or a block of policies with one entry a lane (`axes`). Inherit this for one of your own."""

    KIND = ""  # name of the kind of policy in files; empty: code
    ASKS = False  # True if the policy asks a teacher

    def act(self, key: PRNGKeyArray, states: EnvState, obs: Float[Array, "n obs"]) -> Float[Array, "n action"]:
        """Act as `types.Policy.act`."""
        raise NotImplementedError

    @property
    def axes(self) -> Any:
        """The policy with `BY_LANE` or `SHARED` in place of fields; here all lanes share the policy."""
        return self.replace(**{field.name: SHARED for field in _traced(self)})

    def describe(self) -> dict[str, Any]:
        """Return JSON values: the policy's kind under `policy`, and under `base` the policy that it changes."""
        told: dict[str, Any] = {"policy": self.KIND} if self.KIND else described_code(self)
        if self.ASKS:
            told["asks"] = True
        return {**told, "base": describe(self.base)} if self.KIND and hasattr(self, "base") else told  # pyright: ignore[reportAttributeAccessIssue]

    def lane(self, index: int | ArrayLike) -> Any:
        """Return one lane's policy of a block; with several indices (lanes,), a block of these lanes."""
        axes = self.axes
        parts = ((field.name, getattr(self, field.name), getattr(axes, field.name)) for field in _traced(self))
        return self.replace(**{name: _lane(part, axis, index) for name, part, axis in parts})


def _traced(policy: Any) -> list[dataclasses.Field[Any]]:
    return [field for field in dataclasses.fields(policy) if field.metadata.get("pytree_node", True)]


def _lane(part: Any, axes: Any, index: int | ArrayLike) -> Any:
    """Return the entries of some lanes; `axes` as `PolicyNode.axes`."""
    if hasattr(part, "lane"):
        return part.lane(index)
    taken = lambda leaf: jnp.asarray(leaf)[index]  # noqa: E731
    chosen = lambda axis, own: own if axis is SHARED else jax.tree.map(taken, own)  # noqa: E731
    return jax.tree.map(chosen, axes, part, is_leaf=lambda axis: axis is SHARED)


def lanes_in(policy: PolicyNode) -> int | None:
    """Return the number of lanes of a block; None where no leaf has a lane axis."""
    count = lambda axis, own: [] if axis is SHARED else [len(leaf) for leaf in jax.tree.leaves(own)]  # noqa: E731
    found = jax.tree.leaves(jax.tree.map(count, policy.axes, policy, is_leaf=lambda axis: axis is SHARED))
    return found[0] if found else None


def described_code(policy: Any) -> dict[str, Any]:
    """Return the description of a policy that is code."""
    return {"policy": "code", "named": type(policy).__qualname__}


def describe(policy: Any) -> dict[str, Any]:
    """Return a policy's description (`PolicyNode.describe`); a policy without one is described as code."""
    return policy.describe() if hasattr(policy, "describe") else described_code(policy)


def layers(described: dict[str, Any]) -> Iterator[dict[str, Any]]:
    """Yield a described policy, the policy whose actions it changes, and so on."""
    layer: dict[str, Any] | None = described
    while layer is not None:
        yield layer
        layer = layer.get("base")
