"""Whole files and folders: a write that fails leaves nothing, two writers do not mix, a kill leaves the old or new."""

import os
import shutil
import threading
from pathlib import Path

import pytest

from cuelearner_jax.errors import UserError
from cuelearner_jax.storage import whole
from cuelearner_jax.storage.whole import replacing


class Killed(BaseException):
    """What is raised in the place of every change of the disk from a kill on."""


def check(folder):
    """Whatever holds a file `ours` may be replaced."""
    if whole.is_occupied(folder) and not (folder / "ours").exists():
        raise UserError(f"{folder} is not ours")


def write(folder, text, overwrite=True, meanwhile=lambda: None):
    with whole.place_of(folder, check, overwrite) as place, place() as new:
        if isinstance(text, BaseException):
            raise text
        (new / "ours").write_text(text)
        meanwhile()


def names(folder):
    return sorted(path.name for path in folder.iterdir())


@pytest.mark.parametrize("error", [OSError(28, "No space left on device"), KeyboardInterrupt()])
def test_nothing_is_left_of_a_write_that_fails(tmp_path, error):
    path, out = tmp_path / "l.csv", tmp_path / "out"
    path.write_text("before")
    with pytest.raises(type(error)), replacing(path) as file:  # noqa: PT012
        file.write("after")
        raise error
    with pytest.raises(type(error)):
        write(out, error)
    assert (names(tmp_path), path.read_text()) == (["l.csv"], "before")


def test_a_fresh_file_replaces_none(tmp_path):
    path = tmp_path / "l.csv"
    path.write_text("before")
    with pytest.raises(UserError, match="exists: give another --out"), replacing(path, fresh=True):
        pytest.fail("it was to be refused first")
    assert (names(tmp_path), path.read_text()) == (["l.csv"], "before")


def test_two_at_once_leave_one_whole_file(tmp_path):
    path = tmp_path / "l.csv"

    def second():
        with replacing(path) as file:
            file.write("second" * 1000)

    with replacing(path) as first:
        first.write("first")
        thread = threading.Thread(target=second)
        thread.start()
        thread.join()
        assert path.read_text() == "second" * 1000
    assert (names(tmp_path), path.read_text()) == (["l.csv"], "first")


def test_a_folder_appears_as_a_whole_and_nothing_else_stays(tmp_path):
    for text in ("one", "two"):
        write(tmp_path / "a" / "out", text)
        assert (tmp_path / "a" / "out" / "ours").read_text() == text
        assert names(tmp_path / "a") == ["out"]
    (tmp_path / "empty").mkdir()
    write(tmp_path / "empty", "three", overwrite=False)
    assert names(tmp_path / "empty") == ["ours"]


def test_a_second_writer_is_refused_while_the_first_works(tmp_path):
    (tmp_path / "link").symlink_to(tmp_path / "out")
    with whole.place_of(tmp_path / "out", check):
        for name in ("out", "link"):
            with pytest.raises(UserError, match=f"{name} is being written by another process"):
                write(tmp_path / name, "second")
    write(tmp_path / "link", "second")
    assert names(tmp_path) == ["link", "out"]


def test_a_kill_between_any_two_steps_leaves_the_old_or_the_new(tmp_path, monkeypatch):
    changing = [(os, "rename"), (shutil, "rmtree"), (Path, "mkdir"), (Path, "unlink")]
    steps, found = 0, set()
    while True:
        home, left = tmp_path / f"{steps}", [steps]
        out = home / "out"
        write(out, "old")

        def counted(function, left=left):
            def call(*arguments, **keywords):
                left[0] -= 1
                if left[0] < 0:
                    raise Killed
                return function(*arguments, **keywords)

            return call

        with monkeypatch.context() as patch:
            for owner, name in changing:
                patch.setattr(owner, name, counted(getattr(owner, name)))
            try:
                write(out, "new")
                whole_again = True
            except Killed:
                whole_again = False
        if whole_again:
            break
        with whole.place_of(out, lambda _: None):  # the next who writes there tidies up
            found.add((out / "ours").read_text())
        assert names(home) == ["out"]
        steps += 1
    assert steps >= 4
    assert found == {"old", "new"}
