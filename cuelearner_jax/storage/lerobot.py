"""Read LeRobot datasets, format v3.0, without LeRobot: observations, actions and single camera frames.

    meta/info.json                                  codebase_version, fps, features
    meta/episodes/chunk-000/file-000.parquet        position of each episode in the videos
    data/chunk-000/file-000.parquet                 one row per frame
    videos/KEY/chunk-000/file-000.mp4               frames of consecutive episodes

Source: huggingface/lerobot 0.6.2, src/lerobot/datasets/utils.py and docs/source/lerobot-dataset-v3.mdx. Paths are
those of the format, never templates from a file. Only the requested frames of a video are decoded.
"""

from __future__ import annotations

import io
import json
from collections.abc import Callable
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from jaxtyping import Float

from cuelearner_jax.errors import UserError, format_value
from cuelearner_jax.storage.picture_files import Picture, inside, read_picture

INFO = Path("meta/info.json")
VERSION = "v3.0"  # of the format
VIDEO = "videos/{key}/chunk-{chunk:03d}/file-{file:03d}.mp4"
OBSERVATION, ACTION, INTERVENTION = "observation", "action", "intervention"
Frames = Callable[[int], Picture]  # row -> its picture


def read(path: Path) -> tuple[np.ndarray, np.ndarray, tuple[str, ...], tuple[str, ...], Frames | None]:
    """Read a dataset's rows, in the order of its files; pictures are read on demand.

    Rows in which a person intervened are left out: their actions are not the policy's. Returns observations (n, obs),
    without entries where the dataset has pictures alone, and actions (n, action); and the names of the entries of each,
    empty where the dataset names none. Last comes a function from a row to the first camera's picture, None without a
    camera.
    """
    features = _features(path)
    cameras = [key for key, feature in features.items() if feature["dtype"] in ("video", "image")]
    parts = [_parts(path, features, name, cameras) for name in (OBSERVATION, ACTION)]
    images = [key for key in cameras[:1] if features[key]["dtype"] == "image"]
    marks = [INTERVENTION] if INTERVENTION in features else []
    columns = [*parts[0], *parts[1], "episode_index", "timestamp", *images, *marks]
    if not (files := sorted((path / "data").glob("chunk-*/file-*.parquet"))):
        raise _damage_error(path / "data", "no frames")
    table = pa.concat_tables([_parquet(file, columns) for file in files], promote_options="permissive")
    if marks:
        table = table.filter(pa.array(_vectors(path, table, INTERVENTION, 1)[:, 0] == 0))
    none = np.zeros((len(table), 0), np.float32)
    observations, actions = (
        np.concatenate([none, *(_vectors(path, table, key, features[key]["shape"][0]) for key in keys)], -1)
        for keys in parts
    )
    names, entries = (_entries(features, keys) for keys in parts)
    return observations, actions, names, entries, _frames(path, features, table, cameras[0]) if cameras else None


def _damage_error(path: Path, why: object) -> UserError:
    return UserError(f"{path} cannot be read ({why}): restore it from where the dataset came from")


def _parts(path: Path, features: dict[str, Any], name: str, cameras: list[str]) -> list[str]:
    """Return the features of numbers called `name` or `name.PART`; none for observations by `cameras` alone."""
    kinds = ("float", "int", "uint", "bool")
    own = [key for key, one in features.items() if one["dtype"].startswith(kinds) and key.split(".")[0] == name]
    if more := [key for key in own if len(features[key]["shape"]) != 1]:
        raise UserError(f"{path}: {more[0]} has more than one axis: store it with one, or take it out of {INFO}")
    parts = [name] if name in own else own
    others = {key for key in features if key.startswith(name)} - {*cameras}
    if not parts and (name != OBSERVATION or others or not cameras):
        there = ", ".join(features)
        advice = "give a dataset with one"
        raise UserError(f"{path} has no feature {name} or {name}.PART of numbers (it has {there}): {advice}")
    return parts


def _features(path: Path) -> dict[str, Any]:
    """Return the features that info.json describes. Raises UserError for another version or invalid contents."""
    try:
        info = json.loads((path / INFO).read_text(encoding="utf-8"))
        version, features = info["codebase_version"], dict(info["features"])
    except (ValueError, KeyError, TypeError) as error:
        raise _damage_error(path / INFO, error) from error
    if version != VERSION:
        why = f"{path} is a LeRobot dataset of the format {format_value(version)}, {VERSION} is needed"
        raise UserError(f"{why}: convert it by LeRobot's own script first")
    return features


def _parquet(file: Path, columns: list[str]) -> pa.Table:
    try:
        return pq.read_table(file, columns=columns)
    except (pa.ArrowException, OSError, ValueError, KeyError) as error:
        raise _damage_error(file, error) from error


def _vectors(path: Path, table: pa.Table, key: str, size: int) -> Float[np.ndarray, "n size"]:
    try:
        values = np.asarray(table[key].to_pylist(), np.float32)
        values = values.reshape(-1, 1) if size == 1 else values
        if values.shape != (len(table), size):
            raise ValueError
        return values
    except (TypeError, ValueError) as error:
        raise UserError(f"{path}: {key} does not hold {size} numbers in every frame: leave the others out") from error


def _entries(features: dict[str, Any], parts: list[str]) -> tuple[str, ...]:
    """Return the names of the parts' entries, one after the other; empty unless each entry has a name of its own."""
    entries = []
    for key in parts:
        if len(names := _flat(features[key].get("names"))) != features[key]["shape"][0]:
            return ()
        part = key.partition(".")[2]
        entries += [f"{part}: {name}" for name in names] if len(parts) > 1 else names
    return tuple(entries) if len(set(entries)) == len(entries) else ()


def _flat(names: Any) -> list[str]:
    """Return the names in nested lists and groups, or in a map of names to positions, in the order of the entries."""
    if isinstance(names, dict) and all(type(position) is int for position in names.values()):
        return sorted(names, key=names.__getitem__)
    if isinstance(names, dict | list):
        return [name for group in (names.values() if isinstance(names, dict) else names) for name in _flat(group)]
    return [] if names is None else [str(names)]


def _frames(path: Path, features: dict[str, Any], table: pa.Table, key: str) -> Frames:
    if features[key]["dtype"] == "image":
        return lambda row: _read_embedded(path, table[key][row].as_py())
    names = [f"videos/{key}/{name}" for name in ("chunk_index", "file_index", "from_timestamp")]
    starts: dict[int, list[Any]] = {}
    for file in sorted((path / "meta/episodes").glob("chunk-*/file-*.parquet")):
        episodes = _parquet(file, ["episode_index", *names])
        starts |= {row["episode_index"]: [row[name] for name in names] for row in episodes.to_pylist()}

    def frame(row: int) -> Picture:
        episode, timestamp = table["episode_index"][row].as_py(), table["timestamp"][row].as_py()
        if episode not in starts:
            raise _damage_error(path / "meta/episodes", f"nothing says where episode {episode} begins")
        chunk, number, start = starts[episode]
        video = inside(path, VIDEO.format(key=key, chunk=chunk, file=number), "the video")
        return Picture(_decode_frame(video, start + timestamp), "image/png")

    return frame


def _read_embedded(path: Path, value: dict[str, Any]) -> Picture:
    """Return the picture stored in a row, as {"bytes": ..., "path": ...}, or in a file that the row names."""
    if (data := value["bytes"]) is None:
        return read_picture(path, value["path"])
    return Picture(data, "image/jpeg" if data.startswith(b"\xff\xd8") else "image/png")


@lru_cache(maxsize=64)
def _decode_frame(file: Path, time: float) -> bytes:
    """Return the frame nearest to a time [s] of a video, as PNG. Raises UserError if there is none.

    The video's own rate may differ from the dataset's.
    """
    from imageio_ffmpeg import read_frames  # takes a while to load
    from PIL import Image

    try:
        interval = 1 / next(read_frames(file))["fps"]
        frames = read_frames(file, input_params=["-ss", f"{max(0.0, time - interval / 2):.6f}"])
        picture = Image.frombytes("RGB", next(frames)["size"], next(frames))
        frames.close()
    except (OSError, RuntimeError, StopIteration, ZeroDivisionError) as error:
        raise _damage_error(file, f"no frame at {time:.3f} s") from error
    data = io.BytesIO()
    picture.save(data, "PNG")
    return data.getvalue()
