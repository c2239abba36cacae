"""Decisions in StableHLO written on one device and called on another: are the golden cases decided alike?

    python benchmarks/exports_on_devices.py docs/data/navigation_agent --out exports_on_devices.json

Every device writes the run's agent and its guided policy, and calls what every device wrote, in a process of its own.
Told are the largest difference of a golden case, how many of them differ by more than the contract allows, and how long
a call about one observation takes. Two to four minutes with an accelerator; needs JAX alone.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np

from cuelearner_jax.export.runner import GOLDEN, Decision
from cuelearner_jax.storage.provenance import provenance

CALLS = 200


def written(run: str, policies: list[str], folder: Path, device: str) -> None:
    """Export policies of a run on this process's device."""
    from cuelearner_jax.cli import main

    for policy in policies:
        if main(["export", run, "--policy", policy, "--format", "stablehlo", "--out", str(folder / device / policy)]):
            raise SystemExit(1)


def called(folder: Path) -> list[dict[str, Any]]:
    """Call every decision below a folder on this process's device."""
    rows = []
    for contract in sorted(folder.glob("*/*/contract.json")):
        decide = Decision(contract.parent)
        with np.load(contract.parent / GOLDEN) as golden:
            obs, wanted = golden["obs"], golden["actions"]
        apart = np.abs(decide(obs) - wanted).max(-1)
        decide(obs[0])
        taken = []
        for number in range(CALLS):
            start = time.perf_counter()
            decide(obs[number % len(obs)])
            taken.append(time.perf_counter() - start)
        rows.append(
            {
                "policy": contract.parent.name,
                "written_on": contract.parent.parent.name,
                "cases": len(obs),
                "largest_difference": float(apart.max()),
                "above_tolerance": int((apart > decide.contract["golden"]["tolerance"]).sum()),
                "median_ms": round(float(np.median(taken)) * 1e3, 3),
            }
        )
    return rows


def on(device: str, *arguments: str) -> str:
    """Return what this file prints last in a process on one kind of device; raise SystemExit if it fails."""
    done = subprocess.run(
        [sys.executable, __file__, *arguments, "--device", device],
        env={**os.environ, "JAX_PLATFORMS": device},
        check=False,
        stdout=subprocess.PIPE,
        text=True,
    )
    if done.returncode:
        raise SystemExit(f"{device}: the process ended with status {done.returncode}")
    return done.stdout.strip().splitlines()[-1]


def main() -> None:
    """Write and calls on every device, and prints a table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", help="a run folder with a guided lane")
    parser.add_argument("--policies", nargs="+", default=["agent", "guided"])
    parser.add_argument("--devices", nargs="+", default=["cpu", "cuda"], help="as JAX_PLATFORMS calls them")
    parser.add_argument("--out", type=Path, help="a JSON file")
    parser.add_argument("--device", help=argparse.SUPPRESS)  # of a process that this one starts
    parser.add_argument("--folder", type=Path, help=argparse.SUPPRESS)
    parser.add_argument("--call", action="store_true", help=argparse.SUPPRESS)
    asked = parser.parse_args()
    if asked.device and asked.call:
        print(json.dumps(called(asked.folder)))
        return
    if asked.device:
        written(asked.run, asked.policies, asked.folder, asked.device)
        return
    with tempfile.TemporaryDirectory() as folder:
        for device in asked.devices:
            on(device, asked.run, "--policies", *asked.policies, "--folder", folder)
        found = {device: json.loads(on(device, asked.run, "--folder", folder, "--call")) for device in asked.devices}
    rows = [{"called_on": device, **row} for device, each in found.items() for row in each]
    for row in rows:
        print("  ".join(f"{name} {value}" for name, value in row.items()))
    if asked.out:
        contents = {"subject": Path(asked.run).name, "devices": asked.devices, **provenance(), "rows": rows}
        asked.out.write_text(json.dumps(contents, indent=1) + "\n")


if __name__ == "__main__":
    main()
