"""Damaged policy folders, exports, label files, teachers and tables: a reader raises, or returns the whole contents.

python tests/damaged_files.py [--cases 2000] [--seed 0]   tries many cases and prints what went wrong

A case is a kind of folder, one of its files and a kind of damage; where the file is JSON it may be signed anew. It goes
wrong with anything but a UserError of one line, with a refusal that changed something, or with other values than those
of the whole folder. What was signed anew may be believed, and then may give other values, but finite actions.
"""

from __future__ import annotations

import argparse
import contextlib
import functools
import io
import json
import shutil
import sys
import tempfile
import traceback
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import json_ways
import numpy as np
import probes
import small_policies
from damaged_folders import DAMAGES
from probes import files_of

import cuelearner_jax as cl
from cuelearner_jax import teachers
from cuelearner_jax.errors import UserError
from cuelearner_jax.export import runner
from cuelearner_jax.policies import Heuristic
from cuelearner_jax.runs import lane_checkpoints
from cuelearner_jax.spaces import DIRECTIONS
from cuelearner_jax.storage import label_files, results
from cuelearner_jax.storage import table as tables
from cuelearner_jax.teachers import LearnedTeacher, init_params

ANGLES = np.linspace(0.0, 6.0, 12)
SEEN = np.stack([np.cos(ANGLES), np.sin(ANGLES)], -1).astype(np.float32)
LANES, STEP = 2, 48
ROW = {"seed": 0, "said": "answer", "seconds": 1.5, "who": "Ada", "when": "2026-01-01T00:00:00+00:00"}


class Case(NamedTuple):
    """A damage of one file."""

    kind: str
    file: str  # relative to the folder
    damage: str
    at: int  # where, as a share of 2^32


# --- what is written, and what its readers give ----------------------------------------------------------------------


def _policy(folder: Path) -> None:
    small_policies.write(folder)


def _acts(folder: Path) -> Any:
    return cl.load_policy(folder, task=small_policies.TASK)(SEEN)


def _exported(format: str, folder: Path) -> None:
    world = cl.World(small_policies.TASK, probes.WindowConfig())
    cl.export_policy(Heuristic(small_policies.ENV), folder, world, format)


def _decides(folder: Path) -> Any:
    return cl.load_exported(folder)(SEEN)


def _labels(folder: Path) -> None:
    with label_files.LabelWriter(
        folder, {"name": "window", "half_width_deg": 28.0}, "relative", DIRECTIONS, 20.0
    ) as writer:
        for item, obs in enumerate(SEEN):
            writer.append(**ROW, item=item, obs=obs, action=obs, answer=np.float32([item % 3 - 1]))


def _labels_in_parquet(folder: Path) -> None:
    _labels(folder)
    label_files.finish(folder)


def _labels_read(folder: Path) -> Any:
    file = label_files.read(folder)
    return [file.task, file.answers, file.eps, file.seeds, *jax.tree.leaves(file.labels), *(file.people or ())]


def _teacher(folder: Path) -> None:
    params = init_params((8,), small_policies.ENV, jax.random.key(0))
    made = LearnedTeacher(small_policies.ENV, params, jnp.zeros(()), jnp.zeros(()), (8,), 8)
    about = {"config": {"layers": [8], "directions": 8}, "task": {"name": "window", "half_width_deg": 28.0}}
    teachers.save(folder, made, about)


def _teacher_read(folder: Path) -> Any:
    teachers.world_of(folder, "window", probes.WindowConfig(), ())
    return jax.tree.leaves(teachers.load(folder, small_policies.ENV, 0.0, 0.0).params)


def _due(folder: Path) -> None:
    folder.mkdir()
    lane_checkpoints.write_due(folder, STEP, {"train_loss": np.float32([0.1, 0.2])})


def _due_read(folder: Path) -> Any:
    found = lane_checkpoints.read_due(folder, STEP, LANES)
    if found is None:  # no stretch waits for its evaluation: its row must be there, or the run is refused
        raise UserError("rows are missing")
    return sorted(found.items())


def _curve(folder: Path) -> None:
    constants = {"run": "r", "task": "window", "guidance": "relative", "split": "tuning", "config_hash": ""}
    with tables.TableWriter(folder, results.GUIDES, constants) as writer:
        for number in (1, 2, 3):
            columns = {"seed": [0, 1], "labels": [10, 10], "asked": [number] * 2, "guide_reward": [0.1, 0.2]}
            writer.append(round=number, step=0, wall_s=0.0, **{k: np.array(v) for k, v in columns.items()})


def _curve_in_parquet(folder: Path) -> None:
    _curve(folder)
    tables.finish(folder, results.GUIDES)


def _curve_read(folder: Path) -> Any:
    return results.read(folder, schema=results.GUIDES).drop_columns(["folder"]).to_pylist()


class Kind(NamedTuple):
    """A folder."""

    write: Callable[[Path], None]
    read: Callable[[Path], Any]
    signed: Callable[[Path], None] | None = None  # seals a folder one of whose JSON files was changed


def _sign(name: str) -> Callable[[Path], None]:
    return lambda folder: probes.edit_json(folder / name, lambda values: None)


KINDS = {
    "policy": Kind(_policy, _acts, _sign("policy.json")),
    **{name: Kind(functools.partial(_exported, name), _decides, probes.edit_contract) for name in runner.RUNNERS},
    "lines of labels": Kind(_labels, _labels_read),
    "table of labels": Kind(_labels_in_parquet, _labels_read),
    "teacher": Kind(_teacher, _teacher_read, _sign(teachers.ABOUT)),
    "due": Kind(_due, _due_read, _sign(lane_checkpoints.DUE)),
    "lines of a curve": Kind(_curve, _curve_read),
    "table of a curve": Kind(_curve_in_parquet, _curve_read),
}


# --- what is done to them --------------------------------------------------------------------------------------------

PIECE = 64  # bytes
NONSENSE = (None, True, -1, 0, 2**31, 2**63, 10**400, 1e308, float("nan"), 0.5, "", "x\n\x1b[31m", "../x", [], {}, [[]])


def _pieces(path: Path, at: int, change: Callable[[bytearray, int, int], None]) -> None:
    content = bytearray(path.read_bytes())
    size = min(PIECE, len(content) // 3)
    change(content, at * max(1, len(content) - 2 * size) >> 32, size)
    path.write_bytes(content)


def _swapped(path: Path, at: int) -> None:
    def change(content: bytearray, start: int, size: int) -> None:
        middle, end = start + size, start + 2 * size
        content[start:end] = content[middle:end] + content[start:middle]

    _pieces(path, at, change)


def _zeroed(path: Path, at: int) -> None:
    def change(content: bytearray, start: int, size: int) -> None:
        content[start : start + size] = bytes(size)

    _pieces(path, at, change)


def _repeated(path: Path, at: int) -> None:
    def change(content: bytearray, start: int, size: int) -> None:
        content[start:start] = content[start : start + size]

    _pieces(path, at, change)


def _signed(path: Path, at: int) -> None:
    """Another value in the place of one of a JSON file's; a flipped bit in any other file."""
    if path.suffix != ".json":
        DAMAGES["flipped"](path, at)
        return
    values = json.loads(path.read_text())
    ways = [way for way in json_ways.ways(values) if way[0] not in ("digest", runner.DIGEST)]
    way = ways[at % len(ways)]
    tried = (*NONSENSE, json_ways.GONE, [json_ways.at(values, way)] * 3)
    path.write_text(json.dumps(json_ways.changed(values, way, tried[at // len(ways) % len(tried)])))


FILE_DAMAGES = {**DAMAGES, "swapped": _swapped, "zeroed": _zeroed, "repeated": _repeated, "signed": _signed}


# --- cases -----------------------------------------------------------------------------------------------------------


def make_folders(home: Path) -> dict[str, Any]:
    """Write a folder of each kind; return what their readers give."""
    for name, kind in KINDS.items():
        kind.write(home / name)
    return {name: _read(kind, home / name)[0] for name, kind in KINDS.items()}


def cases(home: Path, count: int, seed: int) -> list[Case]:
    """`count` cases by chance, each kind of folder equally often, however many files it has."""
    rng, names, found = np.random.default_rng(seed), sorted(KINDS), []
    for index in range(count):
        kind = names[index % len(names)]
        files = [path.relative_to(home / kind) for path in sorted((home / kind).rglob("*")) if path.is_file()]
        damage, file = str(rng.choice(list(FILE_DAMAGES))), str(files[rng.integers(len(files))])
        if damage == "signed":
            damage, file = _what_is_signed(kind, file, rng)
        found.append(Case(kind, file, damage, int(rng.integers(1 << 32))))
    return found


def _what_is_signed(kind: str, file: str, rng: np.random.Generator) -> tuple[str, str]:
    if KINDS[kind].signed is None:
        return "flipped", file
    if kind in runner.RUNNERS:
        return "signed", file if rng.random() < 0.3 else runner.CONTRACT
    return "signed", {"policy": "policy.json", "teacher": teachers.ABOUT, "due": lane_checkpoints.DUE}[kind]


def _read(kind: Kind, folder: Path) -> tuple[Any, str]:
    """Return a reader's result, and its console output."""
    told = io.StringIO()
    with contextlib.redirect_stderr(told), contextlib.redirect_stdout(told):
        return kind.read(folder), told.getvalue()


def wrong(home: Path, expected: dict[str, Any], case: Case) -> str | None:
    """Return what is wrong with a case; None if nothing is."""
    kind = KINDS[case.kind]
    with tempfile.TemporaryDirectory() as work:
        folder = Path(shutil.copytree(home / case.kind, Path(work) / "folder"))
        FILE_DAMAGES[case.damage](folder / case.file, case.at)
        if case.damage == "signed" and kind.signed:
            kind.signed(folder)
        before = files_of(folder)
        try:
            found, told = _read(kind, folder)
        except UserError as error:
            one_line = len(str(error).splitlines()) == 1 and str(error).isprintable()
            sound = one_line and files_of(folder) == before
            return None if sound else f"not one line, or after a change: {str(error)!r}"
        except BaseException:
            return f"traceback: {traceback.format_exc().strip()}"
    if case.damage == "signed":
        acts = case.kind in ("policy", *runner.RUNNERS)
        return f"gives {found}" if acts and not np.isfinite(found).all() else None
    if not _same(found, expected[case.kind]) and not told:
        return f"gives {str(found)[:200]} in place of {str(expected[case.kind])[:200]}, without a word"
    return None


def _same(one: Any, other: Any) -> bool:
    one, other = jax.tree.leaves(one), jax.tree.leaves(other)
    return len(one) == len(other) and all(np.array_equal(a, b) for a, b in zip(one, other, strict=True))


def _main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cases", type=int, default=2000)
    parser.add_argument("--seed", type=int, default=0)
    asked = parser.parse_args()
    found = 0
    with tempfile.TemporaryDirectory() as name:
        expected = make_folders(Path(name))
        tried = cases(Path(name), asked.cases, asked.seed)
        for case in tried:
            if outcome := wrong(Path(name), expected, case):
                found += 1
                print(f"{case}\n    {outcome}", flush=True)
    told = Counter((case.kind, case.damage) for case in tried)
    print(f"{len(tried)} cases ({len(told)} kinds of folder and damage), {found} went wrong")
    return 1 if found else 0


if __name__ == "__main__":
    sys.exit(_main())
