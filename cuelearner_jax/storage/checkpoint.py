"""Save and restore checkpoints; the only module that uses Orbax.

A run's checkpoint holds four items: `policy` (what acting needs, so that evaluation never reads a replay buffer),
`rest`, `failed` (which lanes have failed) and `clock`. Beside them it holds the run's key and digests of all arrays,
since Orbax reads many changed bits without an error. Orbax writes to a temporary folder and renames that folder, so
that a kill leaves the last complete checkpoint in place.
"""

from __future__ import annotations

import hashlib
import json
import logging
import re
from concurrent.futures import ThreadPoolExecutor
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import orbax.checkpoint as ocp
from jax.tree_util import keystr, tree_leaves_with_path, tree_map_with_path

from cuelearner_jax.errors import UserError, first_line

MOST_CHECKPOINTS = 2  # number of checkpoints of a run that stay on disk
DIGESTS = "digests"
REMEDY = (
    "if it is of another configuration or version of the program, use that one; if it is damaged, move its folder away "
    "to return to the checkpoint before it"
)


def _is_key(leaf: Any) -> bool:
    return jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key)


def _flat(tree: Any) -> dict[str, Any]:
    """Return a tree's leaves by path, as Orbax takes them: keys as raw words, without empty leaves."""
    words = jax.tree.map(lambda leaf: jax.random.key_data(leaf) if _is_key(leaf) else leaf, tree)
    return {keystr(path): leaf for path, leaf in tree_leaves_with_path(words) if 0 not in leaf.shape}


def _unflat(flat: dict[str, Any], like: Any) -> Any:
    def leaf(path: Any, kind: Any) -> Any:
        if 0 in kind.shape:
            return jnp.zeros(kind.shape, kind.dtype)
        return jax.random.wrap_key_data(flat[keystr(path)]) if _is_key(kind) else flat[keystr(path)]

    return tree_map_with_path(leaf, like)


def _digests(flat: dict[str, Any]) -> dict[str, str]:
    def sha256(leaf: Any) -> str:
        hasher = hashlib.sha256(f"{leaf.shape} {leaf.dtype}".encode())
        hasher.update(np.ascontiguousarray(leaf).data)
        return hasher.hexdigest()

    with ThreadPoolExecutor() as pool:  # hashing releases the interpreter lock
        return dict(zip(flat, pool.map(sha256, flat.values()), strict=True))


def digest(tree: Any) -> str:
    """Return a short SHA-256 of a tree's arrays; equal trees have equal digests."""
    return hashlib.sha256(json.dumps(_digests(_flat(tree)), sort_keys=True).encode()).hexdigest()[:12]


class Checkpoints(AbstractContextManager):
    """The checkpoints in one folder, as a context."""

    def __init__(self, folder: Path, read_only: bool = False, remedy: str = REMEDY, run: str = "") -> None:
        """Open a folder of checkpoints.

        `read_only`: change nothing on disk. `remedy`: of a checkpoint that cannot be read. `run`: the key of the run
        that the checkpoints belong to (`grid.run_key`); empty: of none.
        """
        self._remedy, self._run, self._folder = remedy, run, folder.resolve()
        for name in ("absl", "asyncio"):  # what Orbax's threads log is raised anyway
            logging.getLogger(name).setLevel(logging.CRITICAL)
        writing = {} if read_only else {"max_to_keep": MOST_CHECKPOINTS, "enable_async_checkpointing": False}
        options = ocp.CheckpointManagerOptions(read_only=read_only, **writing)
        self._manager = ocp.CheckpointManager(self._folder, options=options)

    def latest(self) -> int | None:
        """Return the number of the newest complete checkpoint; None if there is none."""
        return self._manager.latest_step()

    def save(self, number: int, items: dict[str, Any]) -> None:
        """Write a checkpoint; return once it is complete on disk."""
        flat = {name: _flat(item) for name, item in items.items()}
        args: dict[str, Any] = {name: ocp.args.StandardSave(item) for name, item in flat.items()}
        args[DIGESTS] = ocp.args.JsonSave({"run": self._run, **{name: _digests(item) for name, item in flat.items()}})
        self._manager.save(number, args=ocp.args.Composite(**args))
        self._manager.wait_until_finished()

    def restore(self, like: dict[str, Any]) -> dict[str, Any]:
        """Return the newest checkpoint's items named in `like` (trees of arrays or shapes), on the default device."""
        if (number := self.latest()) is None:
            raise UserError(f"no checkpoint in {self._folder}: the run was stopped before its first checkpoint")
        device = jax.sharding.SingleDeviceSharding(jax.devices()[0])
        args: dict[str, Any] = {DIGESTS: ocp.args.JsonRestore()}
        shape = lambda leaf: jax.ShapeDtypeStruct(leaf.shape, leaf.dtype, sharding=device)  # noqa: E731
        for name, item in like.items():
            args[name] = ocp.args.StandardRestore(jax.tree.map(shape, jax.eval_shape(_flat, item)))
        try:
            contents = self._manager.restore(number, args=ocp.args.Composite(**args))
            digests = contents[DIGESTS]
            if digests.get("run", self._run) != self._run:
                raise ValueError("it belongs to another run")
            for name in like:
                if _digests(contents[name]) != digests[name]:
                    raise ValueError(f"{name} is not what was written")
            return {name: _unflat(contents[name], like[name]) for name in like}
        except Exception as error:  # Orbax and TensorStore raise many exception types for damaged files
            # Orbax prints the method in place of TensorStore's details.
            words = re.sub(r"\.? See full TensorStore details.*", "", str(error), flags=re.DOTALL).strip()
            why = first_line(words) or type(error).__name__
            raise UserError(f"checkpoint {number} in {self._folder} cannot be read ({why}): {self._remedy}") from error

    def __exit__(self, *_: object) -> None:
        self._manager.close()
