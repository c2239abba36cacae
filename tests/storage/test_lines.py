"""Sealed lines: nothing of them is changed, lost or added without a word, and a full disk leaves them as they were."""

import errno
import os

import numpy as np
import pytest

from cuelearner_jax.errors import UserError
from cuelearner_jax.storage import lines

ROWS = [{"about": {"lake": "Como"}}, {"fish": "pike"}, {"fish": "eel"}]


@pytest.fixture
def path(tmp_path):
    return tmp_path / "catches.jsonl"


@pytest.fixture
def whole(path):
    """The bytes of a file with `ROWS`, the last of them appended."""
    writer = lines.Writer(path, ROWS[:2])
    writer.append(ROWS[2:])
    writer.close()
    return path.read_bytes()


def outcome(path, capsys):
    """What is read, and whether standard error is told of a missing end; None: it is refused."""
    lines._tell.cache_clear()
    capsys.readouterr()
    try:
        found = lines.read(path)
    except lines.Damaged:
        return None, False
    told = capsys.readouterr().err
    assert told.count("\n") <= 1
    return found.rows, "lacks its closing line" in told


def test_what_was_written_is_read(whole, path, capsys):
    assert outcome(path, capsys) == (ROWS, False)
    assert lines.read(path).is_closed
    assert whole.endswith(b"\n")
    assert whole.count(b'{"end": ') == 1


def test_a_cut_at_any_byte_is_told_and_keeps_every_whole_line(whole, path, capsys):
    ends = [place for place, byte in enumerate(whole) if byte == ord("\n")][:3]
    for cut in range(len(whole)):
        path.write_bytes(whole[:cut])
        kept = sum(end <= cut for end in ends)  # a line without its newline is whole too
        assert outcome(path, capsys) == (ROWS[:kept], True)


def test_no_changed_bit_loses_a_line_without_a_word(whole, path, capsys):
    newline = 8 * (len(whole) - 1)  # the last one, behind which nothing stands
    chosen = [*np.random.default_rng(0).integers(0, newline, 200).tolist(), *range(newline, newline + 8)]
    for bit in chosen:
        spoilt = bytearray(whole)
        spoilt[bit // 8] ^= 1 << bit % 8
        path.write_bytes(spoilt)
        rows, told = outcome(path, capsys)
        assert (rows, told) == ((None, False) if bit < newline else (ROWS, True))


@pytest.mark.parametrize("extra", [b"\n", b"x", b"{}\n", b'{"fish": "carp"}\n'])
def test_what_follows_the_closing_line_is_noticed(whole, path, extra, capsys):
    path.write_bytes(whole + extra)
    rows, told = outcome(path, capsys)
    assert rows is None or told


def test_another_closing_line_is_refused(whole, path, tmp_path):
    other = lines.Writer(tmp_path / "other", ROWS[:2])
    other.close()
    closing = (tmp_path / "other").read_bytes().splitlines(keepends=True)[-1]
    path.write_bytes(b"".join(whole.splitlines(keepends=True)[:3]) + closing)
    with pytest.raises(lines.Damaged, match="line 4"):
        lines.read(path)


@pytest.mark.parametrize("taken", [0, 20])
def test_a_full_disk_leaves_what_was_there(whole, path, monkeypatch, taken):
    writer = lines.Writer(path, ROWS)
    usual, refusals = os.pwrite, [True]

    def full(number, content, at):
        if not refusals:
            return usual(number, content, at)
        if taken:
            usual(number, content[:taken], at)
        refusals.pop()
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(os, "pwrite", full)
    with pytest.raises(OSError, match="No space"):
        writer.append([{"fish": "carp"}])
    assert path.read_bytes() == whole
    writer.append([{"fish": "perch"}])
    writer.close()
    assert lines.read(path).rows == [*ROWS, {"fish": "perch"}]


def test_a_file_larger_than_memory_is_refused_before_it_is_read(path):
    with path.open("wb") as file:
        file.truncate(1 << 42)  # no block of it is on the disk
    with pytest.raises(UserError, match=r"has 4,398,046,511,104 bytes, which needs .* GB of memory, .* are free"):
        lines.read(path)


def test_text_of_a_path_does_nothing_to_a_terminal(tmp_path, capsys):
    place = tmp_path / "\x1b[31mred"
    place.write_bytes(b"")
    assert lines.read(place).rows == []
    assert "\x1b" not in capsys.readouterr().err
