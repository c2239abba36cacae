"""Measure how often an arm's episode succeeds if one relative answer corrects the action of each step.

    python experiments/corrected_episodes.py --out docs/data/arms/corrected_episodes.json

Answers are about the middle action or about a uniform one, and have several strengths. The strength of the preset
`corrected` was chosen by this table, on tuning episodes. Some minutes on two cores.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
from pathlib import Path

from cuelearner_jax.config import Sizes
from cuelearner_jax.environment import actions_of
from cuelearner_jax.evaluate import episodes, evaluate_policy
from cuelearner_jax.policies import Corrected, asked_from
from cuelearner_jax.storage.provenance import provenance
from cuelearner_jax.tasks.arm import ARM, CORRECTED

SKILLS = ("push", "pick")
STRENGTHS = (0.05, 0.1, 0.25, 0.5)  # of a range
SPLIT = "tuning"


def main() -> None:
    """Measure, print and write JSON."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--episodes", type=int, default=256)
    parser.add_argument("--out", type=Path, help="write the figures to this JSON file")
    asked = parser.parse_args()
    rows = []
    for skill in SKILLS:
        config = dataclasses.replace(CORRECTED.task, skill=skill)
        env = ARM.environment(config, SPLIT)
        teacher = ARM.make_teacher(config, env)
        for first in ("middle", "uniform"):
            base = asked_from(env, Sizes(ask_from=first))
            for eps in STRENGTHS:
                scalars = dataclasses.replace(CORRECTED.scalars, eps_deg=eps, k_max=1)
                policy = Corrected(base, teacher, scalars, actions_of(env))
                steps = asked.episodes * config.max_steps
                found = float(evaluate_policy(env, policy, episodes(SPLIT), asked.episodes, steps)["success"])
                rows.append({"skill": skill, "first": first, "strength": eps, "success": found})
                print(f"{skill:<6}{first:<9}{eps:<6}{found:.3f}", flush=True)
    if asked.out:
        told = {**provenance(), "split": SPLIT, "episodes": asked.episodes, "rows": rows}
        asked.out.write_text(json.dumps(told, indent=1) + "\n")


if __name__ == "__main__":
    main()
