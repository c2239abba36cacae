"""One lane of a trained run as a run folder of its own, without replay: small enough to keep and to render.

python experiments/keep_policy.py runs/navigation/relative-500 --seed 1000 --out runs/walker
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import jax
import numpy as np

from cuelearner_jax.errors import UserError
from cuelearner_jax.loop import start_clock
from cuelearner_jax.records import formats
from cuelearner_jax.records.checkpoint import checkpoints
from cuelearner_jax.runs.grid import load
from cuelearner_jax.runs.trained import Lanes, PolicySource
from cuelearner_jax.tasks import registry


def keep(run: Path, out: Path, seed: int, kind: str | None, labels: int | None) -> None:
    """Writes the run folder `out`. Raises UserError if the run has no such lane or `out` is in use."""
    if out.exists():
        raise UserError(f"{out} exists: give another --out")
    task, config, grid = load(run, registry.find)
    lanes = PolicySource(task, config, grid, run).load((kind or grid.guidance[-1],))[0]
    budget = int(lanes.budgets.max()) if labels is None else labels
    found = np.flatnonzero((lanes.seeds == seed) & (lanes.budgets == budget))
    if not len(found):
        raise UserError(f"{run} has no lane of seed {seed} with {budget} labels")
    described = formats.read("config", run / "config.json")
    described["grid"] = {"guidance": [lanes.guidance.name], "seeds": [seed], "labels": [budget]}
    out.mkdir(parents=True)
    (out / "config.json").write_text(json.dumps(described, indent=1) + "\n")
    write(out / lanes.guidance.name, lanes, int(found[0]))


def write(folder: Path, lanes: Lanes, index: int) -> None:
    """The checkpoint of one lane's policy."""
    policy = jax.tree.map(lambda leaf: leaf[index : index + 1], lanes.policies)
    clock = start_clock().replace(step=np.int32(lanes.step))
    cut = np.array([1, 1], np.int32)  # one block of one lane
    with checkpoints(folder / "checkpoints") as saved:
        saved.save(lanes.step, {"policy": [policy], "clock": {"clock": clock, "wall_s": np.float32(0), "cut": cut}})


def main() -> int:
    """Reads the arguments."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--seed", type=int, required=True)
    parser.add_argument("--guidance", help="kind (default: the run's last)")
    parser.add_argument("--labels", type=int, help="budget (default: the largest)")
    asked = parser.parse_args()
    try:
        keep(asked.run, asked.out, asked.seed, asked.guidance, asked.labels)
    except UserError as error:
        parser.error(str(error))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
