"""Damaged run folders for every command that reads them: each raises, or gives the results of the whole folder.

python tests/damaged_folders.py [--cases 2000] [--seed 0] [--workers 2]   tries many cases and prints what went wrong

A case is a run (finished, or stopped halfway), one of its files, a kind of damage and a command. It goes wrong with a
traceback, with a message of several lines, with a refusal that changed something, or with status 0 and other numbers
than those of the whole folder; a report may show fewer numbers if it says what is missing.
"""

from __future__ import annotations

import argparse
import contextlib
import csv
import io
import json
import os
import shutil
import sys
import tempfile
import threading
import traceback
from collections import Counter
from collections.abc import Iterable, Iterator
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from multiprocessing import get_context
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
from probes import files_of
from small_runs import SWEEP

from cuelearner_jax.cli import main
from cuelearner_jax.storage import results
from cuelearner_jax.studies import train

RUNS = {"finished": None, "stopped": 5}  # at which look at Ctrl-C the run is stopped
VOLATILE = ("wall_s", "commit", "command", "folder", "run")


class Case(NamedTuple):
    """A damage of one file, and the command that reads it."""

    run: str
    file: str  # relative to the run's folder
    damage: str
    command: str
    bit: int  # that is flipped, as a share of 2^32


class Outcome(NamedTuple):
    """The outcome of a command."""

    status: int
    told: str  # on standard error
    numbers: Any
    missing: str  # what a report says is missing


def _deleted(path: Path, bit: int) -> None:
    path.unlink()


def _emptied(path: Path, bit: int) -> None:
    path.write_bytes(b"")


def _halved(path: Path, bit: int) -> None:
    content = path.read_bytes()
    path.write_bytes(content[: len(content) // 2])


def _flipped(path: Path, bit: int) -> None:
    content = bytearray(path.read_bytes())
    if content:
        place = bit * 8 * len(content) >> 32
        content[place // 8] ^= 1 << place % 8
    path.write_bytes(content)


DAMAGES = {"deleted": _deleted, "emptied": _emptied, "halved": _halved, "flipped": _flipped}


def _called(arguments: list[str]) -> tuple[int, str, str]:
    """Status, standard output and standard error of a command."""
    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        try:
            status = main(arguments)
        except BaseException:
            return -1, out.getvalue(), traceback.format_exc()
    return status, out.getvalue(), err.getvalue()


def _resume(folder: Path, work: Path) -> Outcome:
    status, _, told = _called([*SWEEP, "--out", str(folder), "--resume"])
    numbers = None
    if status == 0:
        table = results.read(folder)
        numbers = table.drop_columns([name for name in VOLATILE if name in table.column_names]).to_pylist()
    return Outcome(status, told, numbers, "")


def _report(folder: Path, work: Path) -> Outcome:
    status, _, told = _called(["report", str(folder), "--out", str(work / "report")])
    if status:
        return Outcome(status, told, None, "")
    tables = [list(csv.reader(path.open())) for path in sorted((work / "report").glob("*.csv"))]
    text = (work / "report" / "report.md").read_text()
    return Outcome(status, told, tables, text.split("## Missing")[1].split("##")[0])


def _evaluate(folder: Path, work: Path) -> Outcome:
    out = work / "measured.json"
    status, _, told = _called(["evaluate", str(folder), "--steps", "20", "--envs", "10", "--out", str(out)])
    return Outcome(status, told, None if status else json.loads(out.read_text())["rows"], "")


def _render(folder: Path, work: Path) -> Outcome:
    status, told, error = _called(["render", str(folder), "--steps", "1", "--out", str(work / "pictures")])
    return Outcome(status, error, told.split(";")[0], "")


COMMANDS = {"resume": _resume, "report": _report, "evaluate": _evaluate, "render": _render}
SHARES = (0.3, 0.3, 0.3, 0.1)  # of the cases; drawing takes ten times as long as the others


@contextlib.contextmanager
def _stopping_at(looks: int | None) -> Iterator[threading.Event]:
    """Ctrl-C at the given look at the event."""

    class Event(threading.Event):
        count = 0

        def is_set(self) -> bool:
            self.count += 1
            return self.count == looks

    yield Event()


def make_runs(folder: Path, finished: Path | None = None) -> None:
    """The whole runs, each in a folder of its name; one that is finished may be given."""
    for name, looks in RUNS.items():
        if finished and looks is None:
            shutil.copytree(finished, folder / name / "run")
            continue
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(train, "interruptible", partial(_stopping_at, looks))
            status, _, told = _called([*SWEEP, "--out", str(folder / name / "run")])
        assert status == (130 if looks else 0), told


def cases(folder: Path, count: int, seed: int) -> list[Case]:
    """`count` cases by chance, each kind of file equally often, however many there are of it."""
    rng = np.random.default_rng(seed)
    kinds: dict[tuple[str, str], list[str]] = {}
    for run in RUNS:
        root = folder / run / "run"
        for path in sorted(path for path in root.rglob("*") if path.is_file()):
            name = path.relative_to(root)
            item = name.parts[3] if "checkpoints" in name.parts and len(name.parts) > 4 else name.name
            kinds.setdefault((run, item), []).append(str(name))
    names = sorted(kinds)
    found = []
    for index in range(count):
        run, item = names[index % len(names)]
        file = str(rng.choice(kinds[run, item]))
        damage, command = str(rng.choice(list(DAMAGES))), str(rng.choice(list(COMMANDS), p=SHARES))
        found.append(Case(run, file, damage, command, int(rng.integers(1 << 32))))
    return found


def baselines(folder: Path, wanted: Iterable[tuple[str, str]]) -> dict[tuple[str, str], Outcome]:
    """Return the outcomes of commands on whole runs, for the wanted (run, command)."""
    found = {}
    for run, command in sorted(wanted):
        with _copied(folder, run) as (copy, work):
            found[run, command] = COMMANDS[command](copy, work)
        assert found[run, command].status == 0, found[run, command].told
    return found


@contextlib.contextmanager
def _copied(folder: Path, run: str) -> Iterator[tuple[Path, Path]]:
    with tempfile.TemporaryDirectory() as work:
        yield Path(shutil.copytree(folder / run / "run", Path(work) / "copy" / "run")), Path(work)


def wrong(folder: Path, expected: dict[tuple[str, str], Outcome], case: Case) -> str | None:
    """Return what is wrong with a case; None if nothing is."""
    with _copied(folder, case.run) as (copy, work):
        DAMAGES[case.damage](copy / case.file, case.bit)
        before = files_of(copy)
        found, whole = COMMANDS[case.command](copy, work), expected[case.run, case.command]
        if found.status == -1 or "Traceback" in found.told:
            return f"traceback: {found.told.strip().splitlines()[-1]}"
        if found.status:
            lines = [line for line in found.told.splitlines() if line.startswith("error: ")]
            if len(lines) != 1:
                return f"not one line: {found.told!r}"
            return None if files_of(copy) == before else f"refused after a change: {lines[0]}"
        if found.numbers != whole.numbers and found.missing == whole.missing:
            return f"status 0, and {str(found.numbers)[:200]} in place of {str(whole.numbers)[:200]}"
    return None


def _main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cases", type=int, default=2000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--workers", type=int, default=2)
    asked = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", str(folder / "compiled"))
        os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0.0")
        with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as pool:  # so that JAX starts with these settings
            pool.submit(make_runs, folder).result()
        tried = cases(folder, asked.cases, asked.seed)
        found = 0
        with ProcessPoolExecutor(asked.workers, mp_context=get_context("spawn")) as pool:
            expected = pool.submit(baselines, folder, {(case.run, case.command) for case in tried}).result()
            outcomes = pool.map(partial(wrong, folder, expected), tried, chunksize=4)
            for number, (case, outcome) in enumerate(zip(tried, outcomes, strict=True), start=1):
                if outcome:
                    found += 1
                    print(f"{case}\n    {outcome}", flush=True)
                if number % 100 == 0:
                    print(f"{number} of {len(tried)} cases, {found} went wrong", flush=True)
    told = Counter((case.damage, case.command) for case in tried)
    print(f"{len(tried)} cases ({len(told)} kinds of damage and command), {found} went wrong")
    return 1 if found else 0


if __name__ == "__main__":
    sys.exit(_main())
