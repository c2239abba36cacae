"""Soft actor-critic here over that of sbx: return over steps, and steps over seconds, on tasks of Gymnasium.

    python benchmarks/sac_speed.py --environments Hopper-v5 Ant-v5 --peer-python peers/bin/python --out sac.json
    python benchmarks/sac_speed.py --environments Pendulum-v1 --seeds 64 --steps 20000 --out sac.json
    python benchmarks/sac_speed.py --table sac.json

Ways: `sac` and `xqc` (the same with `--agent.bins`) here; sbx's `SAC` and `CrossQ`; the SAC of `rejax`, for tasks that
gymnax has. SAC has the same networks, minibatches, updates a step, rates, discount, target entropy and random steps
here and there, but rejax takes its first steps by its policy; CrossQ has its own defaults. `Pendulum-v1` is that of
`classic_control.py`, step for step Gymnasium's. `playground:NAME` is a task of MuJoCo Playground, for ways from here.
"""

from __future__ import annotations

from typing import Any

from _comparing import compare, parser_of

from cuelearner_jax.agents.sac import SACConfig
from cuelearner_jax.config import Scalars, Schedule, Sizes
from cuelearner_jax.run_config import RunConfig

LAYERS = (256, 256)
SETTING: dict[str, Any] = {"layers": LAYERS, "batch_size": 256, "discount": 0.99, "rate": 3e-4, "polyak": 0.005}


def main() -> None:
    """Measure, print and write."""
    parser = parser_of(__doc__, ["Pendulum-v1"], ["sac", "xqc", "SAC", "CrossQ", "rejax"], seeds=5)
    parser.add_argument("--prefill", type=int, default=5_000, help="random steps before the first update")
    parser.add_argument("--envs", type=int, default=1, help="environments a seed here, with as many updates a step")
    options = parser.parse_args()
    setting = {**SETTING, "prefill": options.prefill, "envs": options.envs}
    schedule = Schedule(random_steps=options.prefill, learn_after=options.prefill, guidance_until=0)
    scalars = Scalars(discount=SETTING["discount"], max_grad_norm=1e9)  # the peers do not clip

    def config(bins: bool) -> RunConfig:
        agent = SACConfig(
            actor_layers=LAYERS,
            critic_layers=LAYERS,
            bins=bins,
            batch_size=SETTING["batch_size"],
            replay_capacity=options.steps,
            polyak=SETTING["polyak"],
            actor_rate=SETTING["rate"],
            critic_rate=SETTING["rate"],
            temperature_rate=SETTING["rate"],
        )
        return RunConfig(None, Sizes(num_envs=options.envs), scalars, schedule, agent)

    elsewhere: dict[str, dict[str, Any]] = {"SAC": {}, "CrossQ": {}, "rejax": {"together": True}}
    compare(options, setting, {"sac": config(False), "xqc": config(True)}, elsewhere, base="SAC")


if __name__ == "__main__":
    main()
