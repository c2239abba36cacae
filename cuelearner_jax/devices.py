"""Lanes over devices: each works on its share of a block of lanes, none waits for another."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import jax
from jax.sharding import AxisType, Mesh, NamedSharding, PartitionSpec

LANES = "lanes"
SHARED = PartitionSpec()  # the same on every device
BY_LANE = PartitionSpec(LANES)  # leading axis cut into equal shares


def lane_mesh(devices: Sequence[Any] | None = None) -> Mesh:
    """The devices that lanes are shared out to: all of this process's, or those given."""
    devices = jax.local_devices() if devices is None else list(devices)
    return jax.make_mesh((len(devices),), (LANES,), axis_types=(AxisType.Auto,), devices=devices)


def over_lanes(mesh: Mesh, function: Callable[..., Any], takes: tuple[Any, ...], gives: Any) -> Callable[..., Any]:
    """`function` of each device's lanes, in one program. No device learns of another's: nothing is communicated.

    Args:
        mesh: from `lane_mesh`.
        function: of a block of lanes (leading axis) and of what they share.
        takes: `SHARED` or `BY_LANE` for each argument.
        gives: the same for what it returns.
    """
    return jax.shard_map(function, mesh=mesh, in_specs=takes, out_specs=gives, check_vma=False)


def place(mesh: Mesh, tree: Any, where: PartitionSpec) -> Any:
    """A tree of arrays as `over_lanes` gives them back. JAX compiles once more for arrays that lie otherwise."""
    return jax.device_put(tree, NamedSharding(mesh, where))
