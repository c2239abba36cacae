"""Folders of recorded situations, and a small LeRobot dataset, as tests write them."""

import importlib.util
import json
from pathlib import Path

import imageio.v2 as imageio
import jax
import jax.numpy as jnp
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from PIL import Image

from cuelearner_jax.config import to_json
from cuelearner_jax.feedback.answers import relative_feedback
from cuelearner_jax.storage import label_files
from cuelearner_jax.types import Label

ENTRIES = ("sideways", "height", "fingers")
LOW, HIGH = (-0.5, 0.0, -1.0), (0.5, 0.4, 1.0)


def arrays(rows=12, seed=0):
    """Observations (rows, 4) and actions (rows, 3) of a box."""
    random = np.random.default_rng(seed)
    return random.uniform(-1, 1, (rows, 4)).astype(np.float32), random.uniform(LOW, HIGH, (rows, 3)).astype(np.float32)


def write(folder, rows=12, form="parquet", pictures=True):
    """Write a folder of situations, each with a picture whose red is the row's number; return its arrays."""
    folder.mkdir(parents=True, exist_ok=True)
    observations, actions = arrays(rows)
    names = [f"pictures/{row}.png" for row in range(rows)] if pictures else None
    if pictures:
        (folder / "pictures").mkdir()
        for row, name in enumerate(names):
            Image.new("RGB", (16, 12), (row, 0, 0)).save(folder / name)
    columns = {f"action.{name}": actions[:, number] for number, name in enumerate(ENTRIES)}
    if form == "npz":
        more = {"picture": np.array(names)} if pictures else {}
        np.savez(folder / "situations.npz", observation=observations, action=actions, **more)
    elif form == "csv":
        lines = [",".join(["observation", *columns, *(["picture"] if pictures else [])])]
        for row in range(rows):
            own = [" ".join(f"{value:.9g}" for value in observations[row])]
            own += [f"{value:.9g}" for value in actions[row]] + ([names[row]] if pictures else [])
            lines.append(",".join(own))
        (folder / "situations.csv").write_text("\n".join(lines) + "\n")
    else:
        table = {"observation": list(observations), **columns, **({"picture": names} if pictures else {})}
        pq.write_table(pa.table(table), folder / "situations.parquet")
    return observations, actions


def plugin_module(name):
    """Import a file of LeRobot's plugin, which is not installed here."""
    folder = Path(__file__).parents[1] / "plugins/lerobot_processor_cuelearner/lerobot_processor_cuelearner"
    spec = importlib.util.spec_from_file_location(name, folder / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def said(space, actions, best, eps):
    """What a person says of actions who wants the best ones."""
    answers = jax.vmap(lambda action, best: relative_feedback(space, action, best, eps))
    return np.array(answers(jnp.asarray(actions), jnp.asarray(best, jnp.float32)))


def write_labels(folder, config, space, eps, rows):
    """Write a file of relative labels of a recording (obs, action, answer), as the page does; return its path."""
    folder.mkdir(parents=True, exist_ok=True)
    count, path = len(rows[0]), folder / "labels.parquet"
    of, labels = {"name": "logs", **to_json(config)}, Label(*rows, np.ones(count, bool))
    label_files.write_file(path, label_files.LabelFile(of, "relative", space, eps, np.zeros(count), labels), "more")
    return path


def write_lerobot(folder, lengths=(5, 7), fps=10, version="v3.0", names=True, video_fps=10):
    """Write a LeRobot dataset of the format v3.0, a camera's frames as bright as they are far; return its arrays.

    Two data files, one video file in which the episodes follow one another, as the format has it.
    """
    rows = sum(lengths)
    observations, actions = arrays(rows)
    told = {"names": {"motors": ["shoulder", "elbow", "wrist", "jaw"]}} if names else {"names": None}
    features = {
        "observation.state": {"dtype": "float32", "shape": [4], **told},
        "action": {"dtype": "float32", "shape": [3], "names": list(ENTRIES) if names else None},
        "observation.images.front": {
            "dtype": "video",
            "shape": [32, 48, 3],
            "names": ["height", "width", "channels"],
            "info": {"video.fps": fps},
        },
        **{name: {"dtype": "int64", "shape": [1], "names": None} for name in ("frame_index", "episode_index", "index")},
        "timestamp": {"dtype": "float32", "shape": [1], "names": None},
    }
    info = {"codebase_version": version, "fps": fps, "features": features, "total_episodes": len(lengths)}
    info |= {"total_frames": rows, "data_path": "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"}
    for place in ("meta/episodes/chunk-000", "data/chunk-000", "videos/observation.images.front/chunk-000"):
        (folder / place).mkdir(parents=True)
    (folder / "meta/info.json").write_text(json.dumps(info))
    starts = np.concatenate([[0], np.cumsum(lengths)])
    for episode, length in enumerate(lengths):
        own = slice(starts[episode], starts[episode + 1])
        table = {
            "observation.state": list(observations[own]),
            "action": list(actions[own]),
            "timestamp": np.arange(length, dtype=np.float32) / fps,
            "frame_index": np.arange(length),
            "episode_index": np.full(length, episode),
            "index": np.arange(rows)[own],
        }
        pq.write_table(pa.table(table), folder / f"data/chunk-000/file-{episode:03d}.parquet")
    key = "videos/observation.images.front"
    episodes = {
        "episode_index": list(range(len(lengths))),
        f"{key}/chunk_index": [0] * len(lengths),
        f"{key}/file_index": [0] * len(lengths),
        f"{key}/from_timestamp": [float(start) / fps for start in starts[:-1]],
        f"{key}/to_timestamp": [float(end) / fps for end in starts[1:]],
    }
    pq.write_table(pa.table(episodes), folder / "meta/episodes/chunk-000/file-000.parquet")
    with imageio.get_writer(folder / key / "chunk-000/file-000.mp4", fps=video_fps, macro_block_size=2) as video:
        for frame in range(rows * video_fps // fps):
            video.append_data(np.full((32, 48, 3), 20 * (frame * fps // video_fps), np.uint8))
    return observations, actions
