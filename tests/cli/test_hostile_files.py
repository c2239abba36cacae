"""Files written to execute code: no string of any file that is read reaches an import, a pickle or a process."""

import json
import pickle
import shutil
import sys
import threading

import jax
import jax.numpy as jnp
import json_ways
import numpy as np
import probes
import pyarrow as pa
import pytest
import small_policies

import cuelearner_jax as cl
from cuelearner_jax import config as configuration
from cuelearner_jax import teachers
from cuelearner_jax.api.worlds import World
from cuelearner_jax.errors import UserError
from cuelearner_jax.export import runner
from cuelearner_jax.guides import registry as guidances
from cuelearner_jax.policies import Heuristic
from cuelearner_jax.runs.trained import PolicySource
from cuelearner_jax.storage import label_files, results
from cuelearner_jax.storage import table as tables
from cuelearner_jax.tasks import registry as tasks
from cuelearner_jax.teachers import LearnedTeacher, init_params

HOSTILE = "hostile:KIND"
CODE = """
from pathlib import Path
from cuelearner_jax.guides.baselines import NONE as KIND
Path(__file__).with_name("executed").touch()
"""
STARTING = ("subprocess.Popen", "os.system", "os.exec", "os.posix_spawn")
heard = []
armed = threading.Event()


def hear(event, arguments):
    """A hook of the interpreter; hooks cannot be taken away again, so this one only listens while it is armed."""
    if not armed.is_set():
        return
    if event == "pickle.find_class" or (event in STARTING and "hostile" in str(arguments)):
        heard.append(f"{event} {arguments[:2]}")


class Finder:
    """Takes note of every module of the attacker's that is looked for."""

    @staticmethod
    def find_spec(name, path=None, target=None):
        if name.partition(".")[0] == "hostile":
            heard.append(f"import {name}")


@pytest.fixture(scope="module")
def hook():
    sys.addaudithook(hear)


@pytest.fixture(autouse=True)
def listening(hook, tmp_path, monkeypatch):
    """In a folder with the attacker's module, which would be imported."""
    (tmp_path / "hostile.py").write_text(CODE)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [str(tmp_path), *sys.path])
    monkeypatch.setattr(sys, "meta_path", [Finder, *sys.meta_path])
    heard.clear()
    armed.set()
    yield
    armed.clear()
    sys.modules.pop("hostile", None)


def spoiled(values):
    """The values with one string after the other replaced by the attacker's; without their digest."""
    values.pop("digest", None)
    for way in json_ways.ways(values):
        if isinstance(json_ways.at(values, way), str):
            yield way, json_ways.changed(values, way, HOSTILE)


def reads(read, folder):
    """Whether a reader takes what it is given."""
    try:
        read(folder)
    except Exception:
        return False
    return True


def taken_by(path, read, seal=configuration.digest):
    """Gives a reader its JSON file with each string spoiled; returns the ways to those that it took."""
    whole = path.read_text()
    cases = list(spoiled(json.loads(whole)))
    assert cases
    taken = []
    for way, values in cases:
        path.write_text(json.dumps({**values, "digest": seal(values)}))
        if reads(read, path.parent):
            taken.append(way)
    path.write_text(whole)
    assert heard == []
    assert not path.parent.joinpath("executed").exists()
    return taken


def test_what_is_listened_to_is_heard(tmp_path):
    assert guidances.resolve(HOSTILE).name == "none"
    assert (tmp_path / "executed").exists()
    pickle.loads(pickle.dumps(shutil.which))
    assert heard[0] == "import hostile"
    assert heard[1].startswith("pickle.find_class")


def test_a_kind_that_a_run_names_is_never_imported(run_folder, refused, tmp_path):
    folder = shutil.copytree(run_folder, tmp_path / "run")
    probes.edit_json(folder / "config.json", lambda values: values["grid"].update(guidance=["none", HOSTILE]))
    for command in ("evaluate", "render", "export", "adapt", "label billiards"):
        asked = [*command.split(), folder, "--out", tmp_path / "new"]
        refused(asked, "error: ", folder)
    with pytest.raises(UserError):
        cl.load_policy(folder)
    with pytest.raises(UserError, match="unknown guidance 'hostile:KIND'"):
        guidances.find(HOSTILE)
    assert heard == []


@pytest.mark.long
def test_no_string_of_a_run_is_imported(run_folder, tmp_path):
    folder = shutil.copytree(run_folder, tmp_path / "run", ignore=shutil.ignore_patterns("relative"))
    probes.edit_json(folder / "config.json", lambda values: values["grid"].update(guidance=["none"]))
    read = lambda _: PolicySource.of_folder(folder, tasks.find).load()  # noqa: E731
    assert taken_by(folder / "config.json", read) == []  # its checkpoints are of another configuration
    newest = max((folder / "none" / "checkpoints").iterdir(), key=lambda path: int(path.name))
    files = [path for path in newest.rglob("*") if path.is_file() and path.read_bytes()[:1] == b"{"]
    assert len(files) > 3
    for path in files:
        values = json.loads(path.read_text())
        path.write_text(json.dumps(everywhere(values)))
        reads(read, folder)
        path.write_text(json.dumps(values))
    assert heard == []


def everywhere(values):
    """JSON values with the attacker's name in the place of every string but names."""
    if isinstance(values, dict):
        return {name: everywhere(value) for name, value in values.items()}
    if isinstance(values, list):
        return [everywhere(value) for value in values]
    return HOSTILE if isinstance(values, str) else values


def test_no_string_of_a_policy_folder_is_imported(tmp_path):
    small_policies.write(tmp_path / "policy")
    read = lambda folder: cl.load_policy(folder, task=small_policies.TASK)  # noqa: E731
    taken = taken_by(tmp_path / "policy" / "policy.json", read)
    told = {"of", "conventions", "commit", "versions", "hardware", "command", "observation", "judged", "arrays"}
    assert {way[0] for way in taken} <= told


def test_no_string_of_a_teacher_is_imported(tmp_path):
    params = init_params((8,), small_policies.ENV, jax.random.key(0))
    made = LearnedTeacher(small_policies.ENV, params, jnp.zeros(()), jnp.zeros(()), (8,), 8)
    about = {"config": {"layers": [8], "directions": 8}, "task": {"name": "window", "half_width_deg": 28.0}, "by": "me"}
    teachers.save(tmp_path / "teacher", made, about)

    def read(folder):
        teachers.world_of(folder, "window", probes.WindowConfig(), ())
        teachers.load(folder, small_policies.ENV, 0.0, 0.0)

    assert taken_by(tmp_path / "teacher" / "teacher.json", read) == [("by",)]


@pytest.mark.long
def test_no_string_of_an_exported_decision_is_imported(tmp_path):
    folder, read = tmp_path / "numpy", cl.load_exported
    world = World(small_policies.TASK, probes.WindowConfig())
    cl.export_policy(Heuristic(small_policies.ENV), folder, world, format="numpy")
    taken_by(folder / runner.CONTRACT, read, seal=runner.digest)
    with np.load(folder / "decision.npz") as whole:
        arrays = dict(whole)
    for _, graph in spoiled(json.loads(arrays["graph"].tobytes())):
        arrays["graph"] = np.frombuffer(json.dumps(graph).encode(), np.uint8)
        np.savez(folder / "decision.npz", **arrays)
        probes.edit_contract(folder)
        reads(read, folder)
    np.savez(folder / "decision.npz", **{**arrays, "pickled": np.array([shutil.which], object)})
    probes.edit_contract(folder)
    assert not reads(read, folder)
    assert heard == []


@pytest.mark.parametrize(("name", "schema"), [("results", results.SCHEMA), ("labels", label_files.SCHEMA)])
def test_no_string_of_a_table_is_imported(run_folder, tmp_path, name, schema):
    table = tables.read(run_folder / "relative" / f"{name}.parquet", schema)
    about = tables.about_of(table)
    words = [column for column in table.column_names if pa.types.is_string(table.schema.field(column).type)]
    for column in words:
        place = table.column_names.index(column)
        table = table.set_column(place, column, pa.array([HOSTILE] * table.num_rows))
    pickled = {
        "ARROW:extension:name": "arrow.py_extension_type",
        "ARROW:extension:metadata": pickle.dumps(shutil.which),
    }
    fields = [field.with_metadata(pickled) for field in table.schema]
    table = table.cast(pa.schema(fields, metadata=table.schema.metadata))
    tables.write(tmp_path / f"{name}.parquet", table, schema, everywhere(about) if about else None)
    for read in (results.read, label_files.read):
        reads(read, tmp_path / f"{name}.parquet")
    assert heard == []
