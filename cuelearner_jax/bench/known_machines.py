"""The table of known machines (known_machines.json): what `cuelearner bench --out` wrote; how figures are printed."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from cuelearner_jax.errors import UserError

TABLE = Path(__file__).with_name("known_machines.json")

# What an entry holds, and what each means.
ENTRY: dict[str, type | tuple[type, ...]] = {
    "name": str,  # what the table calls the machine
    "note": str,  # what a reader must know, for instance that it is shared
    "hardware": str,  # devices, as JAX names them
    "processor": str,
    "cores": int,  # of the processor, free to this process
    "versions": str,
    "commit": str,
    "command": str,
    "measured": str,  # date
    "compilation_cache": str,  # none, empty or filled when the measurement began
    "rows": list,
}
NUMBER = (int, float)
ROW: dict[str, type | tuple[type, ...]] = {
    "task": str,
    "preset": str,
    "changed": dict,  # options other than the preset's
    "seeds": int,  # training at once, on all devices together
    "devices": int,
    "steps_a_second": NUMBER,  # environment steps, of all seeds
    "updates_a_second": NUMBER,  # gradient steps, of all seeds
    "ms_an_iteration": NUMBER,  # num_envs steps of every seed, and their gradient steps
    "ms_a_step": NUMBER,  # one step of every seed
    "mflop_a_step": NUMBER,  # of one seed, see flops.py
    "gflops": NUMBER,  # reached
    "matmul_gflops": dict,  # rate of large matrix products by data type, in the same run, on all devices
    "share_of_matmul": dict,  # reached over that
    "mb_a_seed": NUMBER,  # at rest
    "peak_gb": (int, float, type(None)),  # of the first device's memory in the process so far; null where not known
    "first_step_s": NUMBER,  # environment, compilation and first step, imports apart
    "stretches": int,
    "spread": NUMBER,  # slowest less fastest stretch, over their median
}


def read(path: Path = TABLE) -> list[dict[str, Any]]:
    """The known machines. Raises UserError if the table is damaged."""
    try:
        entries = json.loads(path.read_text())
    except (OSError, ValueError) as error:
        raise UserError(f"{path} cannot be read as JSON: restore it") from error
    if not isinstance(entries, list):
        raise UserError(f"{path} is no list of machines: restore it")
    for entry in entries:
        check(entry, path)
    return entries


def check(entry: Any, path: Path) -> None:
    """Raises UserError unless `entry` is what `cuelearner bench --out` writes."""
    wanted = f"{path}: {{}}; give a file that cuelearner bench --out wrote"
    if not isinstance(entry, dict):
        raise UserError(wanted.format("it is no measurement of a machine"))
    _check_fields(entry, ENTRY, wanted)
    if not entry["rows"]:
        raise UserError(wanted.format("it has no rows"))
    for row in entry["rows"]:
        if not isinstance(row, dict):
            raise UserError(wanted.format("a row is no table of figures"))
        _check_fields(row, ROW, wanted)
    for name in ("name", "hardware", "commit", "command"):
        if not entry[name]:
            raise UserError(wanted.format(f"{name} is empty, so nobody can trace its figures"))


def _check_fields(values: dict[str, Any], wanted: dict[str, Any], message: str) -> None:
    for name, kind in wanted.items():
        if name not in values or not isinstance(values[name], kind) or isinstance(values[name], bool):
            raise UserError(message.format(f"{name} is missing or of the wrong type"))


def add(path: Path, table: Path = TABLE) -> None:
    """Takes a measurement into the table.

    Raises UserError, with the table unchanged, if it is none, was made by uncommitted code or is there already.
    """
    try:
        entry = json.loads(path.read_text())
    except (OSError, ValueError) as error:
        raise UserError(f"{path} cannot be read as JSON: give a file that cuelearner bench --out wrote") from error
    check(entry, path)
    if entry["commit"].endswith("-dirty"):
        raise UserError(f"{path} was measured with uncommitted changes: commit them and measure again")
    entries = read(table)
    if entry in entries:
        raise UserError(f"{path} is in the table already")
    temporary = table.with_name(table.name + ".tmp")  # in one step, so that a crash leaves no half of it
    temporary.write_text(json.dumps([*entries, entry], indent=1) + "\n")
    temporary.replace(table)


def figures(rows: Sequence[dict[str, Any]]) -> str:
    """Measured rows as a table of text."""
    heads = ("task", "preset", "seeds", "steps/s", "updates/s", "ms/iteration", "ms/step", "GFLOP/s", "of matmul")
    heads += ("MB/seed", "peak GB", "first step s")
    lines = []
    for row in rows:
        changed = "*" if row["changed"] else ""
        share = " / ".join(f"{share:.1%}" for share in row["share_of_matmul"].values())
        peak = "unknown" if row["peak_gb"] is None else f"{row['peak_gb']:.2f}"
        cells = [row["task"], row["preset"] + changed, str(row["seeds"])]
        cells += [f"{row['steps_a_second']:,.0f}", f"{row['updates_a_second']:,.0f}", f"{row['ms_an_iteration']:.3f}"]
        cells += [f"{row['ms_a_step']:.3f}", f"{row['gflops']:,.1f}", share, f"{row['mb_a_seed']:.2f}", peak]
        lines.append([*cells, f"{row['first_step_s']:.1f}"])
    rates = {name: max(row["matmul_gflops"][name] for row in rows) for name in rows[0]["matmul_gflops"]}
    told = ", ".join(f"{name} {rate:,.0f} GFLOP/s" for name, rate in rates.items())
    devices = f" on {rows[0]['devices']} devices" if rows[0]["devices"] > 1 else ""
    return f"{_columns(heads, lines)}\nlarge matrix products, same run{devices}: {told}"


def beside(entry: dict[str, Any], known: Sequence[dict[str, Any]]) -> str:
    """Steps a second of the same work on known machines, and how many times as fast this one is."""
    if not known:
        return "no machine is known yet"
    names = list(dict.fromkeys(machine["name"] for machine in known))
    lines = []
    for row in entry["rows"]:
        cells = [row["task"], row["preset"] + ("*" if row["changed"] else ""), str(row["seeds"])]
        for name in names:
            same = [other for machine in known if machine["name"] == name for other in machine["rows"]]
            same = [other for other in same if _work(other) == _work(row)]
            rates = same[-1:] and (row["steps_a_second"], same[-1]["steps_a_second"])  # the newest measurement
            cells.append(f"{rates[1]:,.0f} ({rates[0] / rates[1]:.2f}x)" if rates else "-")
        lines.append([*cells])
    told = dict.fromkeys(f"  {machine['name']}: {_where(machine)}" for machine in known)  # each once
    table = _columns(("task", "preset", "seeds", *names), lines)
    return "\n".join(["steps/s on known machines (and this one over them):", table, *told])


def _work(row: dict[str, Any]) -> tuple:
    """What makes two rows comparable: the same lanes, and networks that cost the same."""
    return row["task"], row["preset"], row["changed"], row["seeds"], round(row["mflop_a_step"], 6)


def _where(machine: dict[str, Any]) -> str:
    note = f"; {machine['note']}" if machine["note"] else ""
    hardware = f"{machine['hardware']}, {machine['cores']} cores of {machine['processor']}"
    return f"{hardware}; {machine['versions'].partition(', flax')[0]}; {machine['commit']}, {machine['measured']}{note}"


def _columns(heads: Sequence[str], lines: Sequence[Sequence[str]]) -> str:
    """Cells in columns, words to the left and numbers to the right."""
    widths = [max(len(line[place]) for line in (heads, *lines)) for place in range(len(heads))]
    return "\n".join(
        "  ".join(f"{cell:<{width}}" if place < 2 else f"{cell:>{width}}" for place, (cell, width) in enumerate(cells))
        for cells in (list(zip(line, widths, strict=True)) for line in (heads, *lines))
    )
