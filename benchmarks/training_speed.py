"""Share of the machine's matmul rate that training reaches, on the work of the peers' comparison.

    python benchmarks/training_speed.py --seeds 8 32 --out speed.json

Cart and pole, the paper's six hidden layers, batch 256, one gradient step an environment step, double DQN. The whole
loop is timed: acting, environment, replay, targets, gradient, optimiser, target network. Floating point operations are
counted from the layers (`_flops.py`), not taken from the compiler; the peak is a large float32 matrix product measured
after it in the same run. Medians over stretches, compile time apart.
Peers measured on another day on the same kind of machine (purejaxrl, rejax): 54 to 56% at 8 and 32 seeds.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import jax
from _measuring import measure
from classic_control import CartPole

from cuelearner_jax.agents.ddqn import DDQNConfig
from cuelearner_jax.config import Scalars, Sizes
from cuelearner_jax.run_config import RunConfig

AGENT = DDQNConfig(
    directions=2,  # of which operations are counted: pushes left and right
    target_directions=2,
    batch_size=256,
    replay_capacity=10_000,
    optimizer="adam",
    learning_rate=2.5e-4,
)


def main() -> None:
    """Time the loop at each number of seeds and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, nargs="+", default=[8, 32])
    parser.add_argument("--seconds", type=float, default=10.0, help="of each measurement")
    parser.add_argument("--out", type=Path, help="write the figures to this JSON file")
    options = parser.parse_args()
    config = RunConfig(None, Sizes(num_envs=8), Scalars(discount=0.99), agent=AGENT)
    rows = [measure(CartPole, config, seeds, options.seconds) for seeds in options.seeds]
    for row in rows:
        share = f"{row['share_of_matmul']:.1%} of {row['matmul_gflops']:.0f} GFLOP/s"
        print(f"{row['seeds']} seeds: {row['steps_a_second']:.1f} steps/s of all, {share}")
    if options.out:
        options.out.write_text(json.dumps({"device": jax.devices()[0].device_kind, "rows": rows}, indent=1) + "\n")


if __name__ == "__main__":
    main()
