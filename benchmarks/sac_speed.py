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

import json
from dataclasses import replace
from typing import Any

from _comparing import compare, parser_of

from cuelearner_jax.agents.sac import SACConfig
from cuelearner_jax.config import Scalars, Schedule, Sizes, plain
from cuelearner_jax.run_config import RunConfig


def main() -> None:
    """Measure, print and write."""
    parser = parser_of(__doc__, ["Pendulum-v1"], ["sac", "xqc", "SAC", "CrossQ", "rejax"], seeds=5)
    parser.add_argument("--prefill", type=int, default=5_000, help="random steps before the first update")
    parser.add_argument("--batch-size", type=int, default=256, help="transitions in a minibatch")
    parser.add_argument("--envs", type=int, default=1, help="environments a seed here")
    parser.add_argument("--gradient-steps", type=int, default=0, help="after each step of all (0: as many as --envs)")
    parser.add_argument("--rate", type=float, default=3e-4, help="Adam's step size")
    parser.add_argument("--discount", type=float, default=0.99, help="of the next value")
    parser.add_argument("--replay", type=int, default=2**20, help="transitions kept")
    parser.add_argument("--agent", type=json.loads, default={}, help="options of `sac` here that differ, in JSON")
    options = parser.parse_args()
    own = ("prefill", "batch_size", "envs", "gradient_steps", "rate", "discount", "agent")
    setting: dict[str, Any] = {"layers": (256, 256), "polyak": 0.005, "replay": min(options.steps, options.replay)}
    setting |= {name: getattr(options, name) for name in own}
    sizes = Sizes(num_envs=options.envs, gradient_steps=options.gradient_steps)
    schedule = Schedule(random_steps=options.prefill, learn_after=options.prefill, guidance_until=0)
    scalars = Scalars(discount=options.discount, max_grad_norm=1e9)  # the peers do not clip
    values: dict[str, Any] = dict.fromkeys(("actor_rate", "critic_rate", "temperature_rate"), options.rate)
    values |= {"polyak": setting["polyak"], "batch_size": options.batch_size, "replay_capacity": setting["replay"]}
    base = SACConfig(**values | {name: plain(value) for name, value in options.agent.items()})
    agents = {"sac": base, "xqc": replace(base, bins=True)}
    here = {way: RunConfig(None, sizes, scalars, schedule, agent) for way, agent in agents.items()}
    elsewhere: dict[str, dict[str, Any]] = {"SAC": {}, "CrossQ": {}, "rejax": {"together": True}}
    compare(options, setting, here, elsewhere, base="SAC")


if __name__ == "__main__":
    main()
