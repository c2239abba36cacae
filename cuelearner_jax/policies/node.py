"""What a policy is: a pytree that acts, says what it is, and gives the policy of one lane."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from typing import Any, Protocol, runtime_checkable

import jax
import jax.numpy as jnp
from flax import struct
from jax.typing import ArrayLike

from cuelearner_jax import types

SHARED, BY_LANE = None, 0  # of a leaf: the same for all lanes, or one for each


@runtime_checkable
class PolicyBlock(types.Policy, Protocol):
    """A policy of which a block of lanes may have one each, or such a block; `PolicyNode` has all but `act`."""

    @property
    def axes(self) -> Any:
        """The policy with `BY_LANE` or `SHARED` in place of fields: what a block of lanes has one of each."""
        ...

    def describe(self) -> dict[str, Any]:
        """What the policy is, as JSON values: its kind under `policy`, and under `base` the policy that it changes."""
        ...

    def lane(self, index: int | ArrayLike) -> Any:
        """One lane's policy of a block; by several indices (lanes,), a block of these lanes."""
        ...


class PolicyNode(struct.PyTreeNode):
    """Inherit for a policy of one's own: its lanes by its `axes`, and a description as code."""

    @property
    def axes(self) -> Any:
        """The policy with `BY_LANE` or `SHARED` in place of fields. Here: all lanes share the policy."""
        return self.replace(**{field.name: SHARED for field in _traced(self)})

    def describe(self) -> dict[str, Any]:
        """Code, named as Python names it."""
        return {"policy": "code", "named": type(self).__qualname__}

    def lane(self, index: int | ArrayLike) -> Any:
        """One lane's policy of a block; by several indices (lanes,), a block of these lanes."""
        axes = self.axes
        parts = ((field.name, getattr(self, field.name), getattr(axes, field.name)) for field in _traced(self))
        return self.replace(**{name: _lane(part, axis, index) for name, part, axis in parts})


def _traced(policy: Any) -> list[dataclasses.Field[Any]]:
    return [field for field in dataclasses.fields(policy) if field.metadata.get("pytree_node", True)]


def _lane(part: Any, axes: Any, index: int | ArrayLike) -> Any:
    """The part of some lanes; `axes` as `PolicyNode.axes` has them for it."""
    if hasattr(part, "lane"):
        return part.lane(index)
    taken = lambda leaf: jnp.asarray(leaf)[index]  # noqa: E731
    chosen = lambda axis, own: own if axis is SHARED else jax.tree.map(taken, own)  # noqa: E731
    return jax.tree.map(chosen, axes, part, is_leaf=lambda axis: axis is SHARED)


def lanes_in(policy: PolicyBlock) -> int | None:
    """Lanes of a block; None where no leaf has a lane axis: one policy for all lanes."""
    count = lambda axis, own: [] if axis is SHARED else [len(leaf) for leaf in jax.tree.leaves(own)]  # noqa: E731
    found = jax.tree.leaves(jax.tree.map(count, policy.axes, policy, is_leaf=lambda axis: axis is SHARED))
    return found[0] if found else None


def describe(policy: Any) -> dict[str, Any]:
    """What a policy is, as `PolicyBlock.describe` says it; one that does not say so is code."""
    return policy.describe() if hasattr(policy, "describe") else PolicyNode.describe(policy)


def layers(described: dict[str, Any]) -> Iterator[dict[str, Any]]:
    """A described policy, the policy whose actions it changes, and so on."""
    layer: dict[str, Any] | None = described
    while layer is not None:
        yield layer
        layer = layer.get("base")
