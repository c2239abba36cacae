"""The policy protocol: a pytree that acts, describes itself, and gives the policy of one lane."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from typing import Any, Protocol, runtime_checkable

import jax
import jax.numpy as jnp
from flax import struct
from jax.typing import ArrayLike

from cuelearner_jax import types

SHARED, BY_LANE = None, 0  # axis of a leaf: shared by all lanes, or one entry for each lane


@runtime_checkable
class PolicyBlock(types.Policy, Protocol):
    """A policy, or a block of policies with one entry a lane. `PolicyNode` implements all but `act`."""

    @property
    def axes(self) -> Any:
        """The policy with `BY_LANE` or `SHARED` in place of fields: which fields have a lane axis."""
        ...

    def describe(self) -> dict[str, Any]:
        """Return JSON values: the policy's kind under `policy`, and under `base` the policy that it changes."""
        ...

    def lane(self, index: int | ArrayLike) -> Any:
        """Return one lane's policy of a block; with several indices (lanes,), a block of these lanes."""
        ...


class PolicyNode(struct.PyTreeNode):
    """Base class for policies of your own: lanes by `axes`, and a description as code."""

    @property
    def axes(self) -> Any:
        """The policy with `BY_LANE` or `SHARED` in place of fields; here all lanes share the policy."""
        return self.replace(**{field.name: SHARED for field in _traced(self)})

    def describe(self) -> dict[str, Any]:
        """Return the description of code, with the class's qualified name."""
        return {"policy": "code", "named": type(self).__qualname__}

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


def lanes_in(policy: PolicyBlock) -> int | None:
    """Return the number of lanes of a block; None where no leaf has a lane axis."""
    count = lambda axis, own: [] if axis is SHARED else [len(leaf) for leaf in jax.tree.leaves(own)]  # noqa: E731
    found = jax.tree.leaves(jax.tree.map(count, policy.axes, policy, is_leaf=lambda axis: axis is SHARED))
    return found[0] if found else None


def describe(policy: Any) -> dict[str, Any]:
    """Return a policy's description (`PolicyBlock.describe`); a policy without one is described as code."""
    return policy.describe() if hasattr(policy, "describe") else PolicyNode.describe(policy)


def layers(described: dict[str, Any]) -> Iterator[dict[str, Any]]:
    """Yield a described policy, the policy whose actions it changes, and so on."""
    layer: dict[str, Any] | None = described
    while layer is not None:
        yield layer
        layer = layer.get("base")
