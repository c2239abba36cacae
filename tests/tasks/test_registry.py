"""Tasks by name: loaded when asked for, from packages and from files that the user names."""

import subprocess
import sys
from importlib.metadata import EntryPoint

import chex
import jax
import probes
import pytest

from cuelearner_jax.errors import UserError
from cuelearner_jax.run_config import RunConfig
from cuelearner_jax.tasks import registry

OWN = "from probes import make_task\nTASK = make_task('{name}')\nNUMBER = 3\n"


@pytest.fixture(autouse=True)
def apart(monkeypatch, tmp_path):
    """A folder to import from, and nothing of it left afterwards."""
    monkeypatch.setattr(registry, "_registered", {})
    monkeypatch.setattr(sys, "path", list(sys.path))
    monkeypatch.chdir(tmp_path)
    before = set(sys.modules)
    yield
    for name in set(sys.modules) - before:
        if name.startswith("own_"):
            del sys.modules[name]


def install(monkeypatch, folder, **tasks):
    """As if a package with these entry points were installed in a folder."""
    monkeypatch.syspath_prepend(folder)
    entries = [EntryPoint(name, value, registry.GROUP) for name, value in tasks.items()]
    monkeypatch.setattr(registry, "entry_points", lambda group: entries if group == registry.GROUP else [])


def loads(code):
    """What of the environments a new process loads to run some code."""
    code += "\nimport sys; print(sorted(name for name in sys.modules if name.startswith('cuelearner_envs.')))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    return done.stdout.splitlines()[-1]


def test_a_task_is_loaded_when_it_is_asked_for():
    found = loads("from cuelearner_jax.tasks import registry; registry.names(); registry.find('billiards')")
    assert "cuelearner_envs.billiards.environment" in found
    assert "navigation" not in found
    assert "anymal" not in found


@pytest.mark.parametrize("name", registry.BUILT_IN)
def test_the_packages_own_tasks_can_be_had(name):
    task = registry.find(name)
    assert task.name == name
    assert task.origin == ""
    assert all("on 2 cores" in preset.takes for preset in task.presets.values())
    if name not in registry.FAMILIES:  # which name one of theirs first
        assert registry.resolve(name) is task
        assert {"paper", "quickstart"} <= set(task.presets)
    assert all(isinstance(preset.config, RunConfig) for preset in task.presets.values())


REFUSED = [
    ("own_here:NUMBER", "own_here:NUMBER is of type int: a task is a cuelearner_jax.task.Task"),
    ("own_taken:TASK", "there is a task 'billiards' already: give this one another name"),
    ("billards", "unknown task 'billards', did you mean 'billiards'?"),
]


@pytest.mark.parametrize(("text", "says"), REFUSED, ids=[text for text, _ in REFUSED])
def test_what_names_no_task_is_refused_in_one_line(tmp_path, text, says):
    (tmp_path / "own_here.py").write_text(OWN.format(name="mine"))
    (tmp_path / "own_taken.py").write_text(OWN.format(name="billiards"))
    with pytest.raises(UserError) as refusal:
        registry.resolve(text)
    assert says in str(refusal.value)
    assert "\n" not in str(refusal.value)
    assert registry.names() == tuple(registry.BUILT_IN)


def test_an_installed_package_offers_tasks(tmp_path, monkeypatch):
    (tmp_path / "own_packed.py").write_text(OWN.format(name="packed"))
    install(monkeypatch, tmp_path, packed="own_packed:TASK", billiards="own_evil:TASK")
    assert registry.names() == (*registry.BUILT_IN, "packed")
    assert "own_packed" not in sys.modules  # known by name, and not loaded
    task = registry.find("packed")
    assert (task.name, task.origin) == ("packed", "")
    assert registry.resolve("own_packed:TASK") == task
    assert registry.find("billiards").teacher is not None  # the package's own
    with pytest.raises(UserError, match="there is a task 'packed' already"):
        registry.register(probes.make_task("packed"))


def test_what_policies_look_at_needs_no_worlds():
    """Navigation looks at an observation alone: the view sees what the environment sees."""
    task = registry.find("navigation")
    config = task.configure("rooms", worlds=1)
    env, view = task.environment(config), task.view(config)
    assert view.worlds is None
    assert view.observation == env.observation
    obs = jax.random.uniform(jax.random.key(0), (env.obs_size,))
    action = env.heuristic(obs)
    for looks in (lambda of: of.features(obs, action), lambda of: of.aims(obs), lambda of: of.heuristic(obs)):
        chex.assert_trees_all_equal(jax.jit(looks)(view), jax.jit(looks)(env))
    table = registry.find("billiards")
    easy = table.presets["quickstart"].config.task
    chex.assert_trees_all_equal(table.view(easy), table.environment(easy))
