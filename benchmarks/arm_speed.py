"""Steps a second of the arm's three skills, and of a plain loop of mjx.step round the same model.

    python benchmarks/arm_speed.py --grippers 4096 --write

One step is 0.04 s: four steps of the physics, observation, reward and automatic reset. Actions are random; observations
are added up, so that none is optimised away. "mjx.step" is a scan over as many steps of the physics alone, the state
carried whole (`mjx.Data`); the ratio says what the task adds, or saves by carrying less. Figures are medians over
rounds, compile time apart. Writes benchmarks/results/arm_speed.json with --write.
"""

from __future__ import annotations

import argparse
import json
import statistics
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp

from cuelearner_envs.arm import model as arm
from cuelearner_envs.arm.environment import Arm
from cuelearner_envs.arm.physics import compiled
from cuelearner_jax.storage.provenance import provenance
from cuelearner_jax.tasks import registry

RESULTS = Path(__file__).parent / "results" / "arm_speed.json"
SKILLS = ("reach", "push", "pick")


def whole(env: Arm, grippers: int, steps: int) -> tuple[Callable, Any]:
    """The task: a program of so many steps, and the state that it begins with."""

    @jax.jit
    def run(state: Any, key: jax.Array) -> tuple[Any, jax.Array]:
        def one(carry: tuple, key: jax.Array) -> tuple[tuple, None]:
            state, total = carry
            k_action, k_step = jax.random.split(key)
            actions = env.actions.sample(k_action, (grippers,))
            state, done = jax.vmap(env.step)(jax.random.split(k_step, grippers), state, actions)
            return (state, total + done.obs.sum() + done.reward.sum()), None

        return jax.lax.scan(one, (state, jnp.float32(0)), jax.random.split(key, steps))[0]

    return run, jax.jit(lambda keys: jax.vmap(env.reset)(keys)[0])(jax.random.split(jax.random.key(0), grippers))


def bare(env: Arm, grippers: int, steps: int) -> tuple[Callable, Any]:
    """Step the physics equally often in a plain loop, with random targets held for a control step."""
    from mujoco import mjx

    model, data, _ = compiled(env.has_object)
    begun = jax.jit(lambda keys: jax.vmap(env.reset)(keys)[0])(jax.random.split(jax.random.key(0), grippers)).body
    state = jax.jit(jax.vmap(lambda body: data.replace(qpos=body.qpos, qvel=body.qvel)))(begun)

    @jax.jit
    def run(state: Any, key: jax.Array) -> tuple[Any, jax.Array]:
        def one(state: Any, key: jax.Array) -> tuple[Any, None]:
            ctrl = state.qpos[:, : data.ctrl.shape[0]] + 0.05 * jax.random.normal(key, (grippers, data.ctrl.shape[0]))

            def inner(state: Any, _: None) -> tuple[Any, None]:
                with jax.default_matmul_precision("highest"):
                    return jax.vmap(lambda one: mjx.step(model, one))(state), None

            return jax.lax.scan(inner, state.replace(ctrl=ctrl), length=arm.SUBSTEPS)[0], None

        state = jax.lax.scan(one, state, jax.random.split(key, steps))[0]
        return state, state.qpos.sum()

    return run, state


def rates(run: Callable, state: Any, amount: int, rounds: int) -> tuple[list[float], float]:
    """Steps a second of each round, and the seconds that compiling and a first round took."""
    began = time.perf_counter()
    state, total = jax.block_until_ready(run(state, jax.random.key(1)))
    first, found = time.perf_counter() - began, []
    for number in range(rounds):
        began = time.perf_counter()
        state, total = jax.block_until_ready(run(state, jax.random.key(2 + number)))
        found.append(amount / (time.perf_counter() - began))
    if not jnp.isfinite(total):
        raise SystemExit("the observations are not finite: these figures mean nothing")
    return found, first


def main() -> None:
    """Measure and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--grippers", type=int, nargs="+", default=[256], help="side by side")
    parser.add_argument("--skills", nargs="+", default=SKILLS, choices=SKILLS)
    parser.add_argument("--steps", type=int, default=50, help="in a round")
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--write", type=Path, nargs="?", const=RESULTS, help="file (default: %(const)s)")
    asked = parser.parse_args()
    task, rows = registry.find("arm"), []
    for skill in asked.skills:
        env: Any = task.environment(task.configure(skill=skill))
        for grippers in asked.grippers:
            middles = []
            for name, make in (("task", whole), ("mjx.step", bare)):
                found, first = rates(
                    *make(env, grippers, asked.steps), amount=grippers * asked.steps, rounds=asked.rounds
                )
                middles.append(statistics.median(found))
                rows.append({"skill": skill, "grippers": grippers, "what": name, "steps_per_s": middles[-1]})
                rows[-1] |= {"lowest": min(found), "highest": max(found), "first_s": first}
                print(
                    f"{skill:6} {grippers:6d} grippers, {name:9}{middles[-1]:12,.0f} steps/s "
                    f"({min(found):,.0f} to {max(found):,.0f}), first round {first:.0f} s",
                    flush=True,
                )
            rows[-2]["ratio"] = middles[0] / middles[1]
            print(f"{skill:6} {grippers:6d} grippers, task over mjx.step: {rows[-2]['ratio']:.2f}", flush=True)
    if asked.write:
        asked.write.write_text(json.dumps({**provenance(), "rows": rows}, indent=1) + "\n")


if __name__ == "__main__":
    main()
