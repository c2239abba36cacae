"""Share lanes out over devices that work independently, and choose what a device computes at once, and how."""

from __future__ import annotations

import gc
import os
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from contextvars import ContextVar
from functools import partial
from itertools import compress
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax.core import Tracer
from jax.sharding import AxisType, Mesh, NamedSharding, PartitionSpec, SingleDeviceSharding

CORES = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1  # of this process
LANES = "lanes"
LIBRARY_LANES = 16  # lanes of a device, from which on NVIDIA's library is the faster one for matrix products
SHARED = PartitionSpec()  # the same on every device
BY_LANE = PartitionSpec(LANES)  # leading axis divided into equal shares
# JAX's settings that change what a seed draws, or the type of every number. Other values would give other episodes and
# other networks for the same seed. `debug_nans` fails on NaN that stands for "no value yet".
NUMERICS = {
    "default_prng_impl": "threefry2x32",
    "threefry_partitionable": True,
    "enable_x64": False,
    "debug_nans": False,
}

_written_out = ContextVar("written out", default=False)


@contextmanager
def fixed_numerics() -> Iterator[None]:
    """Compute with `NUMERICS` in this thread, whatever the program or the environment has set."""
    with ExitStack() as settings:
        for name, value in NUMERICS.items():
            settings.enter_context(getattr(jax, name)(value))
        yield


def fix_numerics() -> None:
    """Compute with `NUMERICS` in all threads, for a program that does nothing else."""
    for name, value in NUMERICS.items():
        jax.config.update(f"jax_{name}", value)


def numerics() -> str:
    """Return the settings of random numbers and precision now in force, for the record of a result."""
    prng, partitionable, double, _ = (getattr(jax.config, f"jax_{name}") for name in NUMERICS)
    return f"{prng}{'' if partitionable else ' not partitionable'}, {'float64' if double else 'float32'}"


class Portions(NamedTuple):
    """Sizes of one computation: what a core's cache holds, or what keeps an accelerator busy within its memory."""

    actions: int  # state-action pairs of one agent in one forward pass of an argmax
    agents: int  # agents evaluated side by side
    states: int  # situations in one call of a teacher
    passes: int  # of refinement between two looks whether all actions are done


@contextmanager
def written_out() -> Iterator[None]:
    """Trace without loops over data: for exporters, whose formats have none."""
    token = _written_out.set(True)
    try:
        yield
    finally:
        _written_out.reset(token)


def goes_through() -> bool:
    """Return whether a minimum over few data for many places is best taken datum by datum.

    On a CPU: all places are then worked on side by side in vector registers, which XLA's reductions leave unused.
    """
    return jax.default_backend() == "cpu" and not _written_out.get()


def release_programs(process: Path = Path("/proc/self"), system: Path = Path("/proc/sys")) -> bool:
    """Forget all compiled programs if they take half of what the process may map; return whether they were forgotten.

    Each compiled program takes tens to thousands of memory maps, and Linux allows a process 65,530 of them
    (`vm.max_map_count`). JAX frees none by itself, and ends in a segmentation fault when none is left, mostly while
    JAX writes its compilation cache (jax-ml/jax issue 27201). What is needed again is compiled again. Nothing is done
    without the folders `process` and `system` of Linux, which have the number of maps and its limit.
    """
    try:
        most = int((system / "vm/max_map_count").read_text())
        with (process / "maps").open("rb") as lines:
            mapped = sum(1 for _ in lines)
    except (OSError, ValueError):
        return False
    if mapped <= most / 2:
        return False
    jax.clear_caches()
    gc.collect()
    return True


def portions() -> Portions:
    """Return the portions for the default device."""
    return Portions(8192, 1, 16, 1) if jax.default_backend() == "cpu" else Portions(1 << 14, 16, 256, 10)


def compiler_options(lanes: int) -> dict[str, Any]:
    """Return XLA's options for the training loop of so many lanes on each device.

    A GPU runs the independent kernels of a captured step side by side, and takes the matrix products of many lanes from
    NVIDIA's library, those of few from XLA's compiler (docs/scaling.md).
    """
    if jax.default_backend() != "gpu":
        return {}
    return {"xla_gpu_command_buffer_scheduling_mode": "CONCURRENT", "xla_gpu_enable_triton_gemm": lanes < LIBRARY_LANES}


def lane_mesh(devices: Sequence[Any] | None = None) -> Mesh:
    """Return the mesh of devices that share the lanes: all of this process's, or the given ones."""
    devices = jax.local_devices() if devices is None else devices
    return jax.make_mesh((len(devices),), (LANES,), axis_types=(AxisType.Auto,), devices=devices)


def over_lanes(mesh: Mesh, function: Callable[..., Any], takes: tuple[Any, ...], gives: Any) -> Callable[..., Any]:
    """Return `function` mapped over each device's lanes, in one program without communication between devices.

    `function` takes a block of lanes (leading axis) and the arrays that they share. `takes` and `gives` are `SHARED` or
    `BY_LANE` for each argument and result.
    """

    def whole(*arguments: Any) -> Any:
        leaves, structure = jax.tree.flatten(arguments)
        specs = [spec for tree, spec in zip(arguments, takes, strict=True) for _ in jax.tree.leaves(tree)]
        # Empty arrays (the labels of lanes without any) stay outside: XLA of JAX 0.11 crashes on one that enters.
        full = [leaf.size > 0 for leaf in leaves]

        def share(*entered: jax.Array) -> Any:
            rest = iter(entered)
            own = [next(rest) if there else empty(*one) for there, *one in zip(full, leaves, specs, strict=True)]
            return function(*jax.tree.unflatten(structure, own))

        def empty(leaf: jax.Array, spec: PartitionSpec) -> jax.Array:
            return jnp.zeros((len(leaf) // (mesh.size if spec == BY_LANE else 1), *leaf.shape[1:]), leaf.dtype)

        entering = tuple(compress(specs, full))
        mapped = jax.shard_map(share, mesh=mesh, in_specs=entering, out_specs=gives, check_vma=False)
        return mapped(*compress(leaves, full))

    return whole


def each_lane(function: Callable[..., Any]) -> Callable[..., Any]:
    """Return `function` for every lane of a block: by `jax.vmap` on an accelerator, one by one on a CPU.

    A batched matrix product sums in another order than a single one. On a CPU, therefore, lanes are computed one by
    one: no bit of a lane's result depends on the number of lanes, and a core is not slower. `function` takes one lane's
    trees of arrays; every leaf of a block has a leading axis of lanes.
    """

    def mapped(*blocks: Any) -> Any:
        if _lanes(blocks) == 1:
            return _block(function(*_lane(blocks, 0)))
        if jax.default_backend() != "cpu":
            return jax.vmap(function)(*blocks)
        return jax.lax.map(lambda lane: function(*lane), blocks)

    return mapped


def each_lane_in_place(function: Callable[[Any], tuple[Any, Any, Any]]) -> Callable[[Any], tuple[Any, Any, Any]]:
    """Like `each_lane`, updating the block in place.

    `function`: lane -> (updated lane, results common to all lanes, results of each lane).
    """

    def mapped(block: Any) -> tuple[Any, Any, Any]:
        if _lanes(block) == 1:
            lane, common, own = function(_lane(block, 0))
            return _block(lane), common, _block(own)
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
    return len(jax.tree.leaves(blocks)[0])


def _block(lane: Any) -> Any:
    return jax.tree.map(lambda leaf: leaf[None], lane)


def _lane(blocks: Any, index: Any) -> Any:
    return jax.tree.map(lambda leaf: jax.lax.dynamic_index_in_dim(leaf, index, keepdims=False), blocks)


def commit_arrays(tree: Any) -> Any:
    """Return a tree in which every array of a single device is committed to that device.

    For `jax.jit` an array is part of a mesh, committed to a device, or uncommitted. It compiles once for each of these
    three kinds, also where the device is the same. Arrays of several devices stay as they are.
    """

    def put(leaf: Any) -> Any:
        if not isinstance(leaf, jax.Array) or isinstance(leaf, Tracer) or len(leaf.devices()) > 1:
            return leaf
        return jax.device_put(leaf, SingleDeviceSharding(next(iter(leaf.devices()))))

    return jax.tree.map(put, tree)


def place(mesh: Mesh, tree: Any, where: PartitionSpec) -> Any:
    """Return a tree of arrays placed as `over_lanes` returns them, since JAX compiles again for another placement."""
    return jax.device_put(tree, NamedSharding(mesh, where))
