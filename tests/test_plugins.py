"""Objects named as `package.module:NAME`: found, or refused in one line that says what to do."""

import sys

import pytest

from cuelearner_jax.errors import UserError
from cuelearner_jax.plugins import load


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """The current folder, in which modules can be written; what is imported from it is forgotten afterwards."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", list(sys.path))
    before = set(sys.modules)
    yield tmp_path
    for name in set(sys.modules) - before:
        if (getattr(sys.modules[name], "__file__", None) or "").startswith(str(tmp_path)):
            del sys.modules[name]


def test_an_object_of_a_module_in_the_current_folder_is_found(folder):
    (folder / "furniture_of_mine.py").write_text("OAK = {'legs': 4}\n")
    found = load("furniture_of_mine:OAK", dict, "a table")
    assert found == {"legs": 4}
    assert load("furniture_of_mine:OAK", dict, "a table") is found


@pytest.mark.parametrize("reference", ["module", ":NAME", "my-module:NAME", "a..b:NAME", "a:B.c", "./sub/mine.py:OAK"])
def test_what_is_no_reference_is_told_its_form(folder, reference):
    with pytest.raises(UserError, match=r"does not name a table: give package\.module:NAME"):
        load(reference, dict, "a table")


@pytest.mark.parametrize(
    ("text", "name", "message"),
    [
        ("1 / 0", "OAK", "module_of_mine fails to import .ZeroDivisionError: division by zero"),
        ("import nowhere", "OAK", "module_of_mine fails to import .ModuleNotFoundError: .*nowhere"),
        ("OAK_TABLE = {'legs': 4}", "OAK_TABEL", "module_of_mine has no 'OAK_TABEL', did you mean 'OAK_TABLE'"),
        ("OAK = 4", "OAK", "module_of_mine:OAK is of type int: a table is a builtins.dict"),
        (None, "OAK", "no module 'module_of_mine' for .*: run in the folder that holds it, or install it"),
    ],
)
def test_what_cannot_be_loaded_is_told_in_one_line(folder, text, name, message):
    if text:
        (folder / "module_of_mine.py").write_text(text)
    with pytest.raises(UserError, match=message) as refusal:
        load(f"module_of_mine:{name}", dict, "a table")
    assert "\n" not in str(refusal.value)
