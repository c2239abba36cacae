"""Lanes over devices, each of which works on its share of a block and waits for none; how much one takes at once."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from itertools import compress
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax.sharding import AxisType, Mesh, NamedSharding, PartitionSpec, SingleDeviceSharding

LANES = "lanes"
LIBRARY_LANES = 16  # of a device, from which on the matrix products of NVIDIA's library are the faster ones
SHARED = PartitionSpec()  # the same on every device
BY_LANE = PartitionSpec(LANES)  # leading axis cut into equal shares


class Portions(NamedTuple):
    """How much is worked on at once: what a core's cache holds, or what keeps an accelerator busy within its memory."""

    actions: int  # state-action pairs of one agent in one forward pass of an argmax
    agents: int  # evaluated side by side
    states: int  # that a teacher looks at together


def portions() -> Portions:
    """Those of the device that computes."""
    return Portions(8192, 1, 16) if jax.default_backend() == "cpu" else Portions(1 << 14, 16, 256)


def compiler_options(lanes: int) -> dict[str, Any]:
    """XLA's options for the training loop of so many lanes on each device.

    A GPU runs the independent kernels of a captured step side by side, and takes the matrix products of many lanes from
    NVIDIA's library, those of few from XLA's compiler (benchmarks/matrix_products.py).
    """
    if jax.default_backend() != "gpu":
        return {}
    return {
        "xla_gpu_command_buffer_scheduling_mode": "CONCURRENT",
        "xla_gpu_enable_triton_gemm": lanes < LIBRARY_LANES,
    }


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

    def whole(*arguments: Any) -> Any:
        leaves, structure = jax.tree.flatten(arguments)
        specs = [spec for tree, spec in zip(arguments, takes, strict=True) for _ in jax.tree.leaves(tree)]
        # Empty arrays (the labels of lanes without any) stay outside: XLA of JAX 0.11 crashes on one that enters.
        full = [leaf.size > 0 for leaf in leaves]
        entering, outside = compress(leaves, full), [not there for there in full]

        def share(*entered: jax.Array) -> Any:
            inside, empty = iter(entered), map(made, compress(leaves, outside), compress(specs, outside))
            return function(*jax.tree.unflatten(structure, [next(inside if there else empty) for there in full]))

        def made(leaf: jax.Array, spec: PartitionSpec) -> jax.Array:
            rows = leaf.shape[0] // (mesh.size if spec == BY_LANE else 1)
            return jnp.zeros((rows, *leaf.shape[1:]), leaf.dtype)

        mapped = jax.shard_map(
            share, mesh=mesh, in_specs=tuple(compress(specs, full)), out_specs=gives, check_vma=False
        )
        return mapped(*entering)

    return whole


def each_lane(function: Callable[..., Any]) -> Callable[..., Any]:
    """`function` of each lane of a block: side by side on an accelerator, by `jax.vmap`; one by one on a CPU.

    Products of many matrices at once are summed in another order than one alone. So on a CPU a lane's result does not
    depend on how many there are, not by a bit; and a core is no slower at it.

    Args:
        function: of one lane's trees of arrays.

    Returns:
        The function of blocks: every leaf with a leading axis of lanes.
    """

    def mapped(*blocks: Any) -> Any:
        if _lanes(blocks) == 1:
            return jax.tree.map(lambda leaf: leaf[None], function(*_lane(blocks, 0)))
        if jax.default_backend() != "cpu":
            return jax.vmap(function)(*blocks)
        return jax.lax.map(lambda lane: function(*lane), blocks)

    return mapped


def each_lane_in_place(function: Callable[[Any], tuple[Any, Any, Any]]) -> Callable[[Any], tuple[Any, Any, Any]]:
    """The same of a function that gives a lane in the place of the one that it takes: no second block is made.

    Args:
        function: of a lane -> (the lane after it, what all lanes have in common, what each has).

    Returns:
        The function of a block -> (the block after it, what all lanes have in common, what each has).
    """

    def mapped(block: Any) -> tuple[Any, Any, Any]:
        if _lanes(block) == 1:
            lane, common, own = function(_lane(block, 0))
            return *jax.tree.map(lambda leaf: leaf[None], (lane,)), common, jax.tree.map(lambda leaf: leaf[None], own)
        if jax.default_backend() != "cpu":
            return jax.vmap(function, out_axes=(0, None, 0))(block)

        def turn(block: Any, index: jax.Array) -> tuple[Any, tuple[Any, Any]]:
            lane, common, own = function(_lane(block, index))
            put = partial(jax.lax.dynamic_update_index_in_dim, index=index, axis=0)
            return jax.tree.map(put, block, lane), (common, own)

        block, (common, own) = jax.lax.scan(turn, block, jnp.arange(_lanes(block)))
        return block, jax.tree.map(lambda leaf: leaf[0], common), own

    return mapped


def _lanes(blocks: Any) -> int:
    return jax.tree.leaves(blocks)[0].shape[0]


def _lane(blocks: Any, index: Any) -> Any:
    return jax.tree.map(lambda leaf: jax.lax.dynamic_index_in_dim(leaf, index, keepdims=False), blocks)


def settled(tree: Any) -> Any:
    """Return a tree whose arrays of one device are all committed to it alike.

    Arrays that lie on the same device as part of a mesh, as its own, or uncommitted, are of three kinds to `jax.jit`,
    which compiles once for each. Arrays of several devices stay as they are.
    """

    def put(leaf: Any) -> Any:
        if not isinstance(leaf, jax.Array) or isinstance(leaf, jax.core.Tracer) or len(leaf.devices()) > 1:
            return leaf
        return jax.device_put(leaf, SingleDeviceSharding(next(iter(leaf.devices()))))

    return jax.tree.map(put, tree)


def place(mesh: Mesh, tree: Any, where: PartitionSpec) -> Any:
    """A tree of arrays as `over_lanes` gives them back. JAX compiles once more for arrays that lie otherwise."""
    return jax.device_put(tree, NamedSharding(mesh, where))
