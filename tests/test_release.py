"""What a release promises of its own files: one version, declared dependencies, shipped agents found by name."""

import ast
import re
import sys
import tomllib
from itertools import chain
from pathlib import Path

import cuelearner_jax as cl
from cuelearner_jax.storage import formats
from cuelearner_jax.tasks import registry, shipped

ROOT = Path(__file__).resolve().parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
NAMED_OTHERWISE = {"gymnasium_robotics": "gymnasium-robotics", "mujoco_playground": "playground", "PIL": "pillow"}
NAMED_OTHERWISE |= {"orbax": "orbax-checkpoint", "tensorboardX": "tensorboardx"}
NAMED_OTHERWISE |= {"imageio_ffmpeg": "imageio-ffmpeg", "jaxlib": "jax", "starlette": "fastapi"}
FOREIGN = {"torch", "stable_baselines3"}  # given by the caller, never needed


def test_one_version_stands_everywhere():
    assert PROJECT["dynamic"] == ["version"]
    citation = (ROOT / "CITATION.cff").read_text(encoding="utf-8")
    assert re.search(r"^version: (.*)$", citation, re.M)[1] == cl.__version__
    date = re.search(r'^date-released: "(.*)"$', citation, re.M)[1]
    first = re.search(r"^## \[.*$", (ROOT / "CHANGELOG.md").read_text(encoding="utf-8"), re.M)[0]
    assert first == f"## [{cl.__version__}] - {date}"


def test_formats_of_files_are_1():
    assert set(formats.FORMATS.values()) == {1}


def test_every_import_is_of_a_declared_dependency_or_extra():
    wanted = [*PROJECT["dependencies"], *chain(*PROJECT["optional-dependencies"].values())]
    declared = {re.match(r"[\w.-]+", one)[0].lower() for one in wanted}
    imported = set()
    for folder in (ROOT / "cuelearner_jax", ROOT / "envs" / "cuelearner_envs"):
        for file in folder.rglob("*.py"):
            for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
                if isinstance(node, ast.Import):
                    imported |= {alias.name.split(".")[0] for alias in node.names}
                elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
                    imported.add(node.module.split(".")[0])
    others = imported - set(sys.stdlib_module_names) - {"cuelearner_jax", "cuelearner_envs"} - FOREIGN
    assert sorted(others - {one for one in others if NAMED_OTHERWISE.get(one, one) in declared}) == []


def test_each_task_of_its_own_has_a_shipped_agent():
    assert shipped.names() == ("shipped:arm", "shipped:billiards", "shipped:navigation")
    for name in shipped.names():
        described = formats.read("config", shipped.folder_of(name) / "config.json")
        assert f"shipped:{described['task']['name']}" == name
        assert described["task"]["name"] in registry.names()
