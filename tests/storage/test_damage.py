"""Finished files that were emptied, cut, changed by a bit or exchanged are refused in one line; no file runs code."""

import contextlib
import json
import sys

import jax
import jax.numpy as jnp
import numpy as np
import probes
import pytest
import small_policies
from probes import config, make_task

import cuelearner_jax as cl
from cuelearner_jax import config as configuration
from cuelearner_jax import teachers
from cuelearner_jax.errors import UserError
from cuelearner_jax.guides import registry as guidances
from cuelearner_jax.policies import Heuristic
from cuelearner_jax.runs import grid
from cuelearner_jax.spaces import DIRECTIONS
from cuelearner_jax.storage import formats, label_files, results
from cuelearner_jax.storage.checkpoint import Checkpoints
from cuelearner_jax.storage.table import TableWriter, finish
from cuelearner_jax.teachers import LearnedTeacher, init_params

pytestmark = pytest.mark.usefixtures("garbage_of_its_own")
ANGLES = np.linspace(0.0, 6.0, 12)
SEEN = np.stack([np.cos(ANGLES), np.sin(ANGLES)], -1).astype(np.float32)
ARRAYS = {"weights": np.arange(400, dtype=np.float32), "flags": np.array([True, False])}
CONSTANTS = {"run": "a", "task": "one_ball", "guidance": "relative", "config_hash": "0f", "split": "validation"}


def export(folder):
    world = cl.World(small_policies.TASK, probes.WindowConfig())
    cl.export_policy(Heuristic(small_policies.ENV), folder, world, "numpy")


def teach(folder):
    params = init_params((8,), small_policies.ENV, jax.random.key(0))
    teacher = LearnedTeacher(small_policies.ENV, params, jnp.zeros(()), jnp.zeros(()), (8,), 8)
    about = {"config": {"layers": [8], "directions": 8}, "task": {"name": "window", "half_width_deg": 28.0}}
    teachers.save(folder, teacher, about)


def read_teacher(folder):
    teachers.world_of(folder, "window", probes.WindowConfig(), ())
    return teachers.load(folder, small_policies.ENV, 0.0, 0.0).params


def tabulate(folder):
    with TableWriter(folder, results.SCHEMA, CONSTANTS) as writer:
        writer.append(step=np.arange(50), seed=3, labels=0, reward=np.linspace(0, 1, 50))
    finish(folder, results.SCHEMA)


def label(folder):
    labels = probes.label_set(np.ones((1, 9, 3)), np.ones((1, 9, 2)), np.ones((1, 9, 1)), np.ones((1, 9), bool))
    label_files.write(folder / label_files.PARQUET, {"name": "w"}, "relative", DIRECTIONS, 20.0, np.array([4]), labels)


def describe(folder):
    described = grid.describe(make_task(), config(), grid.Grid(("none", "relative"), (0,), (10,)), "validation")
    formats.write("config", folder / "config.json", described)


def read_description(folder):
    _, found, whole = grid.load(folder, small_policies.find)
    return [guidances.find(kind).name for kind in whole.guidance] and found.scalars


def save(folder):
    with Checkpoints(folder) as saved:
        saved.save(5, {"policy": ARRAYS})


def restore(folder):
    with Checkpoints(folder, read_only=True) as saved:
        return saved.restore({"policy": ARRAYS})


KINDS = {
    "policy": (small_policies.write, lambda folder: cl.load_policy(folder, task=small_policies.TASK)(SEEN)),
    "export": (export, lambda folder: cl.load_exported(folder)(SEEN)),
    "teacher": (teach, read_teacher),
    "results": (tabulate, lambda folder: results.read(folder)["reward"].to_numpy()),
    "labels": (label, lambda folder: label_files.read(folder).labels),
    "run": (describe, read_description),
    "checkpoint": (save, restore),
}
DAMAGES = {
    "emptied": lambda content, place: b"",
    "halved": lambda content, place: content[: len(content) // 2],
    "flipped": lambda content, place: bytes(byte ^ (at == place % len(content)) for at, byte in enumerate(content)),
}
MOST = 3  # files of one kind of folder


@pytest.fixture(scope="module", params=KINDS)
def written(request, tmp_path_factory):
    """A folder of each kind, and its reader."""
    write, read = KINDS[request.param]
    folder = tmp_path_factory.mktemp("damage") / "folder"
    if request.param in ("results", "labels", "run", "checkpoint"):
        folder.mkdir()
    write(folder)
    return folder, read


def leaves(values):
    return [np.asarray(leaf) for leaf in jax.tree.leaves(values)]


def test_damage_is_refused_in_one_line_or_changes_nothing(written):
    folder, read = written
    expected, refusals, random = leaves(read(folder)), 0, np.random.default_rng(0)
    files = [path for path in folder.rglob("*") if path.is_file() and path.stat().st_size]
    for path in sorted(files, key=lambda path: (-path.stat().st_size, path))[:MOST]:
        whole = path.read_bytes()
        for damage in DAMAGES.values():
            path.write_bytes(damage(whole, int(random.integers(2**31))))
            try:
                found = leaves(read(folder))
            except UserError as error:
                assert "\n" not in str(error)
                refusals += 1
            else:
                assert all(np.array_equal(*pair) for pair in zip(found, expected, strict=True)), path
            path.write_bytes(whole)
    assert refusals > 0


# Files written to run code: no string of a file that is read is imported.

HOSTILE = "hostile_module:KIND"


def strings(values):
    """Yield (container, name) of every string in nested JSON values."""
    for name, value in values.items() if isinstance(values, dict) else enumerate(values):
        if isinstance(value, str):
            yield values, name
        elif isinstance(value, dict | list):
            yield from strings(value)


@pytest.mark.parametrize(
    ("kind", "file"), [("policy", "policy.json"), ("teacher", "teacher.json"), ("run", "config.json")]
)
def test_no_string_of_a_description_is_imported(kind, file, tmp_path, monkeypatch):
    (tmp_path / "hostile_module.py").write_text("from cuelearner_jax.guides.base import NoGuide as KIND\n")
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    write, read = KINDS[kind]
    folder = tmp_path / "folder"
    if kind == "run":
        folder.mkdir()
    write(folder)
    values = json.loads((folder / file).read_text())
    values.pop("digest")
    for container, name in list(strings(values)):
        before, container[name] = container[name], HOSTILE
        (folder / file).write_text(json.dumps({**values, "digest": configuration.digest(values)}))
        with contextlib.suppress(Exception):
            read(folder)
        container[name] = before
    assert "hostile_module" not in sys.modules
    assert guidances.resolve(HOSTILE).name == "none"  # the user may name it
    del sys.modules["hostile_module"]
