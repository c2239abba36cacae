"""Format numbers of the files that outlive the program that wrote them; only current formats are read.

| kind      | file                   | values                 |
|-----------|------------------------|------------------------|
| `config`  | `config.json` of a run | its contents           |
| `labels`  | a label file           | what it says of itself |
| `teacher` | `teacher.json`         | its contents           |
| `policy`  | `policy.json`          | its contents           |

A file has its format number under `format`. Whoever changes what is written raises the number here and rewrites the
repository's files by a script; readers support the current format only.

A JSON file carries a digest of its values and is refused if the values have another digest.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from cuelearner_jax import config as configuration
from cuelearner_jax.errors import UserError, first_line
from cuelearner_jax.storage.whole import replacing

DIGEST = "digest"  # the name under which a JSON file holds the digest of its other values
FORMATS = {"config": 2, "labels": 1, "teacher": 1, "policy": 2}
REMEDIES = {  # the remedy in the message about a damaged file, after its path
    "config": "is damaged or of another program: restore it, or start anew with --overwrite",
    "labels": "is not a label file of cuelearner, or it is damaged: restore it, or write it anew",
    "teacher": "is damaged: restore it, or train the teacher anew",
    "policy": "is damaged: restore it, or adapt the policy anew",
}

Values = dict[str, Any]


def damage_error(kind: str, path: Path, reason: object = "") -> UserError:
    """Return the error for a file that cannot be parsed; `reason` says why, where known."""
    return UserError(f"{path} {REMEDIES[kind]}{f' ({why})' if (why := first_line(reason)) else ''}")


def read(kind: str, path: Path) -> Values:
    """Read a JSON file in the current format of its kind; return its values without the digest."""
    try:
        values = json.loads(path.read_text(encoding="utf-8"))
    except ValueError as error:
        raise damage_error(kind, path) from error
    check(kind, values, path)
    if values.pop(DIGEST, None) != configuration.digest(values):
        raise damage_error(kind, path)
    return values


def write(kind: str, path: Path, values: Values) -> None:
    """Write a JSON file of the current format with its digest, replacing `path` atomically."""
    values = json.loads(json.dumps({**values, "format": FORMATS[kind]}))
    with replacing(path) as file:
        file.write(json.dumps({**values, DIGEST: configuration.digest(values)}, indent=1) + "\n")


def check(kind: str, values: Any, path: Path) -> None:
    """Raise UserError unless a file's values have the current format of its kind (a key of `FORMATS`)."""
    number = values.get("format") if isinstance(values, dict) else None
    if type(number) is not int:
        raise damage_error(kind, path)
    if number != FORMATS[kind]:
        advice = "use the cuelearner that wrote it, or make it anew with this one"
        raise UserError(f"{path} is of format {number}, this program reads format {FORMATS[kind]}: {advice}")
