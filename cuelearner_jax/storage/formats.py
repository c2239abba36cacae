"""Format numbers of the files that outlive the program that wrote them, and the one way in which older ones are read.

| kind      | file                   | values                 |
|-----------|------------------------|------------------------|
| `config`  | `config.json` of a run | its contents           |
| `labels`  | a label file           | what it says of itself |
| `teacher` | `teacher.json`         | its contents           |
| `policy`  | `policy.json`          | its contents           |
| `due`     | `due.json` of a run    | its contents           |

A file tells its number under `format`; one without a number is of format 0. A change of what is written raises the
number here and adds a step that leads there from the number before; readers know the current format only. A format
without a step is refused.

A JSON file carries a digest of its values, and is not read if they are others: a changed bit is no configuration.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

from cuelearner_jax import config as configuration
from cuelearner_jax.errors import UserError
from cuelearner_jax.storage.whole import replacing, unreadable

DIGEST = "digest"  # the name under which a JSON file holds the digest of its other values
FORMATS = {"config": 2, "labels": 3, "teacher": 3, "policy": 2, "due": 2}
LARGEST = 1 << 26  # bytes of a JSON file
SEALED_SINCE = 2  # the format from which on a JSON file must carry a digest
REMEDIES = {  # what a message says of a damaged file, after its path
    "config": "is damaged or of another program: restore it, or start anew with --overwrite",
    "labels": "is not a label file of cuelearner, or it is damaged: restore it, or write it anew",
    "teacher": "is damaged: restore it, or train the teacher anew",
    "policy": "is damaged: restore it, or adapt the policy anew",
    "due": "is damaged: restore it, or delete the folder that it is in and give --resume",
}

Values = dict[str, Any]


def damaged(kind: str, path: Path, reason: object = "") -> UserError:
    """Build the error for a file that makes no sense; `reason`: why, where that is known."""
    why = (str(reason).splitlines() or [""])[0][:200]
    return UserError(f"{path} {REMEDIES[kind]}{f' ({why})' if why else ''}")


def read(kind: str, path: Path) -> Values:
    """A JSON file in the current format of its kind, without its digest.

    Raises:
        UserError: it cannot be read, is damaged, was changed since it was written, or is newer than this program.
    """
    try:
        if (size := path.stat().st_size) > LARGEST:
            raise damaged(kind, path, f"{size:,} bytes, more than any such file has")
        values = json.loads(path.read_text(encoding="utf-8"))
        if isinstance(values, dict):
            number, told = values.get("format", 0), values.pop(DIGEST, None)
            sealed = isinstance(number, int) and number >= SEALED_SINCE
            if (sealed or told is not None) and told != configuration.digest(values):
                raise damaged(kind, path)
    except OSError as error:
        raise unreadable(path, error) from error
    except (ValueError, RecursionError) as error:
        raise damaged(kind, path) from error
    return upgrade(kind, values, path)


def write(kind: str, path: Path, values: Values) -> None:
    """Writes a JSON file of the current format with its digest, replacing `path` in one step."""
    values = json.loads(json.dumps({**values, "format": FORMATS[kind]}))
    with replacing(path) as file:
        file.write(json.dumps({**values, DIGEST: configuration.digest(values)}, indent=1) + "\n")


def upgrade(kind: str, values: Any, path: Path) -> Values:
    """The values of a file of any format in the current one; those given are left as they are.

    Args:
        kind: a key of `FORMATS`.
        values: what the file holds.
        path: the file, for messages.

    Raises:
        UserError: the file was written by a newer program, or makes no sense.
    """
    number = values.get("format", 0) if isinstance(values, dict) else None
    if not isinstance(number, int) or isinstance(number, bool) or number < 0:
        raise damaged(kind, path)
    if number > FORMATS[kind]:
        raise UserError(
            f"{path} was written by a newer cuelearner: update, or use the one that wrote it "
            f"(its format is {number}, this program knows up to {FORMATS[kind]})"
        )
    for before in range(number, FORMATS[kind]):
        if (kind, before) not in STEPS:
            raise UserError(f"{path} is of format {number}, which had no checksums and is not read: write it anew")
        try:
            values = {**STEPS[kind, before](values), "format": before + 1}
        except UserError as error:
            raise UserError(f"{path}: {error}") from error
        except (KeyError, TypeError, ValueError, AttributeError) as error:
            raise damaged(kind, path) from error
    return values


def _only_numbered(values: Values) -> Values:
    """The first number changed nothing else."""
    return values


def _pieces_with_seeds(values: Values) -> Values:
    """A piece of a sweep told its number and the count; now the seeds of all pieces too, which are not known here."""
    if "shard" not in values:
        return values
    index, count = values["shard"]
    return {**values, "shard": {"index": index, "count": count, "seeds": None}}


def _seen_in_another_order(values: Values) -> Values:
    """What a teacher's network takes stood ball by ball; now what hangs on the direction stands apart."""
    raise UserError(
        "the teacher was trained by an earlier cuelearner, whose networks saw the table in another order: train it "
        "anew with `python experiments/train_teacher.py`"
    )


def _never_written(values: Values) -> Values:
    """Policy folders began with a format whose files carry digests."""
    raise ValueError("no program wrote this format")


STEPS: dict[tuple[str, int], Callable[[Values], Values]] = {
    ("config", 0): _only_numbered,
    ("config", 1): _pieces_with_seeds,
    ("labels", 2): _only_numbered,  # since then labels may be of several strengths
    ("teacher", 0): _only_numbered,
    ("teacher", 1): _only_numbered,
    ("teacher", 2): _seen_in_another_order,
    ("policy", 0): _never_written,
    ("policy", 1): _never_written,
}
