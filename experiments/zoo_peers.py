"""Peers on the robots of the zoo: the same worlds, teachers and budgets of labels, learned by other kinds of guidance.

    python experiments/zoo_peers.py --kind relative --groups 3 --robots 29 --seeds 4
    python experiments/zoo_peers.py --table docs/data/zoo_peers.parquet   # beside the reading

A kind asks its own questions, as its method says, about what it has made of the policy's actions so far. `SETTINGS` are
compared on as many tuning robots, and the best of them is measured on held-out ones.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import _coach
import _energy
import _residual
import jax
import jax.numpy as jnp
import numpy as np
import pyarrow.parquet as pq
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

FITS: dict[str, Any] = {"normalise_obs": False, "fit_steps": 300, "fit_batch_size": 32}
SIZES = GuideSizes(feedback_layers=(64, 64), labels_per_round=20, question_every=5, **FITS)
KINDS: Mapping[str, type[Guide]] = {
    "relative": registry.find("relative"),
    "demonstration": _residual.Residual,
    "dcoach": _coach.CoachedCorrection,
    "bdcoach": _coach.BatchCoachedCorrection,
    "clic": _energy.CorrectingEnergy,
}
# strength of an answer and largest correction [half of a cue's range; 90 degrees], rate of learning
SETTINGS = tuple(
    (strength, most, rate)
    for strength, most in ((0.05, 0.15), (0.1, 0.3), (0.1, 0.6), (0.1, 1.2), (0.3, 0.6), (0.3, 1.2))
    for rate in (1e-3, 3e-3)
)


class Even(WholeObservations, struct.PyTreeNode):
    """A world of the zoo with actions in half ranges and observations in standard deviations."""

    world: zoo.ZooWorld
    mean: Float[Array, " obs"]
    deviation: Float[Array, " obs"]
    actions: Space = struct.field(pytree_node=False)
    observation: tuple[Quantity, ...] = struct.field(pytree_node=False)

    @classmethod
    def of(cls, world: zoo.ZooWorld, key: PRNGKeyArray) -> Even:
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
        return self.step_to(key, after, reward, jnp.array(False), after.steps >= zoo.STEPS, {}, {})

    def heuristic(self, obs: Float[Array, " obs"]) -> Float[Array, " action"]:
        """Return the action of the robot's policy."""
        return study.to_even(self.world.robot, zoo.policy(self.world.robot, obs * self.deviation + self.mean))

    def best_action(self, state: Any, obs: Float[Array, " obs"]) -> Float[Array, " action"]:
        """Return the teacher's action."""
        return study.to_even(self.world.robot, zoo.right(self.world, state))


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
    guidance = KINDS[kind](SIZES, spaces_of(env))
    unit = 90.0 if len(space.cues) == 1 else 0.5  # half of a cue's range: degrees of directions, else shares
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


def compare(kind: str, cues: int, options: argparse.Namespace) -> None:
    """Choose the setting that brings back most on tuning robots, and measure it on held-out ones."""
    mean = []
    for split in ("tuning", "held_out"):
        seeds = 1 if split == "tuning" else options.seeds
        robots, cells = study.group(cues, options.robots, split), cells_of(options.robots, seeds)
        chosen = SETTINGS if split == "tuning" else (SETTINGS[int(np.argmax(mean))],)
        for number, setting in enumerate(chosen):
            name = f"{kind}_{split}_{cues}{f'_{number}' if split == 'tuning' else ''}.parquet"
            one = partial(measure, robots, kind=kind, setting=setting, labels=options.labels)
            rows = study.measured(options.out / name, cells, options.at_once, one)
            back = study.shares(rows, lambda row: True)
            mean.append(np.clip(back, -1, 1).mean())
            print(kind, cues, split, setting, f"mean {mean[-1]:.3f}, median {np.median(back):.3f}", flush=True)


def table(peers: Path, beside: Path) -> None:
    """Print what each kind brings back on held-out robots, and the reading on the same cells without any judgement."""
    place = lambda row: tuple(row[name] for name in ("cues", "robot", "error", "fault", "seed"))  # noqa: E731
    read = {place(row): row for row in pq.read_table(beside / "zoo.parquet").to_pylist()}
    print("kind           cells  success before, after   loss back: median, worst tenth   worse   reading on these")
    rows = [row for row in pq.read_table(peers).to_pylist() if place(row) in read]
    for kind in dict.fromkeys(row["kind"] for row in rows):
        chosen = [row for row in rows if row["kind"] == kind]
        shown = ""
        for own in (chosen, [read[place(row)] for row in chosen]):
            back = study.shares(own, lambda row: True)
            ends = [np.mean([row[f"{end} success"] for row in own]) for end in ("before", "after")]
            ends += [np.median(back), np.quantile(back, 0.1), np.mean([study.is_worse(row) for row in own])]
            shown += "    " + "  ".join(f"{end:.3f}" for end in ends)
        print(f"{kind:<15}{len(chosen):>5}{shown}")


def main() -> None:
    """Measure one kind on groups of robots, or print the table of what was measured."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--kind", choices=tuple(KINDS), default="relative")
    parser.add_argument("--groups", type=int, nargs="+", choices=range(1, 8), default=[3], help="by number of cues")
    parser.add_argument("--robots", type=int, default=29)
    parser.add_argument("--seeds", type=int, default=4, help="of labels")
    parser.add_argument("--labels", type=int, default=100)
    parser.add_argument("--at-once", type=int, default=377, help="cells side by side")
    parser.add_argument("--out", type=Path, default=Path("runs/zoo_peers"), help="folder for Parquet files")
    parser.add_argument("--table", type=Path, help="print the table of this file, and measure nothing")
    parser.add_argument("--beside", type=Path, default=study.DATA, help="with --table: folder of the reading's data")
    options = parser.parse_args()
    if options.table:
        table(options.table, options.beside)
        return
    for cues in options.groups:
        compare(options.kind, cues, options)


if __name__ == "__main__":
    main()
