"""Pictures of recorded situations: what the cameras saw, and where actions lead in their pictures.

`env` is `logs.Logs`, with the path of the situations and each row's place there; `state` has the row.
"""

from __future__ import annotations

import io
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import imageio.v2 as imageio
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from cuelearner_jax import pictures
from cuelearner_jax.errors import UserError
from cuelearner_jax.storage import situations
from cuelearner_jax.task import Pictures
from cuelearner_jax.types import Reel, Sketch

CLIP_FRAMES = 60  # most frames of a clip
PERIOD = 100  # between two frames of a GIF that says nothing of it [ms]
BLANK = np.full((240, 320, 3), 255, np.uint8)  # for a row without a picture
STEP = 0.01  # move by which a picture shows where an axis points [m]
LEAST_WAY = 0.2  # an axis that appears shorter, beside the longest, points nowhere in a picture


def _frames(env: Any, row: Any) -> tuple[list[Any], int, float]:
    """Return the frames of a row's picture or clip, the row's place in the recording, and the frames' period [s]."""
    if not env.path:
        raise UserError("these situations are those of labels, without pictures: name their folder, as logs:FOLDER")
    place = int(env.places[row])
    if (picture := situations.read_once(Path(env.path)).picture(place)) is None:
        return [BLANK], place, 0.0
    if picture.kind.startswith("image/") and picture.kind != "image/gif":
        return [picture.data], place, 0.0
    try:
        suffix = "." + picture.kind.partition("/")[2]
        reader = imageio.get_reader(io.BytesIO(picture.data), format=suffix, mode="I")  # pyright: ignore
        film, about = [*reader.iter_data()], reader.get_meta_data()
    except Exception as error:  # film readers raise many exception types
        raise UserError(f"a clip cannot be read ({' '.join(str(error).split())[:80]}): give GIF or MP4") from error
    numbers = np.unique(np.linspace(0, len(film) - 1, min(len(film), CLIP_FRAMES)).round().astype(int))
    seconds = len(film) * (1 / about["fps"] if "fps" in about else (about.get("duration") or PERIOD) / 1000)
    frames = [np.ascontiguousarray(np.asarray(film[number])[..., :3]) for number in numbers]
    return frames, place, seconds / len(frames)


def _sketch(env: Any, state: Any) -> Sketch:
    frames, place, _ = _frames(env, state.row)
    text = situations.read_once(Path(env.path)).text(place)
    sketch = pictures.sketch(frames[0], f"situation {place}" + (f": {text}" if text else ""))
    for _, (hand, *steps) in _in_cameras(env, state, sketch, lambda hand: hand + STEP * np.eye(3))[:1]:
        ways = np.stack(steps) - hand
        ways /= np.linalg.norm(ways, axis=-1).max()
        points = [(x, y) if math.hypot(x, y) > LEAST_WAY else None for x, y in ways.tolist()]
        sketch = sketch._replace(points=(*points, *[None] * (env.actions.size - len(points))))
    return sketch


def _in_cameras(
    env: Any, state: Any, sketch: Sketch, places: Callable[[np.ndarray], np.ndarray]
) -> list[tuple[np.ndarray, Float[np.ndarray, "n 2"]]]:
    """Return, of each camera that sees the hand, its area in the sketch, and where the hand and other places appear.

    `places` is a function of the hand's position (3,) that returns others (n, 3).
    """
    recording, cameras = situations.read_once(Path(env.path)), []
    if recording.hands is None or not recording.about:
        return []
    hand = recording.hands[int(env.places[state.row])]
    rows = np.pad(np.vstack([hand, places(hand)]), ((0, 0), (0, 1)), constant_values=1.0)
    for projection, area in zip(recording.about["projections"], recording.about["areas"], strict=True):
        across, depth = np.split(rows @ projection.T, [2], -1)
        points, box = across / depth * sketch.box[2:], area * np.tile(sketch.box[2:], 2)
        if (depth > 0).all() and ((box[:2] <= points[0]) & (points[0] <= box[:2] + box[2:])).all():
            cameras.append((box, points))
    return cameras


def _trails(env: Any, state: Any, actions: Float[Array, "n action"]) -> list[str]:
    """Draw each action as an arrow from the hand to where it leads, in the picture of each camera with the hand."""
    from cuelearner_jax.labelling import view

    sketch, arrows = _sketch(env, state), [""] * len(actions)
    for box, (hand, *ends) in _in_cameras(env, state, sketch, lambda hand: np.asarray(actions)[:, :3]):
        for number, (x, y) in enumerate(ends - hand):
            own = sketch._replace(box=box, foot=hand, reach=(0.0, math.hypot(x, y)), turn=0.0)
            arrows[number] += view.arrow(own, math.degrees(math.atan2(-y, x)), "motion")
    return arrows


def _reel(env: Any, state: Any, action: Any) -> Reel | None:
    frames, _, period = _frames(env, state.row)
    return pictures.clip(frames, period, "as recorded") if len(frames) > 1 else None


def _record(env: Any, policy: Any, key: PRNGKeyArray, steps: int) -> tuple[list[Any], list[float]]:
    """Return one picture per situation, in order; there are no rewards."""
    return [pictures.pixels(_frames(env, row % len(env.rows))[0][0]) for row in range(steps)], [0.0] * steps


PICTURES = Pictures(
    record=_record,
    still=lambda env, frames, file: pictures.still(frames, file),
    animate=lambda env, frames, file: pictures.animate(frames, file, fps=4.0),
    question=lambda env, state, obs, action, file: pictures.still(_frames(env, state.row)[0][:1], file),
    sketch=_sketch,
    reel=_reel,
    trails=_trails,
    simulates=False,
)
