"""The reading on robots drawn by chance: how much of the loss comes back after 100 labels, and what becomes worse.

    python experiments/zoo.py --cues 3 --robots 29 --seeds 4 --out runs/zoo        # one group of robots
    python experiments/zoo.py --table runs/zoo --seeds 4                            # of all groups there
    python experiments/zoo.py --table docs/data/zoo.parquet --seeds 1 --record      # what the page shows

Each robot meets every error of `cuelearner_envs.zoo.ERRORS`, and a teacher who errs or speaks of one cue alone. Base
and corrected policy then play `JUDGED` episodes for the sequential test, and others that are reported. Nothing is
chosen on held-out robots. An accelerator reads all cells of a group side by side.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import results_figures

from cuelearner_envs import zoo
from cuelearner_jax.adaptation.judging import PairedTest, differences
from cuelearner_jax.devices import each_lane
from cuelearner_jax.reading import fitting
from cuelearner_jax.reading.fitting import Fit, Hypothesis, Reader
from cuelearner_jax.reading.linear import RelativeLabels
from cuelearner_jax.reading.posterior import habits
from cuelearner_jax.reading.session import BATCHES, FIRST, LEAST_EVIDENCE, MOST_WRONG
from cuelearner_jax.spaces import DIRECTIONS, Box, Space
from cuelearner_jax.storage.provenance import provenance

EPS = 0.05  # strength of an answer, as a share of the range
EPS_TURN = float(np.deg2rad(9.0))  # of directions [rad]
PLAYED = 10  # episodes between two batches of questions, from which situations are drawn
DATA = Path(__file__).resolve().parents[1] / "docs" / "data"
JUDGED, REPORTED = 50, 20  # episodes of the sequential test, and of the results
WORSE = 0.2  # difference of success that is more than the noise of `REPORTED` episodes
FAULTS = {"": (0.0, False), "20% wrong": (0.2, False), "one cue a label": (0.0, True)}
IN_FAMILY = ("nothing", "constant", "gain", "mixing", "seen_shift", "two")
FAULTY = ("constant", "seen_shift")  # errors that teachers with faults are tried with


class Cell(NamedTuple):
    """One robot in one changed world with one teacher."""

    robot: int
    error: int
    fault: str
    seed: int


class Asked(NamedTuple):
    """The state of one cell between batches of questions."""

    labels: RelativeLabels
    plain: Hypothesis
    smooth: Hypothesis
    fits: Fit  # all hypotheses
    fit: Fit  # the best of them
    evidence: jax.Array  # log of the test martingale [nats]


def space_of(robot: Any) -> Space:
    """Return the space of a robot's actions in half ranges, which is the same for all robots of a group."""
    return DIRECTIONS if robot.cues == 1 else Box((-1.0,) * robot.cues, (1.0,) * robot.cues)


def to_even(robot: Any, action: jax.Array) -> jax.Array:
    """Return an action in half ranges."""
    return action if robot.cues == 1 else (action - (robot.low + robot.high) / 2) / robot.half


def from_even(robot: Any, action: jax.Array) -> jax.Array:
    """Return an action of half ranges in the robot's own units."""
    return action if robot.cues == 1 else action * robot.half + (robot.low + robot.high) / 2


def reader_of(robot: Any) -> Reader:
    """Return the reader of a robot's answers, to which nothing of the observation is declared."""
    acts = lambda obs: to_even(robot, jax.vmap(partial(zoo.policy, robot))(obs))  # noqa: E731
    return Reader(space_of(robot), (), acts, jnp.float32(EPS_TURN if robot.cues == 1 else EPS))


def acts_of(world: Any, fit: Fit, corrects: jax.Array) -> Any:
    """Return a policy of one observation; `corrects`: by the fit, else as it was."""
    robot, reader = world.robot, reader_of(world.robot)
    own = lambda obs: from_even(robot, reader.act(fit, obs[None])[0])  # noqa: E731
    return lambda obs: jnp.where(corrects, own(obs), zoo.policy(robot, obs))


def ask(
    world: Any, state: Asked, key: jax.Array, number: jax.Array, wrong: jax.Array, one_cue: jax.Array
) -> tuple[RelativeLabels, jax.Array]:
    """Ask a batch of questions where the policy corrected so far goes, and predict the answers.

    Returns all labels so far, and the evidence.
    """
    robot, reader = world.robot, reader_of(world.robot)
    k_play, k_where, k_action, k_answer = jax.random.split(key, 4)
    count, begun = len(state.labels.valid) // BATCHES, number > 0
    act = acts_of(world, state.fit, begun)
    obs, states, *_ = jax.vmap(lambda key: zoo.rollout(key, world, act))(jax.random.split(k_play, PLAYED))
    obs, states = jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[2:]), (obs, states))
    rows = jax.random.randint(k_where, (count,), 0, len(obs))
    obs, states = jax.tree.map(lambda leaf: leaf[rows], (obs, states))
    spread = jnp.where(begun, jnp.maximum(reader.spread(state.fit, obs), reader.eps / 2), FIRST * reader.eps)
    away = spread * jax.random.normal(k_action, (count, robot.cues))
    action = reader.space.exp(to_even(robot, jax.vmap(act)(obs)), away)
    say = lambda key, state, action: zoo.answer(key, world, state, action, reader.eps, wrong, one_cue)  # noqa: E731
    answer = jax.vmap(say)(jax.random.split(k_answer, count), states, from_even(robot, action))
    new = RelativeLabels(obs, action, answer, jnp.ones(count, bool))
    at = number * count + jnp.arange(count)
    labels = RelativeLabels(*(leaf.at[at].set(part) for leaf, part in zip(state.labels, new, strict=True)))
    return labels, state.evidence + jnp.where(begun, reader.ratio(state.fits, new), 0.0)


def read(world: Any, labels: RelativeLabels, evidence: jax.Array, plain: Hypothesis, smooth: Hypothesis) -> Asked:
    """Read all labels so far; start from the hypotheses of the fit before."""
    fits = reader_of(world.robot).read(labels, plain, smooth)
    plain, smooth = fitting.again(fits)
    return Asked(labels, plain, smooth, fits, fitting.pick(fits, fitting.best_of(fits)), evidence)


def begun(world: Any, labels: int) -> Asked:
    """Return the state before the first question."""
    robot, size = world.robot, world.robot.order.shape[0]
    n = robot.low.shape[0]
    blank = RelativeLabels(
        jnp.zeros((labels, size)), jnp.zeros((labels, n)), jnp.zeros((labels, robot.cues)), jnp.zeros(labels, bool)
    )
    plain, smooth = fitting.unfitted(space_of(robot), (), size)
    shapes = jax.eval_shape(lambda: reader_of(robot).read(blank, plain, smooth))
    fits = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), shapes)
    return Asked(blank, plain, smooth, fits, fitting.pick(fits, 0), jnp.zeros(()))


def played(world: Any, before: Any, after: Any) -> dict[str, jax.Array]:
    """Return success and return of episodes: of the policy as it was, corrected, unchanged, and of the teacher.

    `before`, `after`: policies of one observation.
    """

    def several(key: jax.Array, count: int, world: Any, act: Any, **how: Any) -> tuple[jax.Array, jax.Array]:
        *_, total, done = jax.vmap(lambda key: zoo.rollout(key, world, act, **how))(jax.random.split(key, count))
        return done * 1.0, total

    ways = {
        "before": (JUDGED + REPORTED, world, before),
        "after": (JUDGED + REPORTED, world, after),
        "unchanged": (REPORTED, zoo.unchanged(world.robot), before),
    }
    found = {}
    for name, (count, where, act) in ways.items():
        key = jax.random.key(77 if count > REPORTED else 78)
        found[f"{name} success"], found[f"{name} return"] = several(key, count, where, act)
    right = lambda state: zoo.right(world, state)  # noqa: E731
    found["teacher success"], found["teacher return"] = several(jax.random.key(78), REPORTED, world, right, knows=True)
    return found


def covered(world: Any, state: Asked) -> jax.Array:
    """Return the share of right actions within their 95% interval, or eps / 2 of it, in situations of other episodes.

    Answers say no more than that: a teacher calls an action right within half of `eps`.
    """
    robot, reader = world.robot, reader_of(world.robot)
    obs, states, *_ = jax.vmap(lambda key: zoo.rollout(key, world, acts_of(world, state.fit, jnp.array(False))))(
        jax.random.split(jax.random.key(79), PLAYED)
    )
    obs, states = jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[2:])[::5], (obs, states))
    right = to_even(robot, jax.vmap(lambda state: zoo.right(world, state))(states))
    away = jnp.abs(reader.space.log(reader.act(state.fit, obs), right))
    return (away <= 1.96 * reader.spread(state.fit, obs) + reader.eps / 2).mean()


@partial(jax.jit, static_argnames="labels")
def _begun(worlds: Any, labels: int) -> Asked:
    return each_lane(lambda world: begun(world, labels))(worlds)


@jax.jit
def _ask(
    worlds: Any, state: Asked, keys: Any, number: Any, wrong: Any, one_cue: Any
) -> tuple[RelativeLabels, jax.Array]:
    one = lambda world, state, key, wrong, one_cue: ask(world, state, key, number, wrong, one_cue)  # noqa: E731
    return each_lane(one)(worlds, state, keys, wrong, one_cue)


@jax.jit
def _played(worlds: Any, states: Asked) -> dict[str, jax.Array]:
    def one(world: Any, state: Asked) -> dict[str, jax.Array]:
        before, after = (acts_of(world, state.fit, jnp.array(corrects)) for corrects in (False, True))
        return {**played(world, before, after), "covered": covered(world, state)}

    return each_lane(one)(worlds, states)


@jax.jit
def _wrong(fits: Fit) -> jax.Array:
    """Return the share of answers about something else, by each cell's fit."""
    return jax.vmap(lambda fit: habits(fit.posterior.hyper, 1.0).lapse)(fits)


def worlds_of(robots: Any, cells: list[Cell]) -> tuple[Any, jax.Array]:
    """Return the worlds of cells, stacked, and their keys."""
    rows = jnp.array([cell.robot for cell in cells]), jnp.array([cell.error for cell in cells])
    own = jax.tree.map(lambda leaf: leaf[rows[0]], robots)
    root = jax.random.key(5)
    keys = jax.vmap(lambda robot, error: jax.random.fold_in(jax.random.fold_in(root, robot), error))(*rows)
    worlds = jax.vmap(zoo.change)(keys, own, rows[1])
    return worlds, jax.vmap(jax.random.fold_in)(keys, jnp.array([cell.seed for cell in cells]))


def measure(robots: Any, cells: list[Cell], labels: int) -> list[dict[str, Any]]:
    """Return a row a cell."""
    worlds, keys = worlds_of(robots, cells)
    wrong, one_cue = (jnp.array(column) for column in zip(*(FAULTS[cell.fault] for cell in cells), strict=True))
    state = _begun(worlds, labels)
    for number in range(BATCHES):
        each = jax.vmap(lambda key, number=number: jax.random.fold_in(key, number))(keys)
        labelled = _ask(worlds, state, each, jnp.array(number), wrong, one_cue)
        # not one program: the parts that a fit repeats are compiled once
        state = each_lane(read)(worlds, *labelled, state.plain, state.smooth)
    values = jax.tree.map(np.asarray, _played(worlds, state))
    evidence = np.asarray(state.evidence)
    used = (evidence >= LEAST_EVIDENCE) & (np.asarray(_wrong(state.fit)) < MOST_WRONG)
    judged = [
        {end: values[f"{name} {end}"][:, :JUDGED] for end in ("success", "return")} for name in ("before", "after")
    ]
    test = PairedTest(len(cells))
    test.add(differences((judged[0], judged[1]), "success"))
    decided = {
        "evidence": evidence, "used_by_labels": used, "used_by_test": test.better,
        "covered": values.pop("covered"),
    }  # fmt: skip
    return rows_of(robots, cells, {**decided, **means_of(values)})


def means_of(values: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Return the means of the episodes that are reported, of what `played` returns."""
    return {name: each[:, -REPORTED:].mean(1) for name, each in values.items()}


def rows_of(robots: Any, cells: list[Cell], columns: dict[str, np.ndarray]) -> list[dict[str, Any]]:
    """Return a row a cell, from what was measured of all."""
    tasks, neural = np.asarray(robots.task), np.asarray(robots.neural)
    return [
        {
            "cues": int(robots.cues), "task": zoo.TASKS[int(tasks[cell.robot])], "neural": bool(neural[cell.robot]),
            "robot": cell.robot, "error": zoo.ERRORS[cell.error], "fault": cell.fault, "seed": cell.seed,
            **{name: column[place].item() for name, column in columns.items()},
        }
        for place, cell in enumerate(cells)
    ]  # fmt: skip


def cells_of(robots: int, seeds: int) -> list[Cell]:
    """Return the cells of a group."""
    faults = lambda error: FAULTS if zoo.ERRORS[error] in FAULTY else ("",)  # noqa: E731
    return [
        Cell(robot, error, fault, seed)
        for seed in range(seeds)
        for robot in range(robots)
        for error in range(len(zoo.ERRORS))
        for fault in faults(error)
    ]


def shares(rows: list[dict[str, Any]], used: Any) -> np.ndarray:
    """Return the share of each cell's loss of return that comes back, where the change costs a tenth of the return."""
    found = []
    for row in rows:
        loss = row["unchanged return"] - row["before return"]
        if loss > 0.1 * abs(row["unchanged return"]):
            gain = (row["after return"] - row["before return"]) * used(row)
            found.append(gain / loss)
    return np.array(found)


def is_worse(row: dict[str, Any]) -> bool:
    """Return whether the corrected policy is worse by more than the noise of 20 episodes."""
    fell = row["before success"] - row["after success"]
    lost = row["before return"] - row["after return"]
    return fell > WORSE or (fell >= 0 and lost > 0.1 * abs(row["before return"]) + 0.5)


def table(rows: list[dict[str, Any]]) -> None:
    """Print, for each error, the success and the share of the loss that comes back, and how many cells get worse."""
    rules = {
        "all": lambda row: True,
        "test": lambda row: row["used_by_test"],
        "labels": lambda row: row["used_by_labels"],
    }
    print(f"{'error':<28}{'cells':>6}  before after unchanged  loss back: median, worst tenth  worse: all test labels")
    kinds = dict.fromkeys((row["error"], row["fault"]) for row in rows)
    for kind in [*kinds, None]:
        own = [row for row in rows if kind in (None, (row["error"], row["fault"]))]
        mean = lambda name, own=own: np.mean([row[name] for row in own])  # noqa: E731
        back = shares(own, rules["all"])
        shown = f"{np.median(back):6.2f} {np.quantile(back, 0.1):6.2f}" if len(back) else "     -      -"
        worse = " ".join(f"{np.mean([is_worse(row) and rule(row) for row in own]):6.3f}" for rule in rules.values())
        name = "all" if kind is None else ", ".join(filter(None, kind))
        ends = f"{mean('before success'):6.2f} {mean('after success'):5.2f} {mean('unchanged success'):9.2f}"
        print(f"{name:<28}{len(own):>6}  {ends}  {shown}{'':<18}{worse}")
    for name in ("test", "labels"):
        back = shares(rows, rules[name])
        print(f"judged by {name}: loss back {np.median(back):.2f}, worst tenth {np.quantile(back, 0.1):.2f}")
    inside = [row["covered"] for row in rows if row["error"] in IN_FAMILY and not row["fault"]]
    print(f"right actions within their 95% intervals, where the change is in the family: {np.mean(inside):.3f}")
    still = [row for row in rows if row["error"] == "nothing"]
    print(f"nothing wrong: {sum(not row['used_by_labels'] for row in still)} of {len(still)} stay as they were")
    gained = [row for row in rows if row["after success"] - row["before success"] > WORSE]
    for name in ("test", "labels"):
        lost = sum(not row[f"used_by_{name}"] for row in gained)
        print(f"judged by {name}: {lost} of {len(gained)} gains are not used")


def success_of(rows: list[dict[str, Any]]) -> Iterator[tuple[str, str, str, list[float]]]:
    """Yield the success of each robot under each error, as the figure takes it."""
    for error, fault in dict.fromkeys((row["error"], row["fault"]) for row in rows):
        own = [row for row in rows if (row["error"], row["fault"]) == (error, fault)]
        robots = sorted({(row["cues"], row["robot"]) for row in own})
        label = ", ".join(filter(None, (error, fault))).replace("_", " ")
        for series, name in (("as it was", "before"), ("corrected", "after"), ("unchanged world", "unchanged")):
            each = [[row[f"{name} success"] for row in own if (row["cues"], row["robot"]) == r] for r in robots]
            yield f"{len(robots)} robots", series, label, [float(np.mean(values)) for values in each]


def group(cues: int, count: int, split: str) -> Any:
    """Return a group of robots, stacked."""
    draw = jax.jit(zoo.robots, static_argnames=("cues", "count", "split"))
    return draw(jax.random.key(0), cues=cues, count=count, split=split)


def measured(file: Path, cells: list[Cell], at_once: int, measure: Any) -> list[dict[str, Any]]:
    """Measure cells in parts, and write after each; a file that is there is gone on with."""
    rows = pq.read_table(file).to_pylist() if file.exists() else []
    file.parent.mkdir(parents=True, exist_ok=True)
    for first in range(len(rows), len(cells), at_once):
        part = cells[first : first + at_once]
        padded = part + [part[-1]] * (at_once - len(part))  # one program serves all parts
        rows += measure(padded)[: len(part)]
        print(f"{file.stem}: {len(rows)} of {len(cells)} cells", flush=True)
        about = {f"cuelearner.{name}": str(value) for name, value in provenance().items()}
        pq.write_table(pa.Table.from_pylist(rows).replace_schema_metadata(about), file, compression="zstd")
    return rows


def main() -> None:
    """Measure one group of robots, or print the table of all groups that were measured."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cues", type=int, choices=range(1, 8), default=3, help="group of robots; 1: directions")
    parser.add_argument("--robots", type=int, default=28)
    parser.add_argument("--seeds", type=int, default=4, help="of labels; of a table, the first so many")
    parser.add_argument("--labels", type=int, default=100)
    parser.add_argument("--split", choices=("tuning", "held_out"), default="held_out")
    parser.add_argument("--at-once", type=int, default=420, help="cells side by side")
    parser.add_argument("--out", type=Path, default=Path("runs/zoo"), help="folder for a Parquet file a group")
    parser.add_argument("--table", type=Path, help="print the table of this file or folder, and measure nothing")
    parser.add_argument("--record", action="store_true", help="with --table: write the figure's numbers")
    options = parser.parse_args()
    if options.table:
        rows = [row for row in pq.read_table(options.table).to_pylist() if row["seed"] < options.seeds]
        table(rows)
        if options.record:
            results_figures.write("zoo", success_of(rows))
        return
    robots = group(options.cues, options.robots, options.split)
    cells, file = cells_of(options.robots, options.seeds), options.out / f"{options.split}_{options.cues}.parquet"
    rows = measured(file, cells, options.at_once, lambda part: measure(robots, part, options.labels))
    table(rows)


if __name__ == "__main__":
    main()
