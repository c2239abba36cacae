"""Save and restore checkpoints; the only module that uses Orbax.

A run's checkpoint holds four items: `policy` (what acting needs, so that evaluation never reads a replay buffer),
`rest`, `failed` (which lanes have failed) and `clock`. Beside them it holds the run's key and digests of all arrays,
since Orbax reads many changed bits without an error. Orbax writes to a temporary folder and renames that folder, so
that a kill leaves the last complete checkpoint in place.
"""

from __future__ import annotations

import errno
import hashlib
import json
import logging
import re
import shutil
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import orbax.checkpoint as ocp

from cuelearner_jax.errors import UserError, mentions
from cuelearner_jax.signals import saving

KEPT = 2  # number of checkpoints of a run that stay on disk
ROOM_LEFT = 1 << 20  # space for a checkpoint's metadata, beyond its arrays [bytes]
DIGESTS = "digests"
# Remedies in the message about a checkpoint that cannot be read.
OTHERS = "it is of another configuration, or of another version of the program: use that one, or start a new run"
DAMAGED = "it is damaged; move its folder away to return to the checkpoint before it, or start a new run"
FORBIDDEN = "check the permissions of its files, nothing was changed"


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
    """Return the SHA-256 of an array's shape, type and values."""
    found = hashlib.sha256(f"{leaf.shape} {leaf.dtype}".encode())
    found.update(np.ascontiguousarray(leaf).data)
    return found.hexdigest()


def _digests(flat: dict[str, Any]) -> dict[str, str]:
    """Return the digest of each leaf."""
    with ThreadPoolExecutor() as pool:  # hashing releases the interpreter lock
        return dict(zip(flat, pool.map(_digest, flat.values()), strict=True))


def digest(tree: Any) -> str:
    """Return a short SHA-256 of a tree's arrays; equal trees have equal digests."""
    return hashlib.sha256(json.dumps(_digests(_flat(tree)), sort_keys=True).encode()).hexdigest()[:12]


class _OfAnother(ValueError):
    """Raised for a checkpoint of another run, or with other leaves or shapes than those wanted."""


def _compare(folder: Any, wanted: dict[str, dict[str, Any]]) -> None:
    """Raise _OfAnother unless a checkpoint's items have the wanted leaves with the wanted shapes."""
    reader = ocp.StandardCheckpointHandler()
    for name, item in wanted.items():
        stored = reader.metadata(folder / name).tree
        for path in {**stored, **item}:
            there, here = (tuple(tree[path].shape) if path in tree else "none" for tree in (stored, item))
            if there != here:
                raise _OfAnother(f"{path} is {there}, expected {here}")


class Checkpoints:
    """The checkpoints of one program's run in one folder."""

    def __init__(self, folder: Path, read_only: bool = False, damaged: str = DAMAGED, run: str = "") -> None:
        """Open a folder of checkpoints.

        Args:
            folder: the folder.
            read_only: change nothing on disk.
            damaged: the remedy in the message about a damaged checkpoint.
            run: the key of the run that the checkpoints belong to (`grid.run_key`); empty: of none.
        """
        self._damaged, self._run, self._folder = damaged, run, folder.resolve()
        for name in ("absl", "asyncio"):  # what Orbax's threads log is raised anyway
            logging.getLogger(name).setLevel(logging.CRITICAL)
        writing = {} if read_only else {"max_to_keep": KEPT, "enable_async_checkpointing": False}
        options = ocp.CheckpointManagerOptions(read_only=read_only, **writing)
        self._manager = ocp.CheckpointManager(self._folder, options=options)

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
        digests = {name: _digests(item) for name, item in flat.items()}
        args[DIGESTS] = ocp.args.JsonSave({"run": self._run, **digests})
        with saving():
            self._manager.save(number, args=ocp.args.Composite(**args))
            self._manager.wait_until_finished()

    def restore(self, like: dict[str, Any]) -> dict[str, Any]:
        """Return the newest checkpoint's items named in `like` (trees of arrays or shapes), on the default device.

        Raises:
            UserError: there is no checkpoint, it cannot be read, it is another run's, or its shapes differ.
        """
        device = jax.sharding.SingleDeviceSharding(jax.devices()[0])
        shape = lambda leaf: jax.ShapeDtypeStruct(leaf.shape, leaf.dtype, sharding=device)  # noqa: E731
        wanted = {name: jax.tree.map(shape, _flat(item)) for name, item in like.items()}
        with self._reading() as folder:
            _compare(folder, wanted)
            args: dict[str, Any] = {name: ocp.args.StandardRestore(item) for name, item in wanted.items()}
            args[DIGESTS] = ocp.args.JsonRestore()
            restored = self._manager.restore(int(folder.name), args=ocp.args.Composite(**args))
            if restored[DIGESTS].get("run", self._run) != self._run:
                raise _OfAnother("it belongs to another run")
            for name in like:
                for path, found in _digests(restored[name]).items():
                    if restored[DIGESTS][name][path] != found:
                        raise ValueError(f"{name}{path} is not what was written")
            return {name: _unflat(restored[name], like[name]) for name in like}

    @contextmanager
    def _reading(self) -> Iterator[Any]:
        """Yield the folder of the newest checkpoint; turn any failure while it is read into a UserError."""
        number = self.latest()
        if number is None:
            raise UserError(f"no checkpoint in {self._folder}: the run was stopped before its first checkpoint")
        try:
            yield self._manager.directory / str(number)
        except Exception as error:  # Orbax and TensorStore raise many exception types for damaged files
            # Orbax prints the method in place of TensorStore's details.
            words = re.sub(r"\.? See full TensorStore details.*", "", str(error), flags=re.DOTALL).strip()
            reason = words.splitlines()[0][:160] if words else type(error).__name__
            forbidden = mentions(error, (errno.EACCES, errno.EPERM), "PERMISSION_DENIED", "Permission denied")
            remedy = OTHERS if isinstance(error, _OfAnother) else FORBIDDEN if forbidden else self._damaged
            raise UserError(f"checkpoint {number} in {self._folder} cannot be read ({reason}): {remedy}") from error

    def close(self) -> None:
        """Release Orbax's threads."""
        self._manager.close()


@contextmanager
def checkpoints(folder: Path, read_only: bool = False, damaged: str = DAMAGED, run: str = "") -> Iterator[Checkpoints]:
    """Open `Checkpoints` for the duration of a context."""
    manager = Checkpoints(folder, read_only, damaged, run)
    try:
        yield manager
    finally:
        manager.close()
