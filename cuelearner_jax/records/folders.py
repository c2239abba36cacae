"""What may be done to the folder of a run: use, resume, overwrite, keep for one process.

Folder of a run:

    config.json                  everything that determines the results
    .lock                        held by the process that writes here
    <guidance>/checkpoints/      the newest states
    <guidance>/labels.parquet    what the teacher answered
    <guidance>/results.jsonl     one row a seed and evaluation; results.parquet once done
"""

from __future__ import annotations

import fcntl
import json
import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from cuelearner_jax.errors import UserError
from cuelearner_jax.records import formats

LOCK = ".lock"  # says which process writes in a run's folder; left behind empty


def in_use(out: Path) -> bool:
    """Is there anything at `out`, the mark of a process that writes there apart?"""
    return out.exists() and (not out.is_dir() or any(entry.name != LOCK for entry in out.iterdir()))


def check_folder(out: Path, described: dict[str, Any], resume: bool, overwrite: bool) -> None:
    """Raises UserError unless `out` may be used as asked. `described` is what config.json is to say."""
    if resume and overwrite:
        raise UserError("--resume continues a run and --overwrite deletes it: give one of them")
    used = in_use(out)
    ours = (out / "config.json").is_file()
    if resume:
        if not ours:
            raise UserError(f"nothing to resume in {out}: give the --out of an interrupted run, or leave out --resume")
        differing = sorted(_differences(formats.read("config", out / "config.json"), described))
        if differing:
            raise UserError(
                f"{out} was run with another {', '.join(differing[:4])}: give the same options, or another --out"
            )
    elif used and not overwrite:
        raise UserError(f"{out} is not empty: give --resume to go on, --overwrite to delete it, or another --out")
    elif used and not ours:
        raise UserError(f"{out} is not a run folder, so --overwrite will not delete it: give another --out")


def _differences(before: dict[str, Any], now: dict[str, Any], prefix: str = "") -> Iterator[str]:
    for name in {**before, **now}:
        if f"{prefix}{name}" == "task.from":  # where a task's code lies changes nothing in it
            continue
        old, new = before.get(name), now.get(name)
        if isinstance(old, dict) and isinstance(new, dict):
            yield from _differences(old, new, f"{prefix}{name}.")
        elif old != new:
            yield prefix + name


@contextmanager
def claimed(out: Path) -> Iterator[None]:
    """Makes a run's folder and keeps it for this process alone; it is free again however the process ends.

    The lock is on a file, not on the folder: that is what NFS passes on between machines.

    Raises UserError if another process has it.
    """
    out.mkdir(parents=True, exist_ok=True)
    descriptor = os.open(out / LOCK, os.O_RDWR | os.O_CREAT, 0o666)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        os.close(descriptor)
        raise UserError(f"{out} is being written by another process: wait for it, or give another --out") from None
    try:
        yield
    finally:
        os.close(descriptor)


def prepare_folder(out: Path, described: dict[str, Any], clean: bool) -> None:
    """Makes the folder and writes config.json, if it is not there; with `clean`, nothing else is left in it."""
    out.mkdir(parents=True, exist_ok=True)
    for entry in out.iterdir() if clean else ():
        if entry.name == LOCK:
            continue
        shutil.rmtree(entry) if entry.is_dir() else entry.unlink()
    if not (out / "config.json").exists():
        temporary = out / "config.tmp"  # in one step, so that a crash leaves no half of it
        temporary.write_text(json.dumps(described, indent=1) + "\n")
        temporary.replace(out / "config.json")
