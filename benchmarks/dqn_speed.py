"""Double DQN here over CleanRL's DQN and PureJaxQL's PQN: return over steps, and steps over seconds.

    python benchmarks/dqn_speed.py --environments CartPole-v1 Acrobot-v1 MountainCar-v0 --peer-python peers/bin/python \
        --cleanrl peers/cleanrl --purejaxql peers/purejaxql --out dqn.json

Ways: `ddqn` here; `explores`, the same with `--agent.exploration 0.05`; `CleanRL`, the `cleanrl/dqn_jax.py` of a
checkout, a process a seed; `PureJaxQL`, its `pqn_cartpole.yaml`, all seeds in one process. `ddqn` has CleanRL's layers,
minibatches, Adam and its rate, discount, replay, random steps before the first update, and a target network that is
copied every 500 steps. Not equal: `ddqn` makes one gradient step an environment step (CleanRL: one in ten), its later
actions are greedy, or random in 5% (CleanRL's random ones fall from all to 5% over the first half), its targets are
double, and the action is an input of its network. PQN has neither replay nor target network. Environments here are
those of `classic_control.py`, step for step Gymnasium's.
"""

from __future__ import annotations

from dataclasses import replace

from _comparing import compare, parser_of

from cuelearner_jax.agents.ddqn import DDQNConfig
from cuelearner_jax.config import Scalars, Schedule, Sizes
from cuelearner_jax.run_config import RunConfig

AGENT = DDQNConfig(  # as CleanRL by default
    q_layers=(120, 84),
    batch_size=128,
    replay_capacity=10_000,
    optimizer="adam",
    learning_rate=2.5e-4,
    polyak=1.0,
    target_every=500,
)


def main() -> None:
    """Measure, print and write."""
    parser = parser_of(__doc__, ["CartPole-v1"], ["ddqn", "explores", "CleanRL", "PureJaxQL"], seeds=4)
    parser.add_argument("--cleanrl", help="folder of a checkout of CleanRL")
    parser.add_argument("--purejaxql", help="folder of a checkout of PureJaxQL")
    options = parser.parse_args()
    schedule = Schedule(random_steps=10_000, learn_after=10_000, guidance_until=0)
    scalars = Scalars(discount=0.99, max_grad_norm=1e9)  # CleanRL does not clip
    agents = {"ddqn": AGENT, "explores": replace(AGENT, exploration=0.05)}
    here = {way: RunConfig(None, Sizes(num_envs=1), scalars, schedule, agent) for way, agent in agents.items()}
    elsewhere = {"CleanRL": {"folder": options.cleanrl}, "PureJaxQL": {"folder": options.purejaxql, "together": True}}
    compare(options, {}, here, elsewhere, base="CleanRL")


if __name__ == "__main__":
    main()
