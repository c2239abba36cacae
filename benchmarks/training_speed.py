"""Share of the machine's matmul rate that training reaches, on the work of the peers' comparison.

    python benchmarks/training_speed.py --seeds 8 32 --out speed.json

Cart and pole, the paper's six hidden layers, batch 256, one gradient step an environment step, double DQN with two
directions. The whole loop is timed: acting, environment, replay, targets, gradient, optimiser, target network. Floating
point operations are counted from the layers (`_flops.py`), not taken from the compiler; the peak is a
large float32 matrix product measured between the timed stretches of the same run. Medians over rounds, compile time
apart.
Peers measured on another day on the same kind of machine (purejaxrl, rejax): 54 to 56% at 8 and 32 seeds.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import jax
import numpy as np
from _flops import step_operations
from _measuring import Timed, learning, matmul_rate
from cartpole import CartPole

from cuelearner_jax.agents import ddqn
from cuelearner_jax.config import Scalars, Sizes
from cuelearner_jax.environment import spaces_of
from cuelearner_jax.run_config import RunConfig

BATCH, ENVS, DIRECTIONS = 256, 8, 2


def measure(config: RunConfig, env: CartPole, seeds: int, steps: int, rounds: int) -> dict[str, float]:
    """Medians over rounds of one number of seeds."""
    operations = step_operations(config, spaces_of(env)).total
    timed, found = Timed(config, env, "none", seeds), []
    for _ in range(rounds + 1):
        peak = matmul_rate()
        rate = steps * seeds / timed.train(steps // ENVS)
        found.append((rate, max(peak, matmul_rate())))
    rates, peaks = np.array(found[1:]).T  # the first one compiles
    return {
        "seeds": seeds,
        "steps_a_second": float(np.median(rates)),
        "gflop_a_step": operations / 1e9,
        "matmul_gflops": float(np.median(peaks)) / 1e9,
        "share": float(np.median(rates * operations / peaks)),
    }


def main() -> None:
    """Time the loop at each number of seeds and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, nargs="+", default=[8, 32])
    parser.add_argument("--steps", type=int, default=64, help="of each seed in a timed stretch")
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--lanes-per-block", type=int, default=0, help="0: the default of the machine")
    parser.add_argument("--out", type=Path, help="write the figures to this JSON file")
    asked = parser.parse_args()
    agent = ddqn.DdqnConfig(
        directions=DIRECTIONS,
        target_directions=DIRECTIONS,
        batch_size=BATCH,
        replay_capacity=10_000 // ENVS * ENVS,
        optimizer="adam",
        learning_rate=2.5e-4,
    )
    sizes = Sizes(num_envs=ENVS, lanes_per_block=asked.lanes_per_block)
    config = learning(RunConfig(None, sizes, Scalars(discount=0.99), agent=agent))
    rows = [measure(config, CartPole(), seeds, asked.steps, asked.rounds) for seeds in asked.seeds]
    print("seeds  steps/s (all)  GFLOP a step  matmul GFLOP/s  share of it")
    for row in rows:
        print(
            f"{row['seeds']:5d}  {row['steps_a_second']:13.1f}  {row['gflop_a_step']:12.3f}  "
            f"{row['matmul_gflops']:14.0f}  {row['share']:11.1%}"
        )
    if asked.out:
        asked.out.write_text(json.dumps({"device": jax.devices()[0].device_kind, "rows": rows}, indent=1) + "\n")


if __name__ == "__main__":
    main()
