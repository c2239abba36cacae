"""Picture files beside recorded situations, confined to one folder."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

from cuelearner_jax.errors import UserError, format_value

KINDS = {".png": "image/png", ".jpg": "image/jpeg", ".jpeg": "image/jpeg", ".gif": "image/gif", ".mp4": "video/mp4"}


class Picture(NamedTuple):
    """A picture or a short clip as stored in a file."""

    data: bytes
    kind: str  # media type, one of `KINDS`


def inside(folder: Path, name: str, what: str) -> Path:
    """Return the path of a file below a folder. Raises UserError for a name that leads out of the folder.

    Links are followed: datasets lie in the hub's cache as links to files elsewhere.
    """
    if Path(name).is_absolute() or ".." in Path(name).parts:
        raise UserError(f"{what} {format_value(name)} leads out of {folder}: give the name of a file in that folder")
    return folder / name


def read_picture(folder: Path, name: str) -> Picture:
    """Read a picture below a folder. Raises UserError for a name that leads out of it, or that is not a picture's."""
    path = inside(folder, name, "picture")
    if (kind := KINDS.get(path.suffix.lower())) is None:
        raise UserError(f"{format_value(name)} is no picture's file that the page shows: give {', '.join(KINDS)}")
    try:
        return Picture(path.read_bytes(), kind)
    except (OSError, ValueError) as error:
        raise UserError(f"picture {path} cannot be read ({error}): put it there") from error
