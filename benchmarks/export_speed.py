"""Time of an exported decision: one observation at a time on one core, in every format.

    python benchmarks/export_speed.py docs/data/navigation_agent

The process keeps to one core before anything starts threads. Prints a table; `--out` writes it as JSON too. Of
`--repeats` measurements the one with the lowest median counts: other work on the machine only makes it slower.
`mean_cpu_ms` is the lowest mean of the processor's own time, without what the process waited for the core. NumPy's
products are OpenBLAS's, which chooses its kernels by the processor unless OPENBLAS_CORETYPE says otherwise.
"""

from __future__ import annotations

import os

os.sched_setaffinity(0, {max(os.sched_getaffinity(0))})  # before anything counts cores
os.environ.update(OMP_NUM_THREADS="1", OPENBLAS_NUM_THREADS="1", JAX_PLATFORMS="cpu")

import argparse  # noqa: E402
import json  # noqa: E402
import tempfile  # noqa: E402
import time  # noqa: E402
from pathlib import Path  # noqa: E402

import numpy as np  # noqa: E402

from cuelearner_jax.cli import main  # noqa: E402
from cuelearner_jax.export.runner import GOLDEN, Decision  # noqa: E402
from cuelearner_jax.storage.provenance import provenance  # noqa: E402

LIMIT_MS = 5.0


def measured(folder: Path, calls: int, repeats: int) -> dict[str, float]:
    """Milliseconds a decision about the golden observations, one by one."""
    decide = Decision(folder)
    with np.load(folder / GOLDEN) as golden:
        observations = golden["obs"]
    for obs in observations:
        decide(obs)
    found = []
    for _ in range(repeats):
        taken, busy = [], time.process_time()
        for number in range(calls):
            obs = observations[number % len(observations)]
            start = time.perf_counter()
            decide(obs)
            taken.append(time.perf_counter() - start)
        found.append(np.append(np.percentile(taken, [5, 50, 95]), (time.process_time() - busy) / calls) * 1e3)
    low, median, high, _ = min(found, key=lambda figures: figures[1])
    cpu = min(figures[3] for figures in found)
    told = {"p5_ms": low, "median_ms": median, "p95_ms": high, "mean_cpu_ms": cpu}
    return {name: round(float(value), 3) for name, value in told.items()}


def run() -> None:
    """Export a run's policies in every format, and times them."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("policy", help="a run folder")
    parser.add_argument("--policies", nargs="+", default=["agent", "guided"], help="which of the run's policies")
    parser.add_argument("--formats", nargs="+", default=["stablehlo", "onnx", "numpy"])
    parser.add_argument("--calls", type=int, default=200)
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--out", type=Path, help="a JSON file")
    asked = parser.parse_args()
    rows = []
    for policy in asked.policies:
        for name in asked.formats:
            with tempfile.TemporaryDirectory() as folder:
                out = Path(folder) / "exported"
                if main(["export", asked.policy, "--policy", policy, "--format", name, "--out", str(out)]):
                    raise SystemExit(1)
                found = measured(out, asked.calls, asked.repeats)
            rows.append({"policy": policy, "format": name, **found})
            told = "  ".join(f"{key} {value:6.2f}" for key, value in found.items())
            print(f"{policy:<8}{name:<11}{told}  {'' if found['median_ms'] <= LIMIT_MS else 'over the limit'}")
    if asked.out:
        how = {"subject": Path(asked.policy).name, "calls": asked.calls, "repeats": asked.repeats}
        kernels = {"openblas_coretype": os.environ.get("OPENBLAS_CORETYPE", "")}
        asked.out.write_text(json.dumps({**how, **kernels, **provenance(), "rows": rows}, indent=1) + "\n")


if __name__ == "__main__":
    run()
