"""Wall time of a guided training run over an unguided one: same loop, networks, seeds and steps.

    python benchmarks/guidance_overhead.py --out overhead.json

Guided: relative feedback, half of the episodes refined during all of the stretch (no cut-off), after labels have been
collected and fitted; what collecting and fitting took is given apart, and as part of a whole run of the preset. Rounds
of both kinds are interleaved; medians over rounds, compile time apart.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
from pathlib import Path
from typing import Any

import jax
import numpy as np
from _measuring import Labelled, learning

from cuelearner_jax.arbiters import Episodes
from cuelearner_jax.tasks.billiards import BILLIARDS


class Run(Labelled):
    """A run with one kind of guidance, its labels given, ready to train."""

    def __init__(self, kind: str, config: Any, seeds: int, labels: int) -> None:
        env = BILLIARDS.environment(config.task)
        super().__init__(config, env, kind, seeds, labels)
        teacher = BILLIARDS.make_teacher(config.task, env) if self.group.guidance.asks else None
        self.rounds = [self.label_round(teacher) for _ in range(self.group.rounds)] if teacher else []


def main() -> None:
    """Measure the presets and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--presets", nargs="+", default=["quickstart", "paper"], choices=sorted(BILLIARDS.presets))
    parser.add_argument("--seeds", type=int, default=4)
    parser.add_argument("--steps", type=int, default=0, help="in a timed stretch (0: 1000 for small networks, else 20)")
    parser.add_argument("--rounds", type=int, default=7)
    parser.add_argument("--out", type=Path, help="write the figures to this JSON file")
    arguments = parser.parse_args()

    rows = []
    for name in arguments.presets:
        config = BILLIARDS.presets[name].config
        labels = 2 * config.sizes.labels_per_round  # enough for a fitted model; the time of a round is scaled up below
        capacity = min(config.agent.replay_capacity, 100_000)
        agent, sizes = dataclasses.replace(config.agent, replay_capacity=capacity), config.sizes
        half = Episodes()  # of all episodes guided
        measured = learning(dataclasses.replace(config, agent=agent, arbiter=half), guided=True)
        runs = {kind: Run(kind, measured, arguments.seeds, labels) for kind in ("none", "relative")}
        steps = arguments.steps or (1000 if name == "quickstart" else 20)
        iterations = -(-steps // sizes.num_envs)
        times = {kind: [run.train(iterations) for _ in range(arguments.rounds + 1)][1:] for kind, run in runs.items()}
        none, relative = (np.median(times[kind]) / (iterations * sizes.num_envs) for kind in ("none", "relative"))
        budget = BILLIARDS.presets[name].labels[-1]
        labelling = runs["relative"].rounds[-1] * budget / config.sizes.labels_per_round
        guided_steps = min(config.schedule.guidance_until, config.schedule.total_steps)
        whole = none * config.schedule.total_steps
        guided = whole + (relative - none) * guided_steps + labelling
        rows.append(
            {
                "preset": name,
                "seeds": arguments.seeds,
                "unguided_ms_a_step": 1e3 * float(none),
                "guided_ms_a_step": 1e3 * float(relative),
                "ratio_while_guided": float(relative / none),
                "labels": budget,
                "labelling_s": float(labelling),
                "ratio_whole_run": float(guided / whole),
            }
        )
    print("preset      ms a step: unguided  guided  ratio while guided  labelling [s]  ratio of a whole run")
    for row in rows:
        print(
            f"{row['preset']:<10}  {row['unguided_ms_a_step']:19.3f}  {row['guided_ms_a_step']:6.3f}  "
            f"{row['ratio_while_guided']:18.3f}  {row['labelling_s']:13.1f}  {row['ratio_whole_run']:20.3f}"
        )
    if arguments.out:
        arguments.out.write_text(json.dumps({"device": jax.devices()[0].device_kind, "rows": rows}, indent=1) + "\n")


if __name__ == "__main__":
    main()
