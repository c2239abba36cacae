"""Lanes of a trained run as a run folder of its own, without replay: small enough to keep, to render and to adapt.

python experiments/keep_policy.py runs/navigation/relative-500 --seeds 1000 --out runs/walker
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

import jax
import numpy as np

from cuelearner_jax.errors import UserError
from cuelearner_jax.loop import start_clock
from cuelearner_jax.runs.grid import load
from cuelearner_jax.runs.trained import PolicySource, RunLanes
from cuelearner_jax.storage import formats
from cuelearner_jax.storage.checkpoint import checkpoints
from cuelearner_jax.tasks import registry


def keep(run: Path, out: Path, seeds: Sequence[int], kind: str | None, labels: int | None) -> None:
    """Write the run folder `out`. Raises UserError if the run has not these lanes or `out` is in use."""
    if out.exists():
        raise UserError(f"{out} exists: give another --out")
    task, config, grid = load(run, registry.find)
    lanes = PolicySource(task, config, grid, run).load((kind or grid.guidance[-1],))[0]
    budget = int(lanes.budgets.max()) if labels is None else labels
    rows = {int(lanes.seeds[row]): row for row in np.flatnonzero(lanes.budgets == budget)}
    if missing := [seed for seed in seeds if seed not in rows]:
        raise UserError(f"{run} has no lane of seed {missing[0]} with {budget} labels")
    described = formats.read("config", run / "config.json")
    described["grid"] = {"guidance": [lanes.guidance.name], "seeds": list(seeds), "labels": [budget]}
    out.mkdir(parents=True)
    formats.write("config", out / "config.json", described)
    write(out / lanes.guidance.name, lanes, np.array([rows[seed] for seed in seeds]))


def write(folder: Path, lanes: RunLanes, rows: np.ndarray) -> None:
    """The checkpoint of some lanes' policies."""
    kept = jax.tree.map(lambda leaf: leaf[rows], lanes.policies)
    policy, failed = {name: kept[name] for name in ("params", "guidance")}, kept["failed"]
    clock = start_clock().replace(step=np.int32(lanes.step))
    cut = np.array([1, len(rows)], np.int32)  # one block of all lanes
    with checkpoints(folder / "checkpoints") as saved:
        told = {"clock": clock, "wall_s": np.float32(0), "cut": cut}
        saved.save(lanes.step, {"policy": [policy], "failed": [failed], "clock": told})


def main() -> int:
    """Read the arguments."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--seeds", type=int, nargs="+", required=True)
    parser.add_argument("--guidance", help="kind (default: the run's last)")
    parser.add_argument("--labels", type=int, help="budget (default: the largest)")
    asked = parser.parse_args()
    try:
        keep(asked.run, asked.out, asked.seeds, asked.guidance, asked.labels)
    except UserError as error:
        parser.error(str(error))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
