"""Folders that appear as a whole: two at once, one made meanwhile, a kill between any two steps."""

import os
import shutil
import threading
from pathlib import Path

import pytest

from cuelearner_jax.errors import UserError
from cuelearner_jax.storage import whole


class Killed(BaseException):
    """What is raised in the place of every change of the disk from a kill on."""


def check(folder):
    """Whatever holds a file `ours` may be replaced."""
    if whole.is_used(folder) and not (folder / "ours").exists():
        raise UserError(f"{folder} is not ours")


def write(folder, text, overwrite=True, meanwhile=lambda: None):
    with whole.place_of(folder, check, overwrite) as place, place.writing() as new:
        if isinstance(text, Exception):
            raise text
        (new / "ours").write_text(text)
        meanwhile()


def names(folder):
    return sorted(path.name for path in folder.iterdir())


@pytest.fixture
def killed_at(monkeypatch):
    """Lets this process change the disk so often, then never again, not even to clean up, until it is revived."""
    changing = [(os, "rename"), (shutil, "rmtree"), (Path, "mkdir"), (Path, "unlink"), (Path, "rmdir")]
    left = [0]

    def counted(function):
        def call(*arguments, **keywords):
            left[0] -= 1
            if left[0] < 0:
                raise Killed
            return function(*arguments, **keywords)

        return call

    def kill(count):
        left[0] = count
        for owner, name in changing:
            monkeypatch.setattr(owner, name, counted(getattr(owner, name)))
        return monkeypatch.undo

    return kill


def test_a_folder_appears_as_a_whole_and_nothing_else_stays(tmp_path):
    write(tmp_path / "a" / "b" / "out", "one")
    assert names(tmp_path / "a" / "b") == ["out"]
    write(tmp_path / "a" / "b" / "out", "two")
    assert (tmp_path / "a" / "b" / "out" / "ours").read_text() == "two"
    assert names(tmp_path / "a" / "b") == ["out"]
    (tmp_path / "empty").mkdir()
    write(tmp_path / "empty", "three", overwrite=False)
    assert names(tmp_path / "empty") == ["ours"]


def test_of_what_fails_nothing_stays(tmp_path):
    with pytest.raises(OSError, match="full"):
        write(tmp_path / "out", OSError("full"))
    assert names(tmp_path) == []


def test_a_second_writer_is_refused_while_the_first_works(tmp_path):
    with whole.place_of(tmp_path / "out", check):
        with pytest.raises(UserError, match="out is being written by another process"):
            write(tmp_path / "out", "second")
        (tmp_path / "link").symlink_to(tmp_path / "out")
        with pytest.raises(UserError, match="link is being written by another process"):
            write(tmp_path / "link", "second")
    write(tmp_path / "link", "second")
    assert names(tmp_path) == ["link", "out"]


def test_of_many_writers_one_works_at_a_time(tmp_path):
    inside, most, done = [], [], []

    def work():
        while len(done) < 60:
            try:
                with whole.place_of(tmp_path / "out", check, overwrite=True):
                    inside.append(1)
                    most.append(len(inside))
                    inside.pop()
                done.append(1)
            except UserError as error:
                assert "is being written" in str(error)

    threads = [threading.Thread(target=work) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(done) >= 60
    assert set(most) == {1}
    assert names(tmp_path) == []


@pytest.mark.parametrize(("made", "overwrite"), [("theirs", False), ("theirs", True), ("ours", False)])
def test_what_was_made_meanwhile_stays(tmp_path, made, overwrite):
    """Whatever it is, and even if it could be replaced had anyone asked for that."""

    def meanwhile():
        (tmp_path / "out").mkdir()
        (tmp_path / "out" / made).write_text("theirs")

    with pytest.raises(UserError, match=r"is not ours|cannot be put in place .*, nothing was changed"):
        write(tmp_path / "out", "mine", overwrite, meanwhile)
    assert (tmp_path / "out" / made).read_text() == "theirs"
    assert names(tmp_path) == ["out"]


def test_a_folder_that_cannot_come_leaves_the_old_one(tmp_path, monkeypatch):
    write(tmp_path / "out", "old")
    rename = os.rename

    def refusing(source, target):
        if Path(source).name.endswith(".new"):
            raise OSError(5, "Input/output error", str(target))
        rename(source, target)

    monkeypatch.setattr(os, "rename", refusing)
    with pytest.raises(UserError, match="Input/output"):
        write(tmp_path / "out", "new")
    assert (tmp_path / "out" / "ours").read_text() == "old"
    assert names(tmp_path) == ["out"]


@pytest.mark.parametrize("before", [True, False])
def test_a_kill_between_any_two_steps_leaves_the_old_or_the_new(tmp_path, killed_at, before):
    steps, found = 0, set()
    while True:
        home = tmp_path / f"{steps}"
        out = home / "out"
        if before:
            write(out, "old")
        else:
            home.mkdir()
        revive = killed_at(steps)
        try:
            write(out, "new")
            whole_again = True
        except Killed:
            whole_again = False
        revive()
        if whole_again:
            break
        if not out.exists() and before:  # the old one stands aside, and the next who asks puts it back
            assert (home / ".out.old" / "ours").read_text() == "old"
        with whole.place_of(out, lambda _: None):
            found.add((out / "ours").read_text() if out.exists() else None)
        assert set(names(home)) <= {"out"}
        write(out, "third")
        assert names(home) == ["out"]
        assert names(out) == ["ours"]
        steps += 1
    assert steps >= 4
    assert found == ({"old", "new"} if before else {None, "new"})
