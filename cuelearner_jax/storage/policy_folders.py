"""Policy folders: a finished policy with everything that acting needs, in one folder.

    policy.json       the policy's parts, where it was adapted, how it was evaluated
    arrays/           networks and bounds, as a checkpoint with digests
    labels.parquet    the answers; labels-60deg.parquet and so on where lanes differ in their bounds

The folder appears atomically, once all of it is written (`whole.Place`). It names code but never contains any.
"""

from __future__ import annotations

from contextlib import AbstractContextManager
from pathlib import Path

from cuelearner_jax.errors import UserError
from cuelearner_jax.storage import whole
from cuelearner_jax.storage.whole import Place, is_occupied

POLICY, ARRAYS = "policy.json", "arrays"


def is_one(folder: Path) -> bool:
    """Whether a folder is a policy folder."""
    return (folder / POLICY).exists()


def place_of(folder: Path, overwrite: bool) -> AbstractContextManager[Place]:
    """Claim the place of a policy folder for this process (`whole.place_of`).

    Raises UserError unless the place is free, or holds a policy folder and `overwrite` is given.
    """

    def check(there: Path) -> None:
        if is_occupied(there) and not overwrite:
            raise UserError(f"{there} is not empty: give --overwrite to delete it, or another --out")
        if is_occupied(there) and not is_one(there):
            raise UserError(f"{there} is not a policy folder, so --overwrite will not delete it: give another --out")

    return whole.place_of(folder, check, overwrite)
