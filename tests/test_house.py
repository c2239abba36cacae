"""The order of the house: what may import what, how much stands in the hall, that everything public is described."""

import ast
import re
from functools import cache
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
METHOD, TASKS = "cuelearner_jax", "cuelearner_envs"

# Bottom row first: a module imports from rows below its own and, within its row, from its own package.
ROWS = [
    ["errors", "signals", "devices"],
    ["user_code"],
    ["types", "spaces", "plugins"],
    ["environment", "pictures"],
    ["config", "terminal"],
    ["storage"],
    ["agents"],
    ["feedback"],
    ["guides"],
    ["arbiters"],
    ["run_config"],
    ["task"],
    ["policies"],
    ["asking", "evaluate"],
    ["reading"],
    ["export"],
    ["loop"],
    ["adaptation"],
    ["teachers"],
    ["runs"],
    ["studies"],
    ["report"],
    ["labelling"],
    ["bridges"],
    ["tasks"],
    ["testing"],
    ["api"],
    ["cli"],
]
ROW = {room: number for number, row in enumerate(ROWS) for room in row}
FOR_TASKS = {"config", "errors", "types", "spaces", "environment", "pictures", "devices"}  # what a task may know
# Of guidance; "heuristic" names a member and a policy too.
KINDS = {"relative", "intent", "demonstration", "scalar", "preference", "dcoach", "bdcoach", "clic"}


@cache
def tree(file):
    return ast.parse(file.read_text())


def modules():
    """Name -> file of every module of both packages."""
    found = {}
    for folder in (ROOT / METHOD, ROOT / "envs" / TASKS):
        for file in folder.rglob("*.py"):
            parts = file.relative_to(folder.parent).with_suffix("").parts
            found[".".join(parts[:-1] if parts[-1] == "__init__" else parts)] = file
    return found


MODULES = modules()


def room(module):
    """The package or module directly in `cuelearner_jax` that a module of it belongs to."""
    return module.split(".")[1] if "." in module else ""


def imports(module):
    """The modules of both packages that one imports, anywhere in its file; `__init__` may import for type checkers."""
    file = MODULES[module]
    package = module if file.name == "__init__.py" else module.rpartition(".")[0]
    skipped = {
        node
        for block in ast.walk(tree(file))
        if isinstance(block, ast.If) and ast.unparse(block.test).endswith("TYPE_CHECKING") and package == module
        for node in ast.walk(block)
    }
    found = set()
    for node in ast.walk(tree(file)):
        if node in skipped:
            continue
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            above = package.split(".")[: len(package.split(".")) - node.level + 1] if node.level else []
            base = ".".join([*above, *([node.module] if node.module else [])])
            names = [f"{base}.{alias.name}" for alias in node.names]
        else:
            continue
        found |= {name if name in MODULES else name.rpartition(".")[0] for name in names}
    return found & MODULES.keys() - {module}


def test_every_module_of_the_method_has_a_row():
    assert sorted({room(module) for module in MODULES if module.startswith(METHOD)} - {"", *ROW}) == [], "give it a row"


def test_imports_point_down():
    wrong = []
    for module in MODULES:
        if not module.startswith(METHOD) or module == METHOD:  # the package itself shows what lies in its rooms
            continue
        for other in imports(module):
            if other.startswith(TASKS):
                allowed = room(module) == "tasks"
            else:
                mine, its = room(module), room(other)
                allowed = mine == its or other == METHOD or ROW.get(its, len(ROWS)) < ROW.get(mine, -1)
            if not allowed:
                wrong.append(f"{module} imports {other}")
    assert sorted(wrong) == []


def test_tasks_know_only_the_bottom_rows():
    wrong = [
        f"{module} imports {other}"
        for module in MODULES
        if module.startswith(TASKS)
        for other in imports(module)
        if other.startswith(METHOD) and room(other) not in FOR_TASKS
    ]
    assert sorted(wrong) == []


def test_no_module_imports_itself_in_a_circle():
    graph = {module: imports(module) for module in MODULES}
    while free := [module for module, needs in graph.items() if not needs & graph.keys()]:
        for module in free:
            del graph[module]
    assert {module: sorted(needs & graph.keys()) for module, needs in graph.items()} == {}


def test_few_modules_stand_directly_in_the_package():
    assert len(list((ROOT / METHOD).glob("*.py"))) <= 18


def undocumented(node, name):
    """Names of the public things in a module or class, itself included, that have no docstring."""
    if ast.get_docstring(node) is None:
        yield name
    if isinstance(node, ast.Module | ast.ClassDef):
        for child in node.body:
            if isinstance(child, ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef) and child.name[0] != "_":
                yield from undocumented(child, f"{name}.{child.name}")


@pytest.mark.parametrize("package", [METHOD, TASKS])
def test_everything_public_has_a_docstring(package):
    files = {module: file for module, file in MODULES.items() if module.split(".")[0] == package}
    assert [name for module, file in files.items() for name in undocumented(tree(file), module)] == []


def test_no_kind_of_guidance_is_named_outside_its_room():
    named = []
    for module, file in MODULES.items():
        # What files of earlier formats hold is called as it was then.
        if (
            room(module) in ("guides", "feedback", "tasks")
            or module.endswith("storage.formats")
            or not module.startswith(METHOD)
        ):
            continue
        nodes = list(ast.walk(tree(file)))
        otherwise = {node.value for node in nodes if isinstance(node, ast.Expr)}  # docstrings
        named += [
            f"{module}:{node.lineno}: {node.value!r}"
            for node in nodes
            if isinstance(node, ast.Constant) and node.value in KINDS and node not in otherwise
        ]
    assert named == []


PARTICIPLE = re.compile(  # besides `left`, the direction, and `done`, an episode's flag; `is_...` is a boolean
    r"(?!is_)(\w*_)?(found|told|given|asked|known|kept|seen|made|taken|shown|drawn|written|chosen|met|used|named|changed|"
    r"moved|said|learned|trained|played|judged|wanted)",
    re.IGNORECASE,
)
PUBLIC = {"api.adaptation": {"used", "judged"}, "api.policies": {"trained"}, "reading.result": {"used", "changed"}}
STORED = {"labelling.session": {"said"}, "reading.policy": {"known"}, "asking": {"asked"}, "guides.dcoach": {"learned"}}
OPTIONS = {"billiards.table": {"speed_kept"}}


def test_no_name_is_a_participle():
    wrong = []
    for module, file in MODULES.items():
        allowed = (PUBLIC | STORED | OPTIONS).get(module.partition(".")[2], ())
        for node in ast.walk(tree(file)):
            is_name = isinstance(node, ast.arg | ast.FunctionDef | ast.ClassDef | ast.alias)
            name = (getattr(node, "arg", None) or node.name) if is_name else getattr(node, "id", "")
            if PARTICIPLE.fullmatch(name) and name not in allowed:
                wrong.append(f"{module}:{node.lineno} {name}")
    assert wrong == []


@pytest.mark.parametrize(
    ("folders", "most"),
    [(["cuelearner_jax"], 26_208), (["envs"], 6_350), (["tests"], 20_245), (["experiments", "benchmarks"], 5_890)],
    ids=["package", "envs", "tests", "experiments"],
)
def test_the_house_does_not_grow(folders, most):
    files = [file for folder in folders for file in (ROOT / folder).rglob("*.py")]
    assert sum(len(file.read_text(encoding="utf-8").splitlines()) for file in files) <= most
