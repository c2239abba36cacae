"""Picture files beside recorded situations, confined to one folder."""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

from cuelearner_jax.errors import UserError, format_value

KINDS = {
    ".png": "image/png",
    ".jpg": "image/jpeg",
    ".jpeg": "image/jpeg",
    ".gif": "image/gif",
    ".mp4": "video/mp4",
}


class Picture(NamedTuple):
    """A picture or a short clip as stored in a file."""

    data: bytes
    kind: str  # media type, one of `KINDS`


def inside(folder: Path, name: str, what: str) -> Path:
    """Return the path of a file below a folder. Raises UserError for a name that leads out of the folder.

    Links are followed: datasets lie in the hub's cache as links to files elsewhere.
    """
    if Path(name).is_absolute() or ".." in Path(name).parts or "\0" in name:
        raise UserError(f"{what} {format_value(name)} leads out of {folder}: give the name of a file in that folder")
    return folder / name


class PictureFiles:
    """Pictures in files beside a table."""

    def __init__(self, table: Path, names: Any) -> None:
        """Check the names, one a row, empty for none. Raises UserError for names that are none of a picture's file."""
        self._folder, self._names = table.parent, [None if name in (None, "") else name for name in list(names)]
        for name in {name for name in self._names if name is not None}:
            if not isinstance(name, str) or Path(inside(self._folder, name, "picture")).suffix.lower() not in KINDS:
                raise UserError(
                    f"{table}: {format_value(name)} is no picture's file that the page shows: give one of "
                    f"{', '.join(KINDS)}"
                )

    def __call__(self, row: int) -> Picture | None:
        """Return the picture of a row; None if it has none. Raises UserError for a picture that cannot be read."""
        if (name := self._names[row]) is None:
            return None
        place = inside(self._folder, name, "picture")
        try:
            return Picture(place.read_bytes(), KINDS[place.suffix.lower()])
        except OSError as error:
            raise UserError(f"picture {place} of row {row} cannot be read ({error.strerror}): put it there") from error
