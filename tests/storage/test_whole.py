"""Whole files: nothing is left of what fails, what a kill left is used, and two writers do not mix."""

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


def test_folders_that_were_made_for_a_file_that_failed_are_taken_away(tmp_path):
    with pytest.raises(ValueError, match="no"), replacing(tmp_path / "a" / "b" / "l.csv", fresh=True):
        raise ValueError("no")
    assert names(tmp_path) == []
    with replacing(tmp_path / "a" / "b" / "l.csv", fresh=True) as file:
        file.write("whole")
    assert (tmp_path / "a" / "b" / "l.csv").read_text() == "whole"


def test_a_fresh_file_replaces_none(tmp_path):
    path = tmp_path / "l.csv"
    path.write_text("before")
    with pytest.raises(UserError, match="exists: give another --out"), replacing(path, fresh=True):
        pytest.fail("it was to be refused first")
    assert (names(tmp_path), path.read_text()) == (["l.csv"], "before")


def test_what_a_kill_left_is_used_and_gone(tmp_path):
    (tmp_path / "l.csv.tmp").write_text("half of a longer fi")
    with replacing(tmp_path / "l.csv") as file:
        file.write("whole")
    assert (names(tmp_path), (tmp_path / "l.csv").read_text()) == (["l.csv"], "whole")


def test_a_link_in_the_place_of_the_unfinished_file_is_not_followed(tmp_path):
    (tmp_path / "precious").write_text("mine")
    (tmp_path / "l.csv.tmp").symlink_to(tmp_path / "precious")
    with pytest.raises(OSError, match="symbolic links"), replacing(tmp_path / "l.csv"):
        pytest.fail("it was to be refused first")
    assert (tmp_path / "precious").read_text() == "mine"


@pytest.mark.parametrize("fresh", [False, True])
def test_two_at_once_leave_one_whole_file(tmp_path, fresh):
    path, inside, outcomes = tmp_path / "l.csv", threading.Event(), []

    def second():
        inside.wait()
        try:
            with replacing(path, fresh=fresh) as file:
                file.write("second" * 1000)
            outcomes.append("wrote")
        except UserError:
            outcomes.append("refused")

    other = threading.Thread(target=second)
    other.start()
    with replacing(path, fresh=fresh) as file:
        file.write("first")
        file.flush()
        inside.set()
        other.join(0.05)
        assert (tmp_path / "l.csv.tmp").read_text() == "first"  # the second waits
    other.join()
    assert (names(tmp_path), outcomes) == (["l.csv"], ["refused" if fresh else "wrote"])
    assert path.read_text() == ("first" if fresh else "second" * 1000)


def test_the_file_is_on_the_disk_before_it_takes_its_place(tmp_path, monkeypatch):
    done = []
    monkeypatch.setattr(os, "fsync", lambda number, usual=os.fsync: (done.append("sync"), usual(number)))
    monkeypatch.setattr(os, "replace", lambda *pair, usual=os.replace: (done.append("replace"), usual(*pair)))
    with replacing(tmp_path / "l.csv") as file:
        file.write("whole")
    assert done == ["sync", "replace", "sync"]
