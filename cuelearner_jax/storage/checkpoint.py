"""Save and restore checkpoints; the only module that uses Orbax.

A run's checkpoint holds four items: `policy` (what acting needs, so that evaluation never reads a replay buffer),
`rest`, `failed` (which lanes have failed) and `clock`. It also holds digests of all arrays, which are verified on
reading, since Orbax reads many changed bits without an error. Orbax writes to a temporary folder and renames that
folder, so that a kill leaves the last complete checkpoint in place.
"""

from __future__ import annotations

import errno
import gc
import hashlib
import json
import logging
import re
import shutil
import sys
import time
import warnings
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import orbax.checkpoint as ocp

from cuelearner_jax.errors import UserError, mentions, no_space
from cuelearner_jax.signals import saving

KEPT = 2  # number of checkpoints of a run that stay on disk
SETTLING_S = 0.2  # wait after a failed read or write, for Orbax's other reads and writes to end [s]
ROOM_LEFT = 1 << 20  # space for a checkpoint's metadata, beyond its arrays [bytes]


def _is_key(leaf: Any) -> bool:
    return jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key)


def _flat(tree: Any) -> dict[str, Any]:
    """Return a tree's leaves by path, as Orbax takes them: keys as raw words, without empty leaves."""
    leaves = jax.tree_util.tree_leaves_with_path(tree)
    return {jax.tree_util.keystr(path): _words(leaf) for path, leaf in leaves if 0 not in leaf.shape}


def _words(leaf: Any) -> Any:
    if not _is_key(leaf):
        return leaf
    if isinstance(leaf, jax.ShapeDtypeStruct):
        return jax.eval_shape(jax.random.key_data, leaf)
    return jax.random.key_data(leaf)


def _unflat(flat: dict[str, Any], like: Any) -> Any:
    """Rebuild a tree of the structure of `like` from `_flat`'s leaves."""

    def leaf(path: Any, kind: Any) -> Any:
        if 0 in kind.shape:
            return jnp.zeros(kind.shape, kind.dtype)
        stored = flat[jax.tree_util.keystr(path)]
        return jax.random.wrap_key_data(stored) if _is_key(kind) else stored

    return jax.tree_util.tree_map_with_path(leaf, like)


def _digest(leaf: Any) -> str:
    """Return the SHA-256 of an array's shape, type and values, however it is sharded along its first axis."""
    found = hashlib.sha256(f"{leaf.shape} {leaf.dtype}".encode())
    pieces = {}
    for shard in leaf.addressable_shards if isinstance(leaf, jax.Array) else ():
        first = shard.index[0].start or 0 if shard.index else 0
        pieces[first] = shard.data
    for _, piece in sorted(pieces.items()) or [(0, leaf)]:
        found.update(np.ascontiguousarray(piece).data)
    return found.hexdigest()


def _digests(flat: dict[str, Any]) -> dict[str, str]:
    """Return the digest of each leaf."""
    with ThreadPoolExecutor() as pool:  # hashing releases the interpreter lock
        return dict(zip(flat, pool.map(_digest, flat.values()), strict=True))


def digest(tree: Any) -> str:
    """Return a short SHA-256 of a tree's arrays; equal trees have equal digests."""
    return hashlib.sha256(json.dumps(_digests(_flat(tree)), sort_keys=True).encode()).hexdigest()[:12]


# Remedies in the message about a checkpoint that cannot be read.
OTHERS = "it is of another configuration, or of another version of the program: use that one, or start a new run"
DAMAGED = "it is damaged; move its folder away to return to the checkpoint before it, or start a new run"
FORBIDDEN = "check the permissions of its files, nothing was changed"
DIGESTS = "digests"


class _OfAnother(ValueError):
    """Raised for a checkpoint whose leaves, or their shapes, differ from those wanted."""


def _compare(folder: Any, wanted: dict[str, dict[str, Any]]) -> None:
    """Raise _OfAnother unless a checkpoint's items have the wanted leaves with the wanted shapes."""
    reader = ocp.StandardCheckpointHandler()
    for name, item in wanted.items():
        stored = reader.metadata(folder / name).tree
        for path in {**stored, **item}:
            there, here = (tuple(tree[path].shape) if path in tree else "none" for tree in (stored, item))
            if there != here:
                raise _OfAnother(f"{path} is {there}, expected {here}")


@contextmanager
def _quiet() -> Iterator[None]:
    """Silence the complaints of Orbax's threads and of the garbage collector after a failed read or write.

    These complaints are pages long, and may come at any later time, from unrelated code.
    """
    log, unraisable, uncaught = logging.getLogger("asyncio"), sys.unraisablehook, sys.excepthook
    silenced = log.disabled
    log.disabled, sys.unraisablehook, sys.excepthook = True, lambda _: None, lambda *_: None
    try:
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", "coroutine .* was never awaited", RuntimeWarning)
            yield
    finally:
        log.disabled, sys.excepthook = silenced, uncaught
        sys.unraisablehook = unraisable if isinstance(unraisable, _LateComplaints) else _LateComplaints(unraisable)


def _settle() -> None:
    """Wait for the other reads or writes after one failed, and collect their garbage."""
    time.sleep(SETTLING_S)
    gc.collect()


class _LateComplaints:
    """An `unraisablehook` that ignores late complaints of reads or writes whose sibling failed.

    On a slow disk they outlast `_settle`, and find that the event loop in which Orbax ran them is closed.
    """

    def __init__(self, before: Callable[[Any], Any]) -> None:
        self._before = before

    def __call__(self, unraisable: Any) -> None:
        if str(unraisable.exc_value) != "Event loop is closed":
            self._before(unraisable)


class Checkpoints:
    """The checkpoints of one program's run in one folder."""

    def __init__(self, folder: Path, read_only: bool = False, damaged: str = DAMAGED) -> None:
        """Open a folder of checkpoints. `damaged` is the remedy in the message about a damaged checkpoint."""
        self._damaged = damaged
        logging.getLogger("absl").setLevel(logging.CRITICAL)  # Orbax's threads log what `save` raises anyway
        self._folder = folder.resolve()
        self._manager = ocp.CheckpointManager(
            self._folder,
            options=ocp.CheckpointManagerOptions(read_only=True)
            if read_only
            else ocp.CheckpointManagerOptions(max_to_keep=KEPT, enable_async_checkpointing=False),
        )

    def latest(self) -> int | None:
        """Return the number of the newest complete checkpoint; None if there is none."""
        return self._manager.latest_step()

    def save(self, number: int, items: dict[str, Any]) -> None:
        """Write a checkpoint; return once it is complete on disk. Raises OSError if the disk is full."""
        needed = sum(leaf.nbytes for leaf in jax.tree.leaves(items) if hasattr(leaf, "nbytes"))
        if shutil.disk_usage(self._folder).free < needed + ROOM_LEFT:
            raise OSError(errno.ENOSPC, f"{needed / 1e6:.0f} MB are needed", str(self._folder))
        flat = {name: _flat(item) for name, item in items.items()}
        args: dict[str, Any] = {name: ocp.args.StandardSave(item) for name, item in flat.items()}
        args[DIGESTS] = ocp.args.JsonSave({name: _digests(item) for name, item in flat.items()})
        with saving(), _quiet():
            try:
                self._manager.save(number, args=ocp.args.Composite(**args))
                self._manager.wait_until_finished()
                return
            except Exception as error:
                if not no_space(error):
                    raise
            _settle()
        raise OSError(errno.ENOSPC, f"{needed / 1e6:.0f} MB are needed", str(self._folder))

    def compare(self, like: dict[str, Any]) -> None:
        """Check that the newest checkpoint's items have the leaves of those in `like`, without reading arrays.

        Raises:
            UserError: there is no checkpoint, it cannot be read, or its shapes differ.
        """
        with self._reading() as folder:
            _compare(folder, {name: _flat(item) for name, item in like.items()})

    def restore(self, like: dict[str, Any]) -> dict[str, Any]:
        """Return the newest checkpoint's items named in `like` (trees of arrays or shapes), on the default device.

        Raises:
            UserError: there is no checkpoint, it cannot be read, or its shapes differ.
        """
        device = jax.sharding.SingleDeviceSharding(jax.devices()[0])
        wanted = {
            name: {
                path: jax.ShapeDtypeStruct(leaf.shape, leaf.dtype, sharding=device)
                for path, leaf in _flat(item).items()
            }
            for name, item in like.items()
        }
        with self._reading() as folder:
            _compare(folder, wanted)
            if not (folder / DIGESTS).exists():
                raise ValueError("the digests of its arrays are missing")
            args: dict[str, Any] = {name: ocp.args.StandardRestore(item) for name, item in wanted.items()}
            args[DIGESTS] = ocp.args.JsonRestore()
            restored = self._manager.restore(int(folder.name), args=ocp.args.Composite(**args))
            self._verify({name: restored[name] for name in like}, restored[DIGESTS])
            return {name: _unflat(restored[name], like[name]) for name in like}

    @contextmanager
    def _reading(self) -> Iterator[Any]:
        """Yield the folder of the newest checkpoint; turn any failure while it is read into a UserError."""
        number = self.latest()
        if number is None:
            raise UserError(f"no checkpoint in {self._folder}: the run was stopped before its first checkpoint")
        with _quiet():
            try:
                yield self._manager.directory / str(number)
                return
            except Exception as error:  # Orbax and TensorStore raise many exception types for damaged files
                # Orbax prints the method in place of TensorStore's details.
                told = re.sub(r"\.? See full TensorStore details.*", "", str(error), flags=re.DOTALL).strip()
                reason = told.splitlines()[0][:160] if told else type(error).__name__
                forbidden = mentions(error, (errno.EACCES, errno.EPERM), "PERMISSION_DENIED", "Permission denied")
                remedy = OTHERS if isinstance(error, _OfAnother) else FORBIDDEN if forbidden else self._damaged
            _settle()
        raise UserError(f"checkpoint {number} in {self._folder} cannot be read ({reason}): {remedy}")

    @staticmethod
    def _verify(restored: dict[str, dict[str, Any]], digests: dict[str, dict[str, str]]) -> None:
        """Raise ValueError unless the restored items have the digests that were saved."""
        for name, item in restored.items():
            told = digests[name]
            changed = [path for path, found in _digests(item).items() if told[path] != found]
            if changed:
                raise ValueError(f"{name}{changed[0]} is not what was written")

    def close(self) -> None:
        """Release Orbax's threads."""
        self._manager.close()


@contextmanager
def checkpoints(folder: Path, read_only: bool = False, damaged: str = DAMAGED) -> Iterator[Checkpoints]:
    """Open `Checkpoints` for the duration of a context. `read_only` changes nothing on disk."""
    manager = Checkpoints(folder, read_only, damaged)
    try:
        yield manager
    finally:
        manager.close()
