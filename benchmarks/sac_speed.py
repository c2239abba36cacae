"""Soft actor-critic here over that of sbx: return over steps, and steps over seconds, on tasks of Gymnasium.

    python benchmarks/sac_speed.py --environments Hopper-v5 Ant-v5 --peer-python peers/bin/python --out sac.json
    python benchmarks/sac_speed.py --environments Pendulum-v1 --seeds 64 --steps 20000 --out sac.json
    python benchmarks/sac_speed.py --table sac.json

Ways: `sac` and `xqc` (the same with `--agent.bins`) here; sbx's `SAC` and `CrossQ`. SAC has the same networks,
minibatches, updates a step, rates, discount, target entropy and random steps here and there; CrossQ has its own
defaults. `Pendulum-v1` is `pendulum.py` here, which is step for step Gymnasium's.
"""

from __future__ import annotations

from typing import Any

from _comparing import compare, parser_of

from cuelearner_jax.agents.sac import SACConfig
from cuelearner_jax.config import Scalars, Schedule, Sizes
from cuelearner_jax.run_config import RunConfig

DISCOUNT, RATE, POLYAK = 0.99, 3e-4, 0.005


def main() -> None:
    """Measure, print and write."""
    parser = parser_of(__doc__, ["Pendulum-v1"], ["sac", "xqc", "SAC", "CrossQ"], seeds=5)
    parser.add_argument("--prefill", type=int, default=5_000, help="random steps before the first update")
    parser.add_argument("--layers", type=int, nargs="+", default=[256, 256])
    parser.add_argument("--batch-size", type=int, default=256)
    parser.add_argument("--updates-per-step", type=int, default=1)
    options = parser.parse_args()
    own = {name: getattr(options, name) for name in ("layers", "batch_size", "updates_per_step", "prefill")}
    setting = {**own, "discount": DISCOUNT, "rate": RATE, "polyak": POLYAK}
    schedule = Schedule(random_steps=options.prefill, learn_after=options.prefill, guidance_until=0)
    scalars = Scalars(discount=DISCOUNT, max_grad_norm=1e9)  # the peers do not clip

    def config(bins: bool) -> RunConfig:
        agent = SACConfig(
            actor_layers=tuple(options.layers),
            critic_layers=tuple(options.layers),
            bins=bins,
            batch_size=options.batch_size,
            updates_per_step=options.updates_per_step,
            replay_capacity=options.steps,
            actor_rate=RATE,
            critic_rate=RATE,
            temperature_rate=RATE,
            polyak=POLYAK,
        )
        return RunConfig(None, Sizes(num_envs=1), scalars, schedule, agent)

    elsewhere: dict[str, dict[str, Any]] = {"SAC": {}, "CrossQ": {}}
    compare(options, setting, {"sac": config(False), "xqc": config(True)}, elsewhere, base="SAC")


if __name__ == "__main__":
    main()
