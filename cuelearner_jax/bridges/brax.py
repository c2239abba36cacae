"""Environments of brax in our loop (`from_brax`), and what its own agents miss in this JAX. Written for brax 0.14.2."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from cuelearner_jax.bridges.jax_environment import from_simulator

from_brax = from_simulator


def supply_device_put_replicated() -> None:
    """Restore `jax.device_put_replicated`, which JAX 0.10 removed, where it is missing.

    PPO, SAC and APG of brax 0.14.2 call it: call this before one of them trains.
    """
    if not hasattr(jax, "device_put_replicated"):
        setattr(jax, "device_put_replicated", _device_put_replicated)  # noqa: B010 (the type checker knows no such name)


def _device_put_replicated(tree: Any, devices: Sequence[Any]) -> Any:
    """Copy every leaf to every device, stacked along a new first axis, one entry a device, as `pmap` takes it."""
    mesh = jax.sharding.Mesh(np.array(devices), ("device",))
    sharding = jax.sharding.NamedSharding(mesh, jax.sharding.PartitionSpec("device"))

    def replicate(leaf: Any) -> jax.Array:
        row = jnp.asarray(leaf)[None]
        shape = (len(devices), *row.shape[1:])
        return jax.make_array_from_single_device_arrays(shape, sharding, [jax.device_put(row, one) for one in devices])

    return jax.tree.map(replicate, tree)
