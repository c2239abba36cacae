"""The folder of a run: claim, check, resume and overwrite it.

Folder of a run:

    config.json                  everything that determines the results
    .lock                        held by the process that writes here
    <guidance>/checkpoints/      the newest training states
    <guidance>/labels.parquet    the teacher's answers
    <guidance>/results.jsonl     one row per seed and evaluation; results.parquet once done
    <guidance>/guide.jsonl       each guide's own performance while labels are collected; guide.parquet once done
"""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from cuelearner_jax.errors import UserError
from cuelearner_jax.storage import formats
from cuelearner_jax.storage.whole import hold

CONFIG = "config.json"
LOCK = ".lock"  # held by the process that writes in a run's folder, which it names; stays on disk


def in_use(out: Path) -> bool:
    """Whether `out` holds anything but the lock of a process that is about to write there."""
    if not out.is_dir():
        return out.exists()
    # A process that was killed before it wrote config.json leaves parts of the file.
    return any(entry.name != LOCK and not entry.name.startswith(f".{CONFIG}.") for entry in out.iterdir())


def check_folder(out: Path, contents: dict[str, Any], resume: bool, overwrite: bool) -> None:
    """Raise UserError unless `out` may be resumed, overwritten or begun with `contents` as its config.json."""
    if resume and overwrite:
        raise UserError("--resume continues a run and --overwrite deletes it: give one of them")
    is_filled, ours = in_use(out), (out / CONFIG).is_file()
    if resume:
        if not ours:
            raise UserError(f"nothing to resume in {out}: give the --out of an interrupted run, or leave out --resume")
        if differing := sorted(differences(formats.read("config", out / CONFIG), contents)):
            names = ", ".join(name.removeprefix("grid.") for name in differing[:4])
            raise UserError(f"{out} was run with other values of {names}: give the same options, or another --out")
    elif is_filled and not overwrite:
        raise UserError(f"{out} is not empty: give --resume to go on, --overwrite to delete it, or another --out")
    elif is_filled and not ours:
        raise UserError(f"{out} is not a run folder, so --overwrite will not delete it: give another --out")


def differences(before: dict[str, Any], now: dict[str, Any], prefix: str = "") -> Iterator[str]:
    """Yield the names, as `part.field`, in which two descriptions of runs differ; `prefix`: the part, with a dot."""
    for name in before | now:
        old, new = before.get(name), now.get(name)
        if isinstance(old, dict) and isinstance(new, dict):
            yield from differences(old, new, f"{prefix}{name}.")
        elif old != new and f"{prefix}{name}" != "task.from":  # where a task's code lies has no effect on the run
            yield prefix + name


@contextmanager
def claimed(out: Path) -> Iterator[None]:
    """Make a run's folder and claim it for this process; the claim ends however the process ends.

    The folder may have changed before it was claimed, so check it again afterwards.
    """
    out.mkdir(parents=True, exist_ok=True)
    with hold(out / LOCK, out):
        yield


def prepare_folder(out: Path, contents: dict[str, Any], clean: bool) -> None:
    """Make the folder and write config.json where missing; with `clean`, delete everything else in the folder.

    Links are removed without what they lead to. config.json is deleted last: without it the folder could not be
    overwritten.
    """
    out.mkdir(parents=True, exist_ok=True)
    for entry in sorted(out.iterdir(), key=lambda entry: entry.name == CONFIG) if clean else ():
        if entry.name != LOCK:
            shutil.rmtree(entry) if entry.is_dir() and not entry.is_symlink() else entry.unlink()
    if not (out / CONFIG).exists():
        formats.write("config", out / CONFIG, contents)
