"""Cost of the action frame: time of a training step in the action's frame over one in the raw frame.

    python benchmarks/action_frame.py --lanes 1 8 64 --out frame.json

Unguided lanes of each task's preset `paper`, all of them together; both frames in turn, several times in one run,
medians. What an observation costs once (`Features.own`) is computed once for all directions; the rest enters the first
layer of every direction. Replay is cut to 100,000 steps a seed, which changes memory alone.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
from pathlib import Path

import numpy as np
from _flops import step_operations
from _measuring import Timed, learning
from scaling import REPLAY

from cuelearner_jax.agents import view
from cuelearner_jax.environment import spaces_of
from cuelearner_jax.storage.provenance import provenance
from cuelearner_jax.tasks import registry

FRAMES = ("raw", "action")


def measure(task: str, preset: str, lanes: int, iterations: int, rounds: int) -> dict[str, float | int | str]:
    """Milliseconds of a step of all lanes in each frame, and the ratios of time and of counted operations."""
    found = registry.find(task)
    config = learning(found.presets[preset].config, guided=False)
    env = found.environment(config.task)
    framed = {
        frame: dataclasses.replace(
            config,
            sizes=dataclasses.replace(config.sizes, frame=frame),
            agent=dataclasses.replace(config.agent, replay_capacity=REPLAY),
        )
        for frame in FRAMES
    }
    runs = {frame: Timed(config, env, "none", lanes, 0) for frame, config in framed.items()}
    times: dict[str, list[float]] = {frame: [] for frame in FRAMES}
    for _ in range(rounds + 1):  # the first one compiles
        for frame, run in runs.items():
            times[frame].append(run.train(iterations))
    steps = iterations * config.sizes.num_envs
    raw, action = (1e3 * float(np.median(times[frame][1:])) / steps for frame in FRAMES)
    spaces = spaces_of(env)
    counted = [step_operations(run.group.config, spaces).total for run in runs.values()]
    own, turned = view.widths("action", spaces)
    return {
        "task": task,
        "lanes": lanes,
        "own": own,
        "turned": turned,
        "raw_ms_a_step": raw,
        "action_ms_a_step": action,
        "ratio": action / raw,
        "ratio_of_operations": counted[1] / counted[0],
    }


def main() -> None:
    """Measures, prints a table, writes JSON."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--tasks", nargs="+", default=["billiards", "navigation"], choices=sorted(registry.names()))
    parser.add_argument("--preset", default="paper")
    parser.add_argument("--lanes", type=int, nargs="+", default=[1, 8])
    parser.add_argument("--iterations", type=int, default=5, help="in a timed stretch")
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--out", type=Path, help="write the figures to this JSON file")
    asked = parser.parse_args()
    rows = []
    print("task        lanes   raw [ms]  action [ms]  ratio  of operations")
    for task in asked.tasks:
        for lanes in asked.lanes:
            row = measure(task, asked.preset, lanes, asked.iterations, asked.rounds)
            rows.append(row)
            print(
                f"{task:<10}  {lanes:>5}  {row['raw_ms_a_step']:9.4f}  {row['action_ms_a_step']:11.4f}  "
                f"{row['ratio']:5.2f}  {row['ratio_of_operations']:13.2f}",
                flush=True,
            )
            if asked.out:
                asked.out.write_text(json.dumps({**provenance(), "rows": rows}, indent=1) + "\n")


if __name__ == "__main__":
    main()
