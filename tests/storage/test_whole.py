"""Whole files: nothing is left of a write that fails, and two writers do not mix."""

import csv
import os
import threading

import pytest

from cuelearner_jax.errors import UserError
from cuelearner_jax.storage.whole import replacing


def names(folder):
    return sorted(path.name for path in folder.iterdir())


@pytest.mark.parametrize("there", [False, True])
@pytest.mark.parametrize("error", [OSError(28, "No space left on device"), KeyboardInterrupt(), UserError("no")])
def test_nothing_is_left_of_a_write_that_fails(tmp_path, there, error):
    path = tmp_path / "l.csv"
    if there:
        path.write_text("before")

    def write():
        with replacing(path) as file:
            csv.writer(file).writerow(["a"])
            raise error

    with pytest.raises(type(error)):
        write()
    assert names(tmp_path) == ["l.csv"] * there
    assert not there or path.read_text() == "before"


def test_a_fresh_file_replaces_none(tmp_path):
    path = tmp_path / "l.csv"
    path.write_text("before")
    with pytest.raises(UserError, match="exists: give another --out"), replacing(path, fresh=True):
        pytest.fail("it was to be refused first")
    assert (names(tmp_path), path.read_text()) == (["l.csv"], "before")


def test_two_at_once_leave_one_whole_file(tmp_path):
    path = tmp_path / "l.csv"
    with replacing(path) as first:
        first.write("first")
        thread = threading.Thread(target=write_second, args=(path,))
        thread.start()
        thread.join()
        assert path.read_text() == "second" * 1000
    assert (names(tmp_path), path.read_text()) == (["l.csv"], "first")


def write_second(path):
    with replacing(path) as file:
        file.write("second" * 1000)


def test_the_file_is_on_the_disk_before_it_takes_its_place(tmp_path, monkeypatch):
    done = []
    monkeypatch.setattr(os, "fsync", lambda number, usual=os.fsync: (done.append("sync"), usual(number)))
    monkeypatch.setattr(os, "replace", lambda *pair, usual=os.replace: (done.append("replace"), usual(*pair)))
    with replacing(tmp_path / "l.csv") as file:
        file.write("whole")
    assert done == ["sync", "replace", "sync"]
