"""What may be done to the folder of a run: use, resume, overwrite, keep for one process.

Folder of a run:

    config.json                  everything that determines the results
    .lock                        held by the process that writes here, and says which
    <guidance>/checkpoints/      the newest states
    <guidance>/labels.parquet    what the teacher answered
    <guidance>/results.jsonl     one row a seed and evaluation; results.parquet once done
    <guidance>/guide.jsonl       how good the guides are by themselves while they ask; guide.parquet once done
"""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from cuelearner_jax.errors import UserError
from cuelearner_jax.storage import formats
from cuelearner_jax.storage.locks import held
from cuelearner_jax.storage.whole import TEMPORARY

CONFIG = "config.json"
LOCK = ".lock"  # held by the process that writes in a run's folder, and says which; it stays behind
LEFT = (LOCK, CONFIG + TEMPORARY, "config.tmp")  # what a process leaves that ended before its first word


def in_use(out: Path) -> bool:
    """Is there anything at `out`, the mark of a process that writes there apart?"""
    return out.exists() and (not out.is_dir() or any(entry.name not in LEFT for entry in out.iterdir()))


def check_folder(
    out: Path, described: dict[str, Any], resume: bool, overwrite: bool, defaults: dict[str, Any] | None = None
) -> None:
    """Raises UserError unless `out`, whose config.json is to hold `described`, may be resumed, overwritten or begun.

    `defaults`: as `differences` has them.
    """
    if resume and overwrite:
        raise UserError("--resume continues a run and --overwrite deletes it: give one of them")
    used = in_use(out)
    ours = (out / CONFIG).is_file()
    if resume:
        if not ours:
            raise UserError(f"nothing to resume in {out}: give the --out of an interrupted run, or leave out --resume")
        differing = sorted(differences(formats.read("config", out / CONFIG), described, defaults))
        if differing:
            raise UserError(
                f"{out} was run with another {', '.join(differing[:4])}: give the same options, or another --out"
            )
    elif used and not overwrite:
        raise UserError(f"{out} is not empty: give --resume to go on, --overwrite to delete it, or another --out")
    elif used and not ours:
        raise UserError(f"{out} is not a run folder, so --overwrite will not delete it: give another --out")


def differences(
    before: dict[str, Any], now: dict[str, Any], defaults: dict[str, Any] | None = None, prefix: str = ""
) -> Iterator[str]:
    """The names, as `part.field`, in which two descriptions of runs differ.

    Args:
        before, now: the descriptions.
        defaults: values by part and field that one counts as having where it does not say: a program that had not the
            field yet did what the default does.
        prefix: the part, of names.
    """
    defaults = defaults or {}
    for name in {**before, **now}:
        if f"{prefix}{name}" == "task.from":  # where a task's code lies changes nothing in it
            continue
        default = defaults.get(name)
        within, value = (default, None) if isinstance(default, dict) else (None, default)
        old, new = before.get(name, value), now.get(name, value)
        if isinstance(old, dict) and isinstance(new, dict):
            yield from differences(old, new, within, f"{prefix}{name}.")
        elif old != new:
            yield prefix + name


@contextmanager
def claimed(out: Path) -> Iterator[None]:
    """Makes a run's folder and keeps it for this process alone; it is free again however the process ends.

    Whatever was found in the folder before may have changed until it is kept: look again.

    Raises UserError if another process has it.
    """
    out.mkdir(parents=True, exist_ok=True)
    with held(out / LOCK, out, stays=True):
        yield


def prepare_folder(out: Path, described: dict[str, Any], clean: bool) -> None:
    """Makes the folder and writes config.json, if it is not there; with `clean`, nothing else is left in it.

    Links are removed, what they lead to stays. config.json goes last: without it nothing here could be overwritten.
    """
    out.mkdir(parents=True, exist_ok=True)
    for entry in sorted(out.iterdir(), key=lambda entry: entry.name == CONFIG) if clean else ():
        if entry.name == LOCK:
            continue
        shutil.rmtree(entry) if entry.is_dir() and not entry.is_symlink() else entry.unlink()
    if not (out / CONFIG).exists():
        formats.write("config", out / CONFIG, described)
