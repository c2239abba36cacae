"""Scripted arms of Fetch and Meta-World in changed worlds: what 100 labels bring back, mostly with nothing declared.

    python experiments/scripted_arms.py --robots FetchPush push --seeds 4 --out runs/scripted_arms
    python experiments/scripted_arms.py --table runs/scripted_arms     # of all robots there
    python experiments/scripted_arms.py --table docs/data/scripted_arms.parquet --record   # what the page shows

Needs the extra `gymnasium`, and for Meta-World `pip install --no-deps metaworld`. The policy is a script that knows
nothing of the change; the teacher is the same script on what is true, except in the worlds named "other way". Labels
are asked for, fitted and judged by the defaults of `cl.adapt`; `REPORTED` validation episodes measure. Where a camera
stands aside, a control has answers drawn by chance about the same actions. With `--judge-by success` the sequential
test decides whether a correction is used, with the same labels. Each robot has a file, which grows with each cell; what
is there is kept.
"""

from __future__ import annotations

import argparse
import importlib
import warnings
from collections.abc import Callable, Iterator, Sequence
from functools import cache, lru_cache, partial
from pathlib import Path
from typing import Any, NamedTuple, cast

import gymnasium
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import results_figures

import cuelearner_jax as cl
from cuelearner_envs.fetch import scripts
from cuelearner_jax.storage.provenance import provenance
from cuelearner_jax.tasks import fetch_layout

REPORTED = 50  # episodes of each measurement
EPS = 0.05  # strength of an answer, as a share of the range
WORSE = 0.15  # difference of success that is more than the noise of `REPORTED` episodes
TESTED = "labels, tested"  # kind of the rows where the sequential test decided
WITHIN = 0.02  # distance of a reach that counts as success [m]: 5 cm, as Fetch has it, forgive a camera aside
CENTRE = (1.3, 0.75)  # about which a camera over Fetch's table turns [m]
TASKS = (
    "reach", "push", "door-open", "door-close", "drawer-open", "drawer-close", "button-press", "pick-place",
    "peg-insert-side", "handle-press",
)  # fmt: skip


class Change(NamedTuple):
    """The change of a world."""

    aside: tuple[float, float] = (0.0, 0.0)  # what the camera sees is displaced [m]
    seen_turn: float = 0.0  # and turned about `CENTRE` [deg]
    turn: float = 0.0  # the executed motion is turned about the vertical [deg]
    gain: float = 1.0  # of the executed motion
    other_way: bool = False  # the teacher has a script of its own
    declared: bool = False  # the world tells the names and units of what is seen


class Robot(NamedTuple):
    """A scripted robot with an action of four entries, of which three move the gripper."""

    make: Callable[[], Any]
    script: Callable[[np.ndarray], np.ndarray]  # observations (n, obs) -> actions (n, 4)
    other: Callable[[np.ndarray], np.ndarray] | None  # another script for the same task
    seen: tuple[int, ...]  # where a position measured by the camera begins in an observation
    changes: dict[str, Change]


FETCH = {
    "nothing": Change(),
    "camera 3 cm aside": Change(aside=(0.0, 0.03)),
    "camera 3 cm aside, declared": Change(aside=(0.0, 0.03), declared=True),
    "camera turned by 25 degrees": Change(seen_turn=25.0),
    "other way": Change(other_way=True),
    "other way, camera 3 cm aside": Change(aside=(0.0, 0.03), other_way=True),
}
META_WORLD = {
    "nothing": Change(),
    "camera 5 cm aside": Change(aside=(0.05, 0.0)),
    "motion turned by 30 degrees": Change(turn=30.0),
    "gain 0.7": Change(gain=0.7),
}


class Changed(gymnasium.Wrapper):
    """A robot in a changed world. An episode ends with success where the robot's own episodes have no other end."""

    def __init__(self, robot: str, change: str) -> None:
        self.robot, self.change = robot_of(robot), robot_of(robot).changes[change]
        super().__init__(self.robot.make())

    def reset(self, **how: Any) -> tuple[np.ndarray, dict[str, Any]]:
        """Begin an episode."""
        obs, info = self.env.reset(**how)
        return seen(self.robot, self.change, obs[None])[0], info

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """Execute the changed action."""
        moved = motion(self.change, np.asarray(action, np.float32)[None])[0]
        obs, reward, terminated, truncated, info = self.env.step(moved)
        return seen(self.robot, self.change, obs[None])[0], float(reward), terminated, truncated, info


class Reach(gymnasium.Wrapper):
    """FetchReach whose success is a distance of `WITHIN`."""

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """Judge success anew."""
        obs, reward, terminated, truncated, info = self.env.step(action)
        near = np.linalg.norm(obs[:3] - obs[3:6]) < WITHIN
        return obs, float(reward), terminated, truncated, {**info, "is_success": float(near)}


class MetaWorld(gymnasium.Wrapper):
    """A task of Meta-World whose starts follow the seed, and whose episodes end with success.

    Its reset of the gripper's weld writes 11 numbers where MuJoCo 3.17 has 12 columns: the first 11 are filled.
    """

    def __init__(self, task: str) -> None:
        base: Any = importlib.import_module("metaworld.sawyer_xyz_env").SawyerMocapBase
        base.reset_mocap_welds = _reset_welds
        tasks: Any = importlib.import_module("metaworld.env_dict").ALL_V3_ENVIRONMENTS_GOAL_OBSERVABLE
        env = tasks[f"{task}-v3-goal-observable"](seed=0)
        env._freeze_rand_vec, env.seeded_rand_vec = False, True  # or else all episodes start alike
        super().__init__(env)

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[np.ndarray, dict[str, Any]]:
        """Begin an episode."""
        if seed is not None:
            cast(Any, self.env.unwrapped).seed(seed)
        obs, info = self.env.reset()
        return obs.astype(np.float32), info

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """Execute an action."""
        obs, reward, _, truncated, info = self.env.step(np.asarray(action, np.float32))
        done = bool(info["success"] > 0)
        return obs.astype(np.float32), float(reward), done, truncated, {**info, "is_success": float(done)}


def _reset_welds(env: Any) -> None:
    mujoco: Any = importlib.import_module("mujoco")
    for number in np.flatnonzero(env.model.eq_type == mujoco.mjtEq.mjEQ_WELD):
        env.model.eq_data[number][:11] = [0, 0, 0, 0, 0, 0, -1, 0, 0, 0, 5]


@cache
def robot_of(name: str) -> Robot:
    """Return a robot by name: FetchReach, FetchPush or a task of Meta-World."""
    if name.startswith("Fetch"):
        own = scripts.SCRIPTS[f"{name}-v4"]
        slow = scripts.Gains(along=6.0, side=10.0, back=0.085, ahead=0.04, lead=0.03, fastest=0.08)
        other = (lambda obs: own(obs) / 2) if name == "FetchReach" else partial(scripts.push, gains=slow)
        places = (3,) if name == "FetchReach" else (0, 3, 9)
        of_numpy = lambda script: lambda obs: np.asarray(script(np.asarray(obs, np.float32)))  # noqa: E731
        return Robot(partial(_fetch, name), of_numpy(own), of_numpy(other), places, FETCH)
    policies = importlib.import_module("metaworld.policies")
    names = {"peg-insert-side": "PegInsertionSide"}
    title = names.get(name, "".join(word.capitalize() for word in name.split("-")))
    policy = getattr(policies, f"Sawyer{title}V3Policy")()
    # A reading asks about many rows again.
    act = lru_cache(1 << 17)(lambda row: policy.get_action(np.frombuffer(row).copy()))  # scripts write into it
    with_each = lambda obs: np.stack([act(one.tobytes()) for one in np.asarray(obs, float)])  # noqa: E731
    script = lambda obs: np.clip(with_each(obs), -1, 1).astype(np.float32)  # noqa: E731
    return Robot(partial(MetaWorld, name), script, None, (4, 11, 22, 29, 36), META_WORLD)


def _fetch(name: str) -> Any:
    import gymnasium_robotics

    gymnasium.register_envs(gymnasium_robotics)
    env = gymnasium.wrappers.FlattenObservation(gymnasium.make(f"{name}-v4"))
    return Reach(env) if name == "FetchReach" else env


def seen(robot: Robot, change: Change, obs: np.ndarray, back: bool = False) -> np.ndarray:
    """Return observations (n, obs) as the camera gives them; `back`: the true ones, of these."""
    obs, turn = np.array(obs, np.float32), _turn(-change.seen_turn if back else change.seen_turn)
    aside = np.array(change.aside)
    for start in robot.seen:
        place = obs[:, start : start + 2]
        there = np.abs(obs[:, start : start + 3]).max(1, keepdims=True) > 0  # nothing is there: all zero
        moved = (place - aside * back - CENTRE) @ turn.T + CENTRE + aside * (not back)
        obs[:, start : start + 2] = np.where(there, moved, place)
    if len(robot.seen) == 3:  # Fetch with an object tells the way from the gripper to it too
        obs[:, 12:15] = obs[:, 9:12] - obs[:, 6:9]
    return obs


def motion(change: Change, action: np.ndarray, back: bool = False) -> np.ndarray:
    """Return actions (n, 4) as they are executed; `back`: those that are executed as given."""
    action = np.array(action, np.float32)
    gain = 1 / change.gain if back else change.gain
    action[:, :2] = action[:, :2] @ _turn(-change.turn if back else change.turn).T
    action[:, :3] *= gain
    return np.clip(action, -1, 1)


def _turn(degrees: float) -> np.ndarray:
    angle = np.deg2rad(degrees)
    return np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])


@cache
def world_of(robot: str, change: str) -> cl.World:
    """Return a changed world. Nothing of it is declared, not even names, unless the change says so."""
    layout = fetch_layout.layout_of(f"{robot}-v4") if robot_of(robot).changes[change].declared else None
    return cl.from_gymnasium(Changed, robot=robot, change=change, processes=1, observation=layout)


def success(policy: Any, world: cl.World) -> tuple[float, float]:
    """Return the mean success and return of validation episodes."""
    found = cl.measure(policy, world, episodes=REPORTED).metrics
    return float(found["success"][0]), float(found["return"][0])


def measure(name: str, change: str, seed: int, labels: int, judge_by: str) -> Iterator[dict[str, Any]]:
    """Yield the row of a cell, and of its control where a camera stands aside and labels judge."""
    robot, world = robot_of(name), world_of(name, change)
    altered = robot.changes[change]
    way = robot.other if altered.other_way and robot.other else robot.script
    teacher = lambda obs: motion(altered, way(seen(robot, altered, obs, back=True)), back=True)  # noqa: E731
    base = {"robot": name, "change": change, "seed": seed}
    base |= dict(zip(("unchanged", "unchanged return"), reference(name, "nothing"), strict=True))
    base |= dict(zip(("before", "before return"), reference(name, change), strict=True))
    policy = cl.adapt(robot.script, world, teacher, labels=labels, seed=seed, eps_deg=EPS, judge_by=judge_by)
    yield base | _row(TESTED if judge_by == "success" else "labels", policy, world)
    if judge_by == "success" or not any(altered.aside) or altered.other_way:
        return
    shape = np.asarray(policy.labels.answer).shape
    by_chance = policy.labels._replace(answer=np.random.default_rng(seed).integers(-1, 2, shape).astype(np.float32))
    yield base | _row("random", cl.adapt(robot.script, world, labels=by_chance, eps_deg=EPS, seed=seed), world)


def _row(kind: str, found: Any, world: cl.World) -> dict[str, Any]:
    result = found.result
    after = success(found, world) if found.used else (None, None)
    words = list(result.words())
    row = {"labels": kind, "used": found.used, "by labels": result.used, "rewarded steps": found.rewarded_steps}
    return row | {"after": after[0], "after return": after[1], "words": words}


@cache
def reference(name: str, change: str) -> tuple[float, float]:
    """Return success and return of the script as it was."""
    return success(robot_of(name).script, world_of(name, change))


def run(options: argparse.Namespace, name: str) -> None:
    """Measure a robot's cells that its file has not, and write after each."""
    out, seeds = options.out, range(options.first_seed, options.first_seed + options.seeds)
    file = out / f"{name}.parquet"
    rows = pq.read_table(file).to_pylist() if file.exists() else []
    done = {(row["change"], row["seed"]) for row in rows}
    out.mkdir(parents=True, exist_ok=True)
    for seed in seeds:
        for change in options.changes or robot_of(name).changes:
            if (change, seed) in done:
                continue
            for row in measure(name, change, seed, options.labels, options.judge_by):
                row["after"] = row["before"] if row["after"] is None else row["after"]
                row["after return"] = row["before return"] if row["after return"] is None else row["after return"]
                rows.append(row)
                print(
                    f"{name}, {change}, seed {seed}, {row['labels']}: {row['before']:.2f} -> {row['after']:.2f} "
                    f"(unchanged {row['unchanged']:.2f}; used {row['used']}; by labels {row['by labels']}; "
                    f"{row['rewarded steps']} steps) {'; '.join(row['words'])}",
                    flush=True,
                )
            about = {f"cuelearner.{key}": str(value) for key, value in provenance().items()}
            pq.write_table(pa.Table.from_pylist(rows).replace_schema_metadata(about), file, compression="zstd")


def table(rows: list[dict[str, Any]]) -> None:
    """Print, for each robot and change, success before, after and unchanged, and how many cells get worse."""
    kinds = dict.fromkeys((row["labels"], row["robot"], row["change"]) for row in rows if row["labels"] != "random")
    print(f"{'judge':<16}{'robot':<17}{'change':<30}cells before after unchanged  random  worse")
    for judge, *place in kinds:
        at = [row for row in rows if [row["robot"], row["change"]] == place]
        own, control = ([row for row in at if row["labels"] == kind] for kind in (judge, "random"))
        ends = [float(np.mean([row[name] for row in own])) for name in ("before", "after", "unchanged")]
        ends.append(float(np.mean([row["after"] for row in control])) if control and judge != TESTED else np.nan)
        shown, worse = "  ".join(f"{end:.2f}" for end in ends), sum(row["before"] - row["after"] > WORSE for row in own)
        print(f"{judge:<16}{place[0]:<17}{place[1]:<30}{len(own):>3}  {shown}  {worse}")
    for judge in dict.fromkeys(kind[0] for kind in kinds):
        own = [row for row in rows if row["labels"] == judge]
        shares = [share for row in own if np.isfinite(share := lost(row))]
        steps = np.median([row["rewarded steps"] for row in own])
        used = sum(row["used"] for row in own if row["change"] == "nothing")
        print(f"{judge}: of the lost success {np.mean(shares):.2f} comes back (mean of {len(shares)} cells that lose)")
        print(f"    nothing wrong, used: {used}; rewarded steps, median: {steps:,.0f}")


def lost(row: dict[str, Any]) -> float:
    """Return the share of the lost success that comes back; NaN where less than `WORSE` is lost."""
    loss = row["unchanged"] - row["before"]
    return (row["after"] - row["before"]) / loss if loss > WORSE else np.nan


def success_of(rows: list[dict[str, Any]]) -> Iterator[tuple[str, str, str, list[float]]]:
    """Yield the success of the cells of each change, as the figure takes it."""
    for panel in ("Fetch", "Meta-World"):
        group = [row for row in rows if row["robot"].startswith("Fetch") == (panel == "Fetch")]
        for change in dict.fromkeys(row["change"] for row in group):
            own = [row for row in group if row["change"] == change and row["labels"] == "labels"]
            control = [row for row in group if row["change"] == change and row["labels"] == "random"]
            series = (("as it was", own, "before"), ("corrected", own, "after"), ("unchanged", own, "unchanged"))
            for name, cells, end in (*series, ("random answers", control, "after")):
                if cells:
                    yield panel, name, change, [row[end] for row in cells]


def main(arguments: Sequence[str] | None = None) -> None:
    """Measure robots, or print the table of those that were measured."""
    names = ("FetchReach", "FetchPush", *TASKS)
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--robots", nargs="+", choices=names, default=names)
    parser.add_argument("--changes", nargs="+", default=(), help="default: all of each robot")
    parser.add_argument("--seeds", type=int, default=4, help="of labels")
    parser.add_argument("--first-seed", type=int, default=0)
    parser.add_argument("--labels", type=int, default=100)
    parser.add_argument("--judge-by", choices=("labels", "success"), default="labels")
    parser.add_argument("--out", type=Path, default=Path("runs/scripted_arms"), help="folder for a file a robot")
    parser.add_argument("--table", type=Path, help="print the table of this file or folder, and measure nothing")
    parser.add_argument("--record", action="store_true", help="with --table: write the figure's numbers")
    options = parser.parse_args(arguments)
    if options.table:
        rows = pq.read_table(options.table).to_pylist()
        table(rows)
        if options.record:
            results_figures.write("scripted_arms", success_of(rows))
        return
    warnings.simplefilter("ignore")  # that a correction is not used is a row
    for name in options.robots:
        run(options, name)


if __name__ == "__main__":
    main()
