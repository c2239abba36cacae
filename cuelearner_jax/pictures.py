"""Pictures from RGB frames or image files: for the labelling page, as a still, and as a film (GIF or MP4)."""

from __future__ import annotations

import base64
import io
import os
import warnings
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import imageio.v2 as imageio
import numpy as np
from jaxtyping import UInt8
from PIL import Image, ImageOps

from cuelearner_jax.errors import UserError
from cuelearner_jax.types import Reel, Sketch

Picture = UInt8[np.ndarray, "height width 3"]
Source = np.ndarray | bytes  # a `Picture`, or the bytes of a PNG or JPEG file; UserError for anything else
MEDIA_TYPES = {"PNG": "image/png", "JPEG": "image/jpeg"}  # readable file formats and their media types
LARGEST = 1280  # longest side of a picture on the page, of a film there half of it [pixels]
SHEET = 6  # frames of a film that its still shows
TURNED = 0x0112  # the EXIF tag that says how a camera was held


def sketch(image: Source, words: str = "") -> Sketch:
    """Return a picture as the sketch of a situation, in pixels; `words`: about the situation, in a few words."""
    uri, (width, height) = _uri(image, LARGEST)
    still = f'<image class="photo" href="{uri}" width="{width}" height="{height}"/>'
    foot, reach = (width / 2, height / 2), (0.0, min(width, height) / 4)
    return Sketch((0.0, 0.0, width, height), still, {}, {}, foot, reach, 0.0, words=words)


def clip(frames: Sequence[Source], period: float, words: str = "") -> Reel:
    """Return a short film of pictures that replaces a sketch's picture while it plays.

    `period`: between two of them [s]. `words`: for the film's end.
    """
    return Reel(period, [], words, [_uri(frame, LARGEST // 2)[0] for frame in frames])


def still(frames: Sequence[Source], file: str | os.PathLike[str]) -> None:
    """Write up to six frames of a film, the first and the last among them, as one PNG."""
    places = np.unique(np.linspace(0, len(frames) - 1, SHEET).round().astype(int))
    pictures = [pixels(frames[number]) for number in places]
    height, width = pictures[0].shape[:2]
    columns = min(3, len(pictures))
    sheet = Image.new("RGB", (columns * width, -(-len(pictures) // columns) * height), "white")
    for number, frame in enumerate(pictures):
        sheet.paste(Image.fromarray(frame), (number % columns * width, number // columns * height))
    sheet.save(file, format="PNG")


def animate(frames: Sequence[Source], file: str | os.PathLike[str], fps: float = 25.0) -> None:
    """Write all frames as a film; raises UserError unless its name ends in .gif or .mp4."""

    def even(rate: float) -> Iterator[Picture]:
        for number in range(max(1, round(len(frames) * rate / fps))):
            frame = pixels(frames[min(int(number * fps / rate), len(frames) - 1)])
            yield frame[: len(frame) // 2 * 2, : frame.shape[1] // 2 * 2]  # even sides, as codecs need

    specimen = np.concatenate([pixels(frames[number]) for number in (0, len(frames) // 2, -1)])
    write_film(file, fps, even, palette_of(specimen, 256))


def pixels(image: Source) -> Picture:
    """Return a picture as RGB uint8 (height, width, 3). Raises UserError for anything else."""
    return np.asarray(_opened(image)[0].convert("RGB"))


def _opened(image: Any) -> tuple[Image.Image, str]:
    """Return the image, rotated as its EXIF tag says, and the format of the file's bytes; empty: of other bytes."""
    if isinstance(image, np.ndarray):
        if image.dtype != np.uint8 or image.shape[2:] != (3,):
            raise UserError(f"a picture is {image.dtype} {image.shape}: give uint8 (height, width, 3), as RGB")
        return Image.fromarray(image), ""
    try:
        picture = Image.open(io.BytesIO(image), formats=tuple(MEDIA_TYPES))
        kind = picture.format or ""
        if picture.getexif().get(TURNED, 1) != 1:
            picture, kind = ImageOps.exif_transpose(picture), ""  # rotated, so the stored bytes are not reused
        picture.load()
    except Exception as error:  # Pillow raises many kinds for damaged files
        raise UserError(f"a picture cannot be read ({error}): give the bytes of a PNG or JPEG file") from error
    return picture, kind


def _uri(image: Source, largest: int) -> tuple[str, tuple[int, int]]:
    """Return a picture as a data URI with its longer side at most `largest`, and its width and height [pixels]."""
    picture, kind = _opened(image)
    data = image if isinstance(image, bytes) else b""
    if kind not in MEDIA_TYPES or max(picture.size) > largest:
        picture = picture.convert("RGB")
        picture.thumbnail((largest, largest))
        file, kind = io.BytesIO(), "JPEG"
        picture.save(file, format=kind, quality=92, subsampling=0)
        data = file.getvalue()
    return f"data:{MEDIA_TYPES[kind]};base64,{base64.b64encode(data).decode()}", picture.size


def write_film(
    file: str | os.PathLike[str], fps: float, pictures: Callable[[float], Iterator[Picture]], palette: Sequence[int]
) -> None:
    """Write a film of pictures that are made one by one: GIF with one exact palette (see `palette_of`), or MP4.

    `pictures` makes them for a rate [1/s]: `fps`, but a GIF counts in hundredths of a second. Raises UserError for
    another suffix.
    """
    if (suffix := Path(file).suffix.lower()) not in (".gif", ".mp4"):
        raise UserError(f"cannot animate to {file}: give a name in .gif or .mp4")
    if suffix == ".gif":
        delay = max(2, round(100 / fps))  # [1/100 s]; viewers slow down what is faster
        _write_gif(file, pictures(100 / delay), 10 * delay, palette)
    else:
        _write_mp4(file, pictures(fps), fps)


def palette_of(specimen: Picture, colours: int, exactly: Sequence[str] = ()) -> list[int]:
    """Return red, green and blue of so many colours of a picture, after the colours that must be exact (256 at most).

    Quantizing merges what is rare; few colours mean fewer shades at the edges and a smaller file.
    """
    from matplotlib.colors import to_rgb

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
    from scipy.spatial import KDTree

    tree = KDTree(np.reshape(palette, (-1, 3)))
    nearest = np.full(1 << 24, -1, np.int16)  # place in the palette, for each colour that was met so far

    def indexed(picture: np.ndarray) -> Image.Image:
        # Pillow's own search is quicker still, but inexact: white turns grey.
        keys = picture.astype(np.uint32) @ np.array([1 << 16, 1 << 8, 1], np.uint32)
        if len(new := np.unique(keys[nearest[keys] < 0])):
            nearest[new] = tree.query(np.stack([new >> 16, new >> 8 & 255, new & 255], axis=-1))[1]
        image = Image.fromarray(nearest[keys].astype(np.uint8))
        image.putpalette(list(palette))
        return image

    rest = (indexed(picture) for picture in pictures)
    options: dict[str, Any] = {"duration": milliseconds, "loop": 0, "optimize": False}
    next(rest).save(file, save_all=True, append_images=rest, **options)
