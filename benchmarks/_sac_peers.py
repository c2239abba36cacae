"""Soft actor-critics of sbx on a task of Gymnasium, in a Python of their own.

    PYTHON benchmarks/_sac_peers.py SAC SETTING

SETTING is a JSON object: name (of the environment), layers, batch_size, updates_per_step, prefill, steps, evaluations,
episodes, discount, rate, polyak, seed. One JSON object a line comes out for each evaluation: step, return (mean over
episodes), seconds (of the training since the evaluation before). This file imports nothing of this project.
"""

# Peers are installed by whoever compares with them.
# pyright: reportMissingImports=false

from __future__ import annotations

import json
import sys
import time
from typing import Any


def model_of(way: str, setting: dict[str, Any], env: Any) -> Any:
    """`SAC` by the setting, or `CrossQ` by its own defaults."""
    import sbx

    shared = {"learning_starts": setting["prefill"], "buffer_size": setting["steps"], "seed": setting["seed"]}
    if way == "CrossQ":
        return sbx.CrossQ("MlpPolicy", env, **shared)
    return sbx.SAC(
        "MlpPolicy",
        env,
        learning_rate=setting["rate"],
        batch_size=setting["batch_size"],
        gradient_steps=setting["updates_per_step"],
        train_freq=1,
        gamma=setting["discount"],
        tau=setting["polyak"],
        policy_kwargs={"net_arch": list(setting["layers"])},
        **shared,
    )


def returned(model: Any, env: Any, episodes: int) -> float:
    """The mean return of deterministic episodes."""
    total = 0.0
    for episode in range(episodes):
        obs, done = env.reset(seed=1000 + episode)[0], False
        while not done:
            obs, reward, terminated, truncated, _ = env.step(model.predict(obs, deterministic=True)[0])
            total, done = total + float(reward), terminated or truncated
    return total / episodes


def main() -> None:
    """Train, and print a line for each evaluation."""
    import gymnasium

    way, setting = sys.argv[1], json.loads(sys.argv[2])
    env, other = gymnasium.make(setting["name"]), gymnasium.make(setting["name"])
    model = model_of(way, setting, env)
    every = setting["steps"] // setting["evaluations"]
    for number in range(setting["evaluations"]):
        began = time.perf_counter()
        model.learn(every, reset_num_timesteps=number == 0)
        seconds = time.perf_counter() - began
        earned = returned(model, other, setting["episodes"])
        print(json.dumps({"step": (number + 1) * every, "return": earned, "seconds": seconds}), flush=True)


if __name__ == "__main__":
    main()
