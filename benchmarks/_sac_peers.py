"""Soft actor-critics of other packages on Gymnasium's Pendulum-v1, in a Python of their own.

    PYTHON benchmarks/_sac_peers.py sbx SETTING

SETTING is a JSON object: layers, batch_size, updates_per_step, prefill, steps, evaluations, episodes, discount, rate,
polyak, seed. One JSON object a line comes out for each evaluation: step, return (mean over episodes), seconds and steps
(of the training since the evaluation before). This file imports nothing of this project.
"""

# Peers are installed by whoever compares with them.
# pyright: reportMissingImports=false

from __future__ import annotations

import json
import sys
import time
from typing import Any

ENVIRONMENT = "Pendulum-v1"


def model_of(library: str, setting: dict[str, Any], env: Any) -> Any:
    """A soft actor-critic of `sb3` (Stable-Baselines3, PyTorch) or `sbx` (its counterpart in JAX)."""
    options: dict[str, Any] = {}
    if library == "sbx":
        from sbx import SAC
    else:
        from stable_baselines3 import SAC

        options["device"] = "cpu"
    return SAC(
        "MlpPolicy",
        env,
        learning_rate=setting["rate"],
        batch_size=setting["batch_size"],
        gradient_steps=setting["updates_per_step"],
        train_freq=1,
        learning_starts=setting["prefill"],
        buffer_size=setting["steps"],
        gamma=setting["discount"],
        tau=setting["polyak"],
        target_entropy=-0.5,  # of one entry, as brax has it
        seed=setting["seed"],
        policy_kwargs={"net_arch": list(setting["layers"])},
        **options,
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

    library, setting = sys.argv[1], json.loads(sys.argv[2])
    env, other = gymnasium.make(ENVIRONMENT), gymnasium.make(ENVIRONMENT)
    model = model_of(library, setting, env)
    every = setting["steps"] // setting["evaluations"]
    for number in range(setting["evaluations"]):
        began = time.perf_counter()
        model.learn(every, reset_num_timesteps=number == 0)
        seconds = time.perf_counter() - began
        earned = returned(model, other, setting["episodes"])
        told = {"step": (number + 1) * every, "return": earned, "seconds": seconds, "steps": every}
        print(json.dumps(told), flush=True)


if __name__ == "__main__":
    main()
