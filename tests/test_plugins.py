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


def refused(reference, message, kind=dict):
    with pytest.raises(UserError, match=message) as refusal:
        load(reference, kind, "a table")
    assert "\n" not in str(refusal.value)


def test_an_object_of_a_module_in_the_current_folder_is_found(folder):
    (folder / "furniture_of_mine.py").write_text("OAK = {'legs': 4}\n")
    found = load("furniture_of_mine:OAK", dict, "a table")
    assert found == {"legs": 4}
    assert load("furniture_of_mine:OAK", dict, "a table") is found


@pytest.mark.parametrize("reference", ["module", ":NAME", "my-module:NAME", "a..b:NAME", "a:B.c", "./sub/mine.py:OAK"])
def test_what_is_no_reference_is_told_its_form(folder, reference):
    refused(reference, "does not name a table: give package.module:NAME")


def test_a_missing_module_is_to_be_installed_or_run_beside(folder):
    refused(
        "nowhere_to_be_found:OAK",
        "no module 'nowhere_to_be_found' for .*: run in the folder that holds it, or install it",
    )
    refused("nowhere_to_be_found.shop:OAK", "no module 'nowhere_to_be_found'")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("1 / 0\n", "ZeroDivisionError: division by zero"),
        ("import nowhere_to_be_found\n", "ModuleNotFoundError: .*nowhere_to_be_found"),
    ],
)
def test_a_module_that_fails_is_told_in_one_line(folder, text, message):
    (folder / "broken_module.py").write_text(text)
    refused("broken_module:OAK", f"broken_module fails to import .{message}")


def test_a_missing_name_is_told_with_the_nearest_that_would_do(folder):
    (folder / "near_module.py").write_text("OAK_TABLE = {'legs': 4}\nOAK_LEAF = 3\n")
    refused("near_module:OAK_TABEL", "near_module has no 'OAK_TABEL', did you mean 'OAK_TABLE'")
    refused("near_module:OAK_LEAFS", "has no 'OAK_LEAFS', nor a table", kind=frozenset)


def test_an_object_of_another_kind_is_refused(folder):
    (folder / "other_module.py").write_text("OAK = 4\n")
    refused("other_module:OAK", "other_module:OAK is of type int: a table is a builtins.dict")
