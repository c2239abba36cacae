"""Compare the method in one file with the package: curves of `examples/single_file.py` beside the recorded quickstart.

    python experiments/single_file.py --out docs/data/single_file.json

The same seeds are trained, and each evaluation's interquartile mean is compared with the recorded 95% interval. The
package paces guided episodes, the single file guides each with probability 1/2. About four minutes of processor time.
"""

from __future__ import annotations

import argparse
import csv
import json
from pathlib import Path
from typing import Any

import numpy as np

from cuelearner_jax.report.statistics import interval
from cuelearner_jax.storage import results
from cuelearner_jax.storage.provenance import provenance
from examples import single_file

RECORDED = Path(__file__).resolve().parents[1] / "docs" / "data" / "quickstart"
ROUNDING = 1e-6  # of recorded rewards, which are single precision


def recorded_intervals() -> dict[str, list[dict[str, float]]]:
    """Read the recorded curves: step, interquartile mean, lower and upper bound of each evaluation, by guidance."""
    found: dict[str, list[dict[str, float]]] = {}
    with (RECORDED / "curves.csv").open() as file:
        for row in csv.DictReader(file):
            numbers = {name: float(row[name]) for name in ("step", "iqm", "lower", "upper")}
            found.setdefault(row["guidance"], []).append(numbers)
    return found


def recorded_seeds() -> dict[tuple[str, int], list[float]]:
    """Read the recorded rewards of each guidance and seed, in the order of the steps."""
    found: dict[tuple[str, int], list[float]] = {}
    rows = results.read([RECORDED]).to_pylist()
    for row in sorted(rows, key=lambda row: row["step"]):
        found.setdefault((row["guidance"], row["seed"]), []).append(row["reward"])
    return found


def compare(found: dict[str, Any], seeds: range) -> list[dict[str, Any]]:
    """Return a row for each guidance: how the curves of the single file lie beside the recorded ones."""
    rows, by_seed = [], recorded_seeds()
    for guidance, known in recorded_intervals().items():
        mean, lower, upper = interval(found[guidance])
        within = [k["lower"] - ROUNDING <= m <= k["upper"] + ROUNDING for k, m in zip(known, mean, strict=True)]
        outside = [int(k["step"]) for k, inside in zip(known, within, strict=True) if not inside]
        own = {seed: np.asarray(by_seed[guidance, seed]) for seed in seeds if (guidance, seed) in by_seed}
        alike = {seed: np.isclose(found[guidance][seed - seeds.start], own[seed], atol=ROUNDING) for seed in own}
        print(
            f"{guidance:<9} within the recorded interval at {sum(within)} of {len(within)} evaluations; equal to the "
            f"recorded seed at {sum(map(np.sum, alike.values()))} of {sum(map(len, alike.values()))}"
        )
        rows.append(
            {
                "guidance": guidance,
                "steps": [int(k["step"]) for k in known],
                "iqm": mean.round(4).tolist(),
                "lower": lower.round(4).tolist(),
                "upper": upper.round(4).tolist(),
                "recorded_iqm": [round(k["iqm"], 4) for k in known],
                "steps_outside_the_recorded_interval": outside,
                "evaluations_equal_to_the_recorded_seed": int(sum(map(np.sum, alike.values()))),
                "evaluations_compared": int(sum(map(len, alike.values()))),
                "seeds_wholly_equal": [seed for seed, equal in alike.items() if equal.all()],
                "rewards": found[guidance].round(4).tolist(),
            }
        )
    return rows


def main() -> None:
    """Train, compare, write JSON."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=24, help="agents of each kind (default: %(default)s)")
    parser.add_argument("--out", type=Path, help="write the figures to this JSON file")
    asked = parser.parse_args()
    seeds = range(2000, 2000 + asked.seeds)
    rows = compare(single_file.curves(single_file.Config(), seeds), seeds)
    if asked.out:
        about = {**provenance(), "recorded": "docs/data/quickstart", "seeds": list(seeds)}
        asked.out.write_text(json.dumps({**about, "rows": rows}) + "\n")


if __name__ == "__main__":
    main()
