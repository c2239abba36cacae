"""Peers on the robots of the zoo: the same worlds, teachers and budgets of labels, learned by other kinds of guidance.

    python experiments/zoo_peers.py --kind relative --cues 3 --tuning                # compares all settings
    python experiments/zoo_peers.py --kind relative --cues 3 --setting 4 --seeds 4   # with the best of these

A kind asks its own questions, as its method says, about what it has made of the policy's actions so far. `SETTINGS` are
to be compared on tuning robots, and the best to be measured on held-out ones.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any

import _coach
import _energy
import _residual
import jax
import jax.numpy as jnp
import numpy as np
import zoo as study
from flax import struct
from jaxtyping import Array, Float, PRNGKeyArray

from cuelearner_envs import zoo
from cuelearner_jax import asking
from cuelearner_jax.adaptation.by_model import plain_scalars
from cuelearner_jax.config import GuideSizes, Scalars
from cuelearner_jax.devices import each_lane
from cuelearner_jax.environment import Quantity, WholeObservations, spaces_of
from cuelearner_jax.guides import registry
from cuelearner_jax.guides.base import Guide
from cuelearner_jax.policies import Guided, Heuristic
from cuelearner_jax.spaces import Space
from cuelearner_jax.types import Step

SIZES = GuideSizes(feedback_layers=(64, 64), labels_per_round=20, fit_steps=300, fit_batch_size=32, question_every=5)
KINDS: Mapping[str, type[Guide]] = {
    "relative": registry.find("relative"),
    "demonstration": _residual.Residual,
    "dcoach": _coach.CoachedCorrection,
    "bdcoach": _coach.BatchCoachedCorrection,
    "clic": _energy.CorrectingEnergy,
}
# strength of an answer and largest correction [half of a cue's range; 90 degrees], rate of learning
SETTINGS = tuple(product((0.1, 0.3), (0.6, 1.2), (1e-3, 3e-3)))


class Even(WholeObservations, struct.PyTreeNode):
    """A world of the zoo with actions in half ranges and observations in standard deviations, as networks take them."""

    world: zoo.World
    mean: Float[Array, " obs"]
    deviation: Float[Array, " obs"]
    actions: Space = struct.field(pytree_node=False)
    observation: tuple[Quantity, ...] = struct.field(pytree_node=False)

    @classmethod
    def of(cls, world: zoo.World, key: PRNGKeyArray) -> Even:
        """Return a world in the units of what the robot's policy meets in it."""
        act = lambda obs: zoo.policy(world.robot, obs)  # noqa: E731
        obs = jax.vmap(lambda key: zoo.rollout(key, world, act)[0])(jax.random.split(key, study.PLAYED))
        obs = obs.reshape(-1, obs.shape[-1])
        observation = (Quantity("observation", obs.shape[-1], "1"),)
        return cls(world, obs.mean(0), obs.std(0) + 1e-6, study.space_of(world.robot), observation)

    def observe(self, state: Any) -> Float[Array, " obs"]:
        """Return the observation in standard deviations."""
        return (zoo.observe(self.world, state) - self.mean) / self.deviation

    def reset(self, key: PRNGKeyArray) -> tuple[Any, Array]:
        """Begin an episode."""
        state = zoo.reset(key, self.world)
        return state, self.observe(state)

    def step(self, key: PRNGKeyArray, state: Any, action: Float[Array, " action"]) -> tuple[Any, Step]:
        """Execute an action; a new episode follows the last step of one."""
        after, reward = zoo.step(self.world, state, study.from_even(self.world.robot, action))
        ends, final = after.steps >= zoo.STEPS, self.observe(after)
        start, first = self.reset(key)
        step = Step(jnp.where(ends, first, final), final, final, reward, jnp.array(False), ends, {}, {})
        return jax.tree.map(lambda new, old: jnp.where(ends, new, old), start, after), step

    def heuristic(self, obs: Float[Array, " obs"]) -> Float[Array, " action"]:
        """Return the action of the robot's policy."""
        return study.to_even(self.world.robot, zoo.policy(self.world.robot, obs * self.deviation + self.mean))

    def best_action(self, state: Any, obs: Float[Array, " obs"]) -> Float[Array, " action"]:
        """Return the teacher's action."""
        return study.to_even(self.world.robot, zoo.right(self.world, state))


def unit_of(space: Space) -> float:
    """Return half of a cue's range in the unit of settings: shares, or degrees for directions."""
    return 90.0 if len(space.cues) == 1 else 0.5


def learn(
    guidance: Guide, world: Any, key: PRNGKeyArray, wrong: Array, scalars: Scalars, bound: Array, labels: int
) -> Any:
    """Return the policy of one observation that a kind has learned from labels."""
    k_model, k_env, k_lane, k_units = jax.random.split(key, 4)
    env = Even.of(world, k_units)
    scalars, base = replace(scalars, mistake_probability=wrong), Heuristic(env)
    guide = asking.start(guidance, env, labels, labels, k_model, k_env, SIZES)
    inquiry = asking.Inquiry(guidance, env, scalars, base, bound)
    for _ in range(labels // SIZES.labels_per_round):
        guide = asking.label_round(inquiry, SIZES, env, guide, k_lane)
    policy = Guided(base, guide.model, env, scalars, guidance, bound)
    return lambda obs: study.from_even(
        world.robot, policy.act(k_lane, None, ((obs - env.mean) / env.deviation)[None])[0]
    )


@partial(jax.jit, static_argnames=("guidance", "labels"))
def _measured(
    guidance: Guide, worlds: Any, keys: Array, wrong: Array, scalars: Scalars, bound: Array, labels: int
) -> Any:
    def one(world: Any, key: PRNGKeyArray, wrong: Array) -> dict[str, Array]:
        own = lambda obs: zoo.policy(world.robot, obs)  # noqa: E731
        return study.played(world, own, learn(guidance, world, key, wrong, scalars, bound, labels))

    return each_lane(one)(worlds, keys, wrong)


def measure(
    robots: Any, cells: list[study.Cell], kind: str, setting: tuple[float, float, float], labels: int
) -> list[dict[str, Any]]:
    """Return a row a cell."""
    worlds, keys = study.worlds_of(robots, cells)
    space, (strength, most, rate) = study.space_of(robots), setting
    env = Even.of(zoo.unchanged(jax.tree.map(lambda leaf: leaf[0], robots)), jax.random.key(0))
    of = KINDS[kind]
    guidance = of(SIZES, spaces_of(env))
    unit = unit_of(space)
    eps = strength * unit
    scalars = replace(
        plain_scalars(space), eps_deg=eps, tau_deg=eps / 20, tau_max_deg=most * unit, feedback_learning_rate=rate,
        max_grad_norm=10.0,
    )  # fmt: skip
    wrong = jnp.array([study.FAULTS[cell.fault][0] for cell in cells])
    bound = jnp.float32(space.from_unit(most * unit))
    values = _measured(guidance, worlds, keys, wrong, scalars, bound, labels)
    rows = study.rows_of(robots, cells, study.means_of(jax.tree.map(np.asarray, values)))
    return [{"kind": kind, "strength": strength, "most": most, "rate": rate, **row} for row in rows]


def cells_of(robots: int, seeds: int) -> list[study.Cell]:
    """Return the cells in which all cues are answered."""
    return [cell for cell in study.cells_of(robots, seeds) if not study.FAULTS[cell.fault][1]]


def main() -> None:
    """Measure one kind on one group of robots."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--kind", choices=tuple(KINDS), default="relative")
    parser.add_argument("--cues", type=int, choices=range(1, 8), default=3, help="group of robots; 1: directions")
    parser.add_argument("--robots", type=int, default=28)
    parser.add_argument("--seeds", type=int, default=4, help="of labels")
    parser.add_argument("--labels", type=int, default=100)
    parser.add_argument("--tuning", action="store_true", help="compare settings on tuning robots")
    parser.add_argument("--setting", type=int, choices=range(len(SETTINGS)), help="number of one of SETTINGS")
    parser.add_argument("--at-once", type=int, default=392, help="cells side by side")
    parser.add_argument("--out", type=Path, default=Path("runs/zoo_peers"), help="folder for Parquet files")
    options = parser.parse_args()
    split = "tuning" if options.tuning else "held_out"
    robots, cells = study.group(options.cues, options.robots, split), cells_of(options.robots, options.seeds)
    if options.tuning == (options.setting is not None):
        parser.error("give --tuning, or --setting with the best setting of tuning robots")
    for number, setting in enumerate(SETTINGS if options.tuning else (SETTINGS[options.setting],)):
        file = options.out / f"{options.kind}_{split}_{options.cues}{f'_{number}' if options.tuning else ''}.parquet"
        one = partial(measure, kind=options.kind, setting=setting, labels=options.labels)
        rows = study.measured(file, cells, options.at_once, lambda part, one=one: one(robots, part))
        back = study.shares(rows, lambda row: True)
        print(options.kind, setting, f"loss back: mean {np.clip(back, -1, 1).mean():.3f}, median {np.median(back):.3f}")


if __name__ == "__main__":
    main()
