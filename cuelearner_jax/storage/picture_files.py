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
LARGEST_PICTURE = 50_000_000  # bytes


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

    def __init__(self, table: Path, names: Any, rows: int) -> None:
        """Check the names. Raises UserError for invalid or missing names, or names that lead out of the folder."""
        self._folder = table.parent
        names = [
            None if name in (None, "") else name for name in (names.tolist() if hasattr(names, "tolist") else names)
        ]
        if len(names) != rows:
            raise UserError(
                f"{table} has {len(names)} pictures for {rows} situations: give one name per row, or an empty one"
            )
        if wrong := next((name for name in names if name is not None and not isinstance(name, str)), None):
            raise UserError(
                f"{table}: {format_value(wrong)} is not a picture's file name: give the name of a file in the folder"
            )
        for name in {name for name in names if name is not None}:
            inside(self._folder, name, "picture")
            if Path(name).suffix.lower() not in KINDS:
                raise UserError(
                    f"picture {format_value(name)} has a type that the page does not show: give one of "
                    f"{', '.join(KINDS)}"
                )
        self._names: list[str | None] = names

    def __call__(self, row: int) -> Picture | None:
        """Return the picture of a row; None if it has none. Raises UserError for a picture that cannot be read."""
        if (name := self._names[row]) is None:
            return None
        place = inside(self._folder, name, "picture")
        try:
            if place.stat().st_size > LARGEST_PICTURE:
                raise UserError(f"picture {place} has more than {LARGEST_PICTURE:,} bytes: make it smaller")
            data = place.read_bytes()
        except OSError as error:
            raise UserError(f"picture {place} of row {row} cannot be read ({error.strerror}): put it there") from error
        return Picture(data, KINDS[place.suffix.lower()])
