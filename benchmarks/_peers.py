"""Agents of sbx, rejax, CleanRL and PureJaxQL on a task of Gymnasium, in a Python of their own.

    PYTHON benchmarks/_peers.py WAY SETTING

WAY is `SAC` or `CrossQ` (sbx), `rejax` (its SAC), `CleanRL` or `PureJaxQL`. SETTING is a JSON object: name (of the
environment), seeds (a list), steps, evaluations, episodes; further layers, batch_size, prefill, replay, discount, rate
and polyak for SAC, and folder, that of a checkout, for the last two. One JSON object a line comes out for each
evaluation: step, returns (of seeds, mean over episodes), seconds (of the training since the evaluation before). Nothing
of this project is imported.
"""

# Peers are installed by whoever compares with them.
# pyright: reportMissingImports=false

from __future__ import annotations

import json
import runpy
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

Choose = Callable[[Any], Any]  # an observation -> an action


def tell(setting: dict[str, Any], step: int, seconds: float, policies: list[Choose]) -> None:
    """Print the mean return of deterministic episodes of each policy."""
    import gymnasium

    env, returns = gymnasium.make(setting["name"]), []
    for policy in policies:
        total = 0.0
        for episode in range(setting["episodes"]):
            obs, done = env.reset(seed=1000 + episode)[0], False
            while not done:
                obs, reward, terminated, truncated, _ = env.step(policy(obs))
                total, done = total + float(reward), terminated or truncated
        returns.append(total / setting["episodes"])
    print(json.dumps({"step": step, "returns": returns, "seconds": seconds}), flush=True)


def sbx(way: str, setting: dict[str, Any]) -> None:
    """Train `SAC` by the setting, or `CrossQ` by its own defaults."""
    import gymnasium
    import sbx

    (seed,) = setting["seeds"]
    shared = {"learning_starts": setting["prefill"], "buffer_size": setting["replay"], "seed": seed}
    own = {
        "learning_rate": setting["rate"],
        "batch_size": setting["batch_size"],
        "gamma": setting["discount"],
        "tau": setting["polyak"],
        "policy_kwargs": {"net_arch": list(setting["layers"])},
    }
    env = gymnasium.make(setting["name"])
    model = getattr(sbx, way)("MlpPolicy", env, **shared, **(own if way == "SAC" else {}))
    every = setting["steps"] // setting["evaluations"]
    for number in range(setting["evaluations"]):
        began = time.perf_counter()
        model.learn(every, reset_num_timesteps=number == 0)
        policy = lambda obs: model.predict(obs, deterministic=True)[0]  # noqa: E731
        tell(setting, (number + 1) * every, time.perf_counter() - began, [policy])


def rejax(way: str, setting: dict[str, Any]) -> None:
    """Train rejax's SAC in gymnax's environment of the same name, all seeds side by side."""
    import jax
    import jax.numpy as jnp
    from rejax import SAC

    every = setting["steps"] // setting["evaluations"]
    agent = SAC.create(
        env=setting["name"],
        hidden_layer_sizes=setting["layers"],
        learning_rate=setting["rate"],
        gamma=setting["discount"],
        polyak=1 - setting["polyak"],
        batch_size=setting["batch_size"],
        fill_buffer=setting["prefill"],
        buffer_size=setting["replay"],
        total_timesteps=every,
        eval_freq=every,
        skip_initial_evaluation=True,
    ).replace(eval_callback=lambda *_: ())
    keys = jnp.stack([jax.random.key(seed) for seed in setting["seeds"]])
    states = jax.jit(jax.vmap(agent.init_state))(keys)
    program = jax.jit(jax.vmap(lambda state: agent.train(train_state=state)[0])).lower(states).compile()

    @jax.jit
    def middle(params: Any, obs: Any) -> Any:
        distribution = agent.actor.apply(params, obs[None], method="_action_dist")
        return (agent.actor.action_loc + agent.actor.action_scale * jnp.tanh(distribution.loc))[0]

    for number in range(setting["evaluations"]):
        began = time.perf_counter()
        states = jax.block_until_ready(program(states))
        seconds = time.perf_counter() - began
        own = [jax.tree.map(lambda leaf, row=row: leaf[row], states.actor_ts.params) for row in range(len(keys))]
        policies = [lambda obs, params=params: jax.device_get(middle(params, obs)) for params in own]
        tell(setting, (number + 1) * every, seconds, policies)


def cleanrl(way: str, setting: dict[str, Any]) -> None:
    """Run CleanRL's script with its own defaults. Evaluations come where the script logs, and at its end."""
    import jax
    import torch.utils.tensorboard

    (seed,), every = setting["seeds"], setting["steps"] // setting["evaluations"]
    began = time.perf_counter()

    def evaluate(names: dict[str, Any], step: int) -> None:
        nonlocal began
        seconds, params = time.perf_counter() - began, names["q_state"].params
        values = jax.jit(names["q_network"].apply)
        tell(setting, step, seconds, [lambda obs: int(values(params, obs).argmax())])
        began = time.perf_counter()

    class Writer:
        """Takes the place of tensorboard's."""

        def __init__(self, *_: Any) -> None:
            self.add_text = self.close = lambda *_: None

        def add_scalar(self, tag: str, _: Any, step: int) -> None:
            if tag == "charts/SPS" and step % every == 0:
                evaluate(sys._getframe(1).f_globals, step)

    torch.utils.tensorboard.SummaryWriter = Writer
    sys.path.insert(0, setting["folder"])
    script = str(Path(setting["folder"], "cleanrl", "dqn_jax.py"))
    sys.argv = [script, "--seed", str(seed), "--env-id", setting["name"], "--total-timesteps", str(setting["steps"])]
    evaluate(runpy.run_path(script, run_name="__main__"), setting["steps"])


def purejaxql(way: str, setting: dict[str, Any]) -> None:
    """Train PQN with PureJaxQL's own options, all seeds side by side.

    The training is one compiled program. So every evaluation has a training of its own, up to its step (rounded down to
    whole updates) with the schedules of the whole one: the same training, by the same random keys.
    """
    sys.path.insert(0, str(Path(setting["folder"], "purejaxql")))
    import jax
    import pqn_gymnax
    from omegaconf import OmegaConf

    file = Path(setting["folder"], "purejaxql", "config", "alg", "pqn_cartpole.yaml")
    config: Any = OmegaConf.to_container(OmegaConf.load(file))
    config |= {"ENV_NAME": setting["name"], "TOTAL_TIMESTEPS_DECAY": setting["steps"], "TEST_DURING_TRAINING": False}
    keys, before = jax.random.split(jax.random.PRNGKey(0), len(setting["seeds"])), 0.0
    for number in range(setting["evaluations"]):
        step = setting["steps"] // setting["evaluations"] * (number + 1)
        train = pqn_gymnax.make_train({**config, "TOTAL_TIMESTEPS": step, "WANDB_MODE": "disabled"})
        program = jax.jit(jax.vmap(train)).lower(keys).compile()
        began = time.perf_counter()
        state = jax.block_until_ready(program(keys))["runner_state"][0]
        seconds, apply = time.perf_counter() - began, jax.jit(state.apply_fn, static_argnames="train")

        def policy(seed: int, state: Any = state, apply: Any = apply) -> Choose:
            leaves = jax.tree.map(lambda leaf: leaf[seed], {"params": state.params, "batch_stats": state.batch_stats})
            return lambda obs: int(apply(leaves, obs[None], train=False).argmax())

        tell(setting, step, seconds - before, [policy(seed) for seed in range(len(keys))])
        before = seconds


if __name__ == "__main__":
    way, setting = sys.argv[1], json.loads(sys.argv[2])
    {"rejax": rejax, "CleanRL": cleanrl, "PureJaxQL": purejaxql}.get(way, sbx)(way, setting)
