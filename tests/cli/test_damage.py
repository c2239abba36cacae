"""Finished files that were emptied, cut or changed by a bit are refused in one line, or give what was written."""

import shutil

import jax
import jax.numpy as jnp
import numpy as np
import probes
import pytest
import small_policies

import cuelearner_jax as cl
from cuelearner_jax import teachers
from cuelearner_jax.errors import UserError
from cuelearner_jax.policies import Heuristic
from cuelearner_jax.runs.trained import PolicySource
from cuelearner_jax.storage import label_files, results
from cuelearner_jax.tasks import registry as tasks
from cuelearner_jax.teachers import LearnedTeacher, init_params

ANGLES = np.linspace(0.0, 6.0, 12)
SEEN = np.stack([np.cos(ANGLES), np.sin(ANGLES)], -1).astype(np.float32)


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


KINDS = {
    "policy": (small_policies.write, lambda folder: cl.load_policy(folder, task=small_policies.TASK)(SEEN)),
    "export": (export, lambda folder: cl.load_exported(folder)(SEEN)),
    "teacher": (teach, read_teacher),
}
DAMAGES = {
    "emptied": lambda content, place: b"",
    "halved": lambda content, place: content[: len(content) // 2],
    "flipped": lambda content, place: bytes(byte ^ (at == place % len(content)) for at, byte in enumerate(content)),
}
MOST = 6  # files of one kind of folder


def leaves(values):
    return [np.asarray(leaf) for leaf in jax.tree.leaves(values)]


def check(folder, files, read):
    """Damage one file after the other, in each way."""
    expected, refusals = leaves(read(folder)), 0
    places = np.random.default_rng(0).integers(0, 2**31, len(files) * len(DAMAGES)).tolist()
    for path in files:
        whole = path.read_bytes()
        for damage in DAMAGES.values() if whole else ():
            path.write_bytes(damage(whole, places.pop()))
            try:
                found = leaves(read(folder))
            except UserError as error:
                assert "\n" not in str(error)
                refusals += 1
            else:
                assert all(np.array_equal(*pair) for pair in zip(found, expected, strict=True)), path
            path.write_bytes(whole)
    assert refusals > 0


def largest(folder, pattern="*"):
    files = [path for path in folder.rglob(pattern) if path.is_file()]
    return sorted(files, key=lambda path: (-path.stat().st_size, path))[:MOST]


@pytest.mark.parametrize("kind", KINDS)
def test_damage_of_a_folder(kind, tmp_path):
    write, read = KINDS[kind]
    write(tmp_path / "folder")
    check(tmp_path / "folder", largest(tmp_path / "folder"), read)


@pytest.mark.parametrize(
    ("pattern", "read"),
    [
        ("results.parquet", lambda folder: results.read(folder).to_pydict()),
        ("guide.parquet", lambda folder: results.read_guides([folder]).to_pydict()),
        ("labels.parquet", lambda folder: label_files.read(folder / "relative").labels),
        ("config.json", lambda folder: PolicySource.of_folder(folder, tasks.find).load()[0].policies),
        pytest.param(
            "policy/**/*",
            lambda folder: PolicySource.of_folder(folder, tasks.find).load()[0].policies,
            marks=pytest.mark.long,
        ),
    ],
)
def test_damage_of_a_run(run_folder, tmp_path, pattern, read):
    folder = shutil.copytree(run_folder, tmp_path / "run")
    check(folder, largest(folder, pattern), read)
