"""Compare strengths of a relative label, by the guide alone on one ball. Minutes on 2 cores.

    python experiments/label_strength.py --out FOLDER

For each eps: 24 seeds of the preset `quickstart`, 100 labels, then uniform actions under guidance on validation
episodes (the column guide_reward of the results). Refinement passes are enough to cross half a turn. Called again, it
goes on where it was interrupted.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import numpy as np

from cuelearner_jax.cli import main as cuelearner
from cuelearner_jax.report.statistics import interval
from cuelearner_jax.storage import results
from cuelearner_jax.storage.provenance import provenance

STRENGTHS_DEG = (1, 2, 5)


def main() -> int:
    """Run the sweeps, prints a table and writes it as JSON."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("runs/label_strength"))
    arguments = parser.parse_args()
    rows = []
    for strength in STRENGTHS_DEG:
        out = arguments.out / f"eps_{strength}"
        scalars = ["--scalars.eps-deg", str(strength), "--scalars.k-max", str(180 // strength + 10)]
        short = ["--schedule.total-steps", "100", "--guidance", "relative", "--out", str(out)]
        resume = ["--resume"] if (out / "config.json").exists() else []
        status = cuelearner(["sweep", "billiards", "--preset", "quickstart", *scalars, *short, *resume])
        if status:
            return status
        table = results.read(out).to_pylist()
        rewards = np.array([row["guide_reward"] for row in table if row["step"] == 0])
        found = interval(rewards)
        rows.append(
            {
                "eps_deg": strength,
                "seeds": len(rewards),
                "iqm": round(float(found.estimate), 3),
                "interval": [round(float(found.lower), 3), round(float(found.upper), 3)],
                "mean": round(float(rewards.mean()), 3),
                "rewards": sorted(round(float(reward), 3) for reward in rewards),
            }
        )
    print("eps [deg]  guide's reward: IQM and 95% interval   mean   worst seed")
    for row in rows:
        low, high = row["interval"]
        spread = f"{row['iqm']:.3f} [{low:.3f}, {high:.3f}]"
        print(f"{row['eps_deg']:9d}  {spread} {row['mean']:20.3f} {row['rewards'][0]:12.3f}")
    contents = {**provenance(), "command": "python experiments/label_strength.py", "rows": rows}
    (arguments.out / "label_strength.json").write_text(json.dumps(contents, indent=1) + "\n")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
