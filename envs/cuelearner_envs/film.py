"""Writing films of pictures that are made one by one: GIF with one exact palette, or MP4."""

from __future__ import annotations

import os
import warnings
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import imageio.v2 as imageio
import numpy as np
from jaxtyping import UInt8
from matplotlib.colors import to_rgb
from PIL import Image
from scipy.spatial import KDTree

Picture = UInt8[np.ndarray, "height width 3"]
KINDS = (".gif", ".mp4")


def write(
    file: str | os.PathLike[str], fps: float, pictures: Callable[[float], Iterator[Picture]], palette: Sequence[int]
) -> None:
    """Writes a film.

    Args:
        file: a name that ends in .gif or .mp4.
        fps: pictures a second; a GIF counts in hundredths of a second and takes the nearest rate it can have.
        pictures: makes them for the rate that it gets.
        palette: a GIF's colours, see `palette_of`.

    Raises:
        ValueError: if the name ends otherwise or the rate is not positive.
    """
    check(file, fps)
    if Path(file).suffix.lower() == ".gif":
        delay = max(2, round(100 / fps))  # [1/100 s]; viewers slow down what is faster
        _write_gif(file, pictures(100 / delay), 10 * delay, palette)
    else:
        _write_mp4(file, pictures(fps), fps)


def check(file: str | os.PathLike[str], fps: float) -> None:
    """Raises ValueError if such a film can't be written."""
    if Path(file).suffix.lower() not in KINDS:
        raise ValueError(f"cannot animate to {file}: give a name that ends in .gif or .mp4")
    if fps <= 0:
        raise ValueError(f"cannot animate at {fps} pictures a second: give a positive fps")


def palette_of(specimen: Picture, colours: int, exactly: Sequence[str] = ()) -> list[int]:
    """Red, green and blue of so many colours of a picture after those that must be exact (at most 256 in all).

    Quantizing merges what is rare; few colours mean fewer shades at the edges and a smaller file.
    """
    shades = Image.fromarray(specimen).quantize(colors=colours, kmeans=1, dither=Image.Dither.NONE).getpalette() or []
    return [round(255 * part) for name in exactly for part in to_rgb(name)] + shades


def _write_mp4(file: str | os.PathLike[str], pictures: Iterator[Picture], fps: float) -> None:
    # Codecs want even sides, which the drawings have; imageio would otherwise scale to multiples of 16.
    writer: Any = imageio.get_writer(file, format="FFMPEG", fps=fps, macro_block_size=2, quality=8)  # pyright: ignore
    with writer, warnings.catch_warnings():
        # JAX warns of any fork; this one becomes ffmpeg at once.
        warnings.filterwarnings("ignore", message=r"os\.fork", category=RuntimeWarning)
        for picture in pictures:
            writer.append_data(picture)


def _write_gif(
    file: str | os.PathLike[str], pictures: Iterator[Picture], milliseconds: int, palette: Sequence[int]
) -> None:
    tree = KDTree(np.reshape(palette, (-1, 3)))
    nearest = np.full(1 << 24, -1, np.int16)  # place in the palette, for each colour that was met so far

    def indexed(picture: np.ndarray) -> Image.Image:
        # Pillow's own search is quicker still, but inexact: white turns grey.
        keys = picture.astype(np.uint32) @ np.array([1 << 16, 1 << 8, 1], np.uint32)
        new = np.unique(keys[nearest[keys] < 0])
        if len(new):
            nearest[new] = tree.query(np.stack([new >> 16, new >> 8 & 255, new & 255], axis=-1))[1]
        image = Image.fromarray(nearest[keys].astype(np.uint8))
        image.putpalette(list(palette))
        return image

    rest = (indexed(picture) for picture in pictures)
    options: dict[str, Any] = {"duration": milliseconds, "loop": 0, "optimize": False}
    next(rest).save(file, save_all=True, append_images=rest, **options)
