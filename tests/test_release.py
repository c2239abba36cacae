"""What a release promises of its own files: one version, declared dependencies, shipped agents found by name."""

import ast
import json
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


def test_packages_are_typed_and_import_declared_dependencies_and_extras_alone():
    wanted = [*PROJECT["dependencies"], *chain(*PROJECT["optional-dependencies"].values())]
    declared = {re.match(r"[\w.-]+", one)[0].lower() for one in wanted}
    imported = set()
    for folder in (ROOT / "cuelearner_jax", ROOT / "envs" / "cuelearner_envs"):
        assert (folder / "py.typed").exists()
        for file in folder.rglob("*.py"):
            for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
                if isinstance(node, ast.Import):
                    imported |= {alias.name.split(".")[0] for alias in node.names}
                elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
                    imported.add(node.module.split(".")[0])
    others = imported - set(sys.stdlib_module_names) - {"cuelearner_jax", "cuelearner_envs"} - FOREIGN
    assert sorted(others - {one for one in others if NAMED_OTHERWISE.get(one, one) in declared}) == []


def is_module(name):
    path = (ROOT / "envs" if name.startswith("cuelearner_envs") else ROOT) / name.replace(".", "/")
    return path.with_suffix(".py").exists() or (path / "__init__.py").exists()


def imports(path):
    """The package's modules that the Python code of a page, a notebook or a module imports."""
    text = path.read_text(encoding="utf-8")
    if path.suffix == ".ipynb":
        text = "\n".join("".join(cell["source"]) for cell in json.loads(text)["cells"] if cell["cell_type"] == "code")
    elif path.suffix == ".md":
        text = "\n".join(re.findall(r"^```python\n(.*?)^```", text, re.M | re.S))
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.ImportFrom) and str(node.module).startswith("cuelearner"):
            names = [f"{node.module}.{alias.name}" for alias in node.names]
            yield from (name if is_module(name) else node.module for name in names)
        elif isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names if alias.name.startswith("cuelearner"))


def test_pages_and_examples_import_public_modules_alone():
    page = (ROOT / "docs/reference/interfaces.md").read_text(encoding="utf-8")
    public = {"cuelearner_jax", "cuelearner_envs"}
    for title, table in re.findall(r"modules of `(\w+)` \|\n(.*?)\n\n", page, re.S):
        public |= {f"{title}.{name}" for name in re.findall(r"`([\w.]+)`", table)}
    assert [name for name in public if not is_module(name)] == []
    files = [ROOT / "README.md", *(ROOT / "docs").rglob("*.md"), *(ROOT / "examples").iterdir()]
    own = {file: {*imports(file)} for file in files if file.suffix in (".md", ".py", ".ipynb")}
    assert {file.name: names - public for file, names in own.items() if names - public} == {}


def test_each_task_of_its_own_has_a_shipped_agent():
    assert shipped.names() == ("shipped:arm", "shipped:billiards", "shipped:navigation")
    for name in shipped.names():
        described = formats.read("config", shipped.folder_of(name) / "config.json")
        assert f"shipped:{described['task']['name']}" == name
        assert described["task"]["name"] in registry.names()
