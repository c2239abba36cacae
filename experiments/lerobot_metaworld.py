"""A picture policy of LeRobot (ACT) in changed worlds of Meta-World, corrected by 100 labels.

    python experiments/lerobot_metaworld.py collect --task reach-v3 --out runs/lerobot_metaworld
    python experiments/lerobot_metaworld.py train --task reach-v3 --minutes 4.5     # runs `lerobot-train`
    python experiments/lerobot_metaworld.py evaluate --task reach-v3                # before, labels, after
    python experiments/lerobot_metaworld.py table

`all` does the first three. 50 episodes of the script with pictures become a LeRobot dataset (v3.0), which
`lerobot-train` reads. The camera is moved, or the motion is changed. 100 situations, of failed episodes where there are
any, up to the usual length of a demonstration, are labelled in four rounds by a program that knows the script, with a
person's slips. The answers are about the way of the hand, not about its speed. The correction acts beside
the policy, on the hand's state, the proposed action and the phase in the chunk; with the effects of the state, also on
the state that the policy sees. Labels alone decide whether it is used. Beside it stand answers drawn by chance,
pictures moved back without labels, and a policy without pictures. Each task has a file, which grows with each cell.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import signal
import subprocess
import sys
import time
import warnings
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

os.environ.setdefault("JAX_PLATFORMS", "cpu")  # the GPU is the policy's
os.environ.setdefault("HF_HUB_OFFLINE", "1")
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from _metaworld_pictures import CHANGES, SIZE, TASKS, TUNING, Episode, Plan, Robots
from lerobot.datasets.lerobot_dataset import LeRobotDataset

DEMONSTRATIONS, REPORTED = 50, 50  # episodes
CHUNK, EXECUTED = 20, 10  # steps that ACT proposes at once, and those that are executed
LABELS, ROUNDS, SITUATIONS = 100, 4, 6  # situations met for each question
MISTAKEN, SILENT = 0.05, 0.1  # shares of the answers about a cue
TRAIN_SEED, LABEL_SEED, REPORT_SEED = 0, 100_000, 200_000  # of episodes
CUES = ("right,left", "forward,back", "up,down", ",")  # of the gripper nothing is said
TUNED = "camera 10 cm aside"  # the change in which fine-tuning is measured
EPS = 0.05  # strength of an answer, as a share of the range
SIDES = 0.05  # by which a state is shifted to see its effect, as a share of its range
ACT = {
    "type": "act", "push_to_hub": "false", "pretrained_backbone_weights": "null", "chunk_size": CHUNK,
    "n_action_steps": EXECUTED, "dim_model": 256, "dim_feedforward": 1024, "optimizer_lr": 1e-4,
    "optimizer_lr_backbone": 1e-4, "n_encoder_layers": 4, "kl_weight": 10,
}  # fmt: skip


def collect(robots: Robots, folder: Path, change: str, first_seed: int, count: int) -> None:
    """Write demonstrations as a LeRobot dataset."""
    episodes = robots.demonstrations(change, first_seed, count)
    shape = episodes[0].pictures.shape[1:]
    features = {
        "observation.image": {"dtype": "image", "shape": shape, "names": ["height", "width", "channels"]},
        "observation.state": {"dtype": "float32", "shape": (4,), "names": ["x", "y", "z", "opening"]},
        "action": {"dtype": "float32", "shape": (4,), "names": ["x", "y", "z", "grip"]},
    }
    dataset = LeRobotDataset.create("local/metaworld", fps=80, features=features, root=folder, use_videos=False)
    for episode in episodes:
        for picture, state, action in zip(*episode, strict=True):
            row = {"observation.image": picture, "observation.state": state, "action": action, "task": folder.name}
            dataset.add_frame(row)
        dataset.save_episode()
    dataset.finalize()


def without_pictures(dataset: Path, out: Path) -> None:
    """Write a dataset with the state in the place of pictures."""
    table = pq.read_table(dataset / "data", columns=["observation.state", "action", "episode_index"]).to_pydict()
    state = "observation.state"
    entries = {"observation.environment_state": state, state: state, "action": "action"}
    features = {name: {"dtype": "float32", "shape": (4,), "names": None} for name in entries}
    written = LeRobotDataset.create("local/metaworld", fps=80, features=features, root=out, use_videos=False)
    for row, episode in enumerate(table["episode_index"]):
        if row and episode != table["episode_index"][row - 1]:
            written.save_episode()
        values = {name: np.asarray(table[of][row], np.float32) for name, of in entries.items()}
        written.add_frame({**values, "task": "state"})
    written.save_episode()
    written.finalize()


def train(dataset: Path, out: Path, seconds: float, sizes: dict[str, Any], base: Path | None = None) -> None:
    """Run `lerobot-train` for a wall time, and keep its last checkpoint."""
    shutil.rmtree(out, ignore_errors=True)
    policy = {"path": base, "push_to_hub": "false"} if base else ACT | sizes["act"] | {"device": sizes["device"]}
    words = {f"policy.{name}": value for name, value in policy.items()}
    words |= {"dataset.repo_id": "local/metaworld", "dataset.root": dataset, "output_dir": out, "steps": 10**6}
    words |= {"batch_size": sizes["batch"], "save_freq": sizes["save"], "num_workers": sizes["workers"]}
    words |= {"env_eval_freq": 0, "log_freq": sizes["save"], "dataloader_multiprocessing_context": "fork"}
    words |= {"dataset.discover_packages_path": "_lerobot_columns"}  # or else 12 workers feed 4 steps a second
    path = os.pathsep.join([str(Path(__file__).parent), os.environ.get("PYTHONPATH", "")])
    command = [sys.executable, "-m", "lerobot.scripts.lerobot_train", *(f"--{n}={v}" for n, v in words.items())]
    with (out.parent / f"{out.name}.log").open("w") as log:
        how: Any = {"env": os.environ | {"PYTHONPATH": path}, "start_new_session": True}
        work = subprocess.Popen(command, stdout=log, stderr=subprocess.STDOUT, **how)
        try:
            work.wait(seconds)
        except subprocess.TimeoutExpired:
            os.killpg(work.pid, signal.SIGKILL)
            work.wait()
    checkpoint(out)


def checkpoint(out: Path) -> Path:
    """Return the last checkpoint of a training that is whole. Raises FileNotFoundError where there is none."""
    last = out / "checkpoints" / "last"
    if not last.exists():
        raise FileNotFoundError(f"{out} has no checkpoint: read {out}.log")
    return last / "pretrained_model"


def planner(place: Path, device: str, places: np.ndarray | None = None) -> Plan:
    """Return a checkpoint's chunks, by LeRobot's own processors; `places`: where pictures are moved back from."""
    import torch
    from lerobot.policies.act.modeling_act import ACTPolicy
    from lerobot.policies.factory import make_pre_post_processors
    from lerobot_processor_cuelearner.pictures import moved_back

    policy = ACTPolicy.from_pretrained(place).to(device).eval()
    where = {"device_processor": {"device": device}}
    before, after = make_pre_post_processors(policy.config, str(place), preprocessor_overrides=where)

    def plan(pictures: np.ndarray, states: np.ndarray) -> np.ndarray:
        rows = dict.fromkeys(("observation.state", "observation.environment_state"), torch.from_numpy(states))
        if policy.config.image_features:
            image = torch.from_numpy(np.ascontiguousarray(pictures)).permute(0, 3, 1, 2).float() / 255
            rows["observation.image"] = image if places is None else moved_back(image, torch.from_numpy(places))
        with torch.inference_mode():
            return after(policy.predict_action_chunk(before(rows))).float().cpu().numpy()

    return plan


class Labeller:
    """Labels about a policy in a changed world, and the correction that they give."""

    def __init__(self, seed: int, early: int) -> None:
        """`early`: number of first steps of an episode that are asked about."""
        import jax

        import cuelearner_jax as cl  # noqa: F401
        from cuelearner_jax.environment import BASE, EFFECT
        from cuelearner_jax.policies import Heuristic
        from cuelearner_jax.reading import Reading, declared_distortions
        from cuelearner_jax.tasks import logs

        names = {"names": ("x", "y", "z", "opening", "phase", EFFECT, BASE), "entries": (1, 1, 1, 1, 1, 16, 4)}
        env = logs.filled(logs.LogsConfig(**names, low=(-1.0,) * 4, high=(1.0,) * 4, cues=CUES))
        self.space, self.random, self.key = env.actions, np.random.default_rng(seed), jax.random.key(seed)
        about = (declared_distortions(env), env.actions, EPS, LABELS, env.observation)
        self.make = lambda: Reading(Heuristic(env.view()), *about)
        self.early, self.reading = early, self.make()
        self.alike: list[np.ndarray] = []  # cosines of the script's way and the proposed one

    @property
    def shift(self) -> np.ndarray:
        """The shift of the state that the policy sees (4,), in the state's units."""
        if self.reading.fit is None:
            return np.zeros(4, np.float32)
        return -np.asarray(self.reading.policy().correction.change.theta, np.float32)

    def correct(self, inputs: np.ndarray) -> np.ndarray:
        """Return corrected actions of a policy that sees the shifted state; rows are filled up for one program."""
        rows = np.concatenate([inputs, np.repeat(inputs[-1:], -len(inputs) % 32, 0)])
        rows[:, -4:] += np.einsum("s,nsa->na", self.shift, rows[:, 5:21].reshape(len(rows), 4, 4))
        rows[:, 5:21] = 0
        return np.asarray(self.reading.act(rows))[: len(inputs)]

    def ask(self, episodes: Sequence[Episode], count: int) -> None:
        """Ask about early situations of failed episodes, or of all where none failed.

        Later ones are those of a robot that has gone wrong already: what the script does there is no correction.
        """
        import jax

        failed, early = [one for one in episodes if not one.success] or episodes, slice(self.early)
        inputs = np.concatenate([one.inputs[early] for one in failed])
        intended = np.concatenate([one.intended[early] for one in failed])
        intended, ways = as_fast(intended, inputs[:, -4:]), inputs[:, -4:-1]
        self.alike.append((ways * intended[:, :3]).sum(1) / np.maximum((ways**2).sum(1), 1e-6))
        some = self.random.choice(len(inputs), min(SITUATIONS * count, len(inputs)), replace=False)
        self.key, key = jax.random.split(self.key)
        index, action = self.reading.questions(inputs[some], count, key)
        self.reading.learn(inputs[some][index], action, self.answers(action, intended[some][index]))

    def answers(self, action: np.ndarray, intended: np.ndarray) -> np.ndarray:
        """Return a person's answers about each cue: some are mistaken, and of some nothing is said."""
        from cuelearner_jax.spaces import UNSAID

        off = np.asarray(self.space.log(action, intended))
        answer = np.where(np.abs(off) <= EPS / 2, 0.0, np.sign(off))
        chance = self.random.random(off.shape)
        answer = np.where(chance < MISTAKEN, self.random.integers(-1, 2, off.shape), answer)
        is_asked = [cue.is_asked for cue in self.space.cues]
        return np.where(is_asked & (chance <= 1 - SILENT), answer, UNSAID).astype(np.float32)

    def shuffled(self) -> Labeller:
        """Return what answers drawn by chance about the same actions give."""
        from cuelearner_jax.spaces import UNSAID

        rows, self.reading = self.reading.rows, self.make()
        assert rows is not None
        answer = np.where(rows.answer == UNSAID, UNSAID, self.random.integers(-1, 2, np.shape(rows.answer)))
        self.reading.read_in_batches(np.asarray(rows.obs), np.asarray(rows.action), answer.astype(np.float32))
        return self


def as_fast(intended: np.ndarray, proposed: np.ndarray) -> np.ndarray:
    """Return actions (n, 4) that lead where the intended ones lead, as fast as proposed: a person sees that."""
    lengths = [np.linalg.norm(one[:, :3], axis=1, keepdims=True) for one in (proposed, intended)]
    return np.concatenate([intended[:, :3] * lengths[0] / np.maximum(lengths[1], 1e-6), intended[:, 3:]], 1).clip(-1, 1)


class Cells:
    """The measurements of a task; those that its file has are not repeated."""

    def __init__(self, robots: Robots, plan: Any, folder: Path, options: argparse.Namespace) -> None:
        self.robots, self.plan, self.options, self.file = robots, plan, options, folder / "cells.parquet"
        rows = pq.read_table(folder / "dataset" / "data", columns=["observation.state", "frame_index"])
        states = np.stack(rows["observation.state"].to_numpy())
        self.widths = SIDES * np.ptp(states, 0)
        self.early = round(len(states) / np.sum(rows["frame_index"].to_numpy() == 0))  # length of a demonstration
        self.rows: list[dict[str, Any]] = pq.read_table(self.file).to_pylist() if self.file.exists() else []
        self.bases: dict[str, np.ndarray] = {}  # success of the policy's episodes in each world

    def played(self, change: str, correction: Any = None, first: int = REPORT_SEED, count: int = 0) -> list[Episode]:
        """Return episodes by the policy, or by the corrected policy; `count` of them are asked about."""
        seeds = range(first, first + (count or self.options.episodes))
        return self.robots.play(change, seeds, self.plan, correction, EXECUTED, self.widths if count else ())

    def base(self, change: str) -> np.ndarray:
        """Return the success of each episode of the policy as it was."""
        if change not in self.bases:
            self.bases[change] = np.array([one.success for one in self.played(change)], float)
        return self.bases[change]

    def has(self, *cell: Any) -> bool:
        """Return whether a cell was measured: change, kind of labels, seed."""
        return cell in [(row["change"], row["labels"], row["seed"]) for row in self.rows]

    def add(self, row: dict[str, Any]) -> None:
        """Print a row, and write all."""
        self.rows.append({"task": self.options.task, "unchanged": self.base("nothing").mean(), **row})
        print({**self.rows[-1], "words": "; ".join(row["words"])[:300]}, flush=True)
        pq.write_table(pa.Table.from_pylist(self.rows), self.file, compression="zstd")

    def measure(self, seeds: int) -> None:
        """Measure all cells, those of one seed of labels after those of another."""
        for seed in range(seeds):
            for change in CHANGES:
                if not self.has(change, "labels", seed):
                    for row in self.cell(change, seed, self.base(change)):
                        self.add(row)

    def cell(self, change: str, seed: int, before: np.ndarray) -> Iterator[dict[str, Any]]:
        """Yield the row of a change, and of its control."""
        began, count = time.time(), LABELS // ROUNDS
        labeller = Labeller(seed, self.early)
        for round_ in range(ROUNDS):
            first = LABEL_SEED + 1000 * seed + 100 * round_
            labeller.ask(self.played(change, labeller if round_ else None, first, len(self.robots.pipes)), count)
        yield self.row(change, seed, "labels", before, labeller, began)
        if seed == 0:
            yield self.row(change, seed, "random", before, labeller.shuffled(), time.time())

    def row(self, change: str, seed: int, kind: str, before: Any, labeller: Labeller, began: float) -> dict[str, Any]:
        """Return how the corrected policy does, whether labels use it, and what paired episodes say."""
        result, seconds = labeller.reading.result(), time.time() - began
        after = np.array([one.success for one in self.played(change, labeller)], float)
        row = outcome(change, kind, before, after, bool(result.used)) | {"seed": seed, "seconds": seconds}
        row |= {"alike": float(np.concatenate(labeller.alike).mean())}
        return row | {"evidence": float(result.evidence), "words": list(result.words())}


def outcome(change: str, kind: str, before: np.ndarray, after: np.ndarray, used: bool = True) -> dict[str, Any]:
    """Return the row of a corrected policy by the success of its episodes; `alike`: mean of `Labeller.alike`."""
    from cuelearner_jax.adaptation.judging import PairedTest

    test = PairedTest(1)
    test.add((after - before)[None])
    verdict = "better" if test.better[0] else "worse" if test.worse[0] else "open"
    row = {"change": change, "seed": 0, "labels": kind, "before": before.mean(), "corrected": after.mean()}
    row |= {"used": used, "after": (after if used else before).mean(), "paired": verdict}
    return row | {"evidence": 0.0, "seconds": 0.0, "words": [], "alike": np.nan}


def without_labels(cells: Cells, folder: Path, options: argparse.Namespace, sizes: dict[str, Any]) -> None:
    """Measure pictures moved back, a policy without pictures, and fine-tuning by five new demonstrations."""
    from lerobot_processor_cuelearner.camera import align, first_pictures

    act = checkpoint(folder / "act")
    first = first_pictures(LeRobotDataset("local/metaworld", root=folder / "dataset"), "observation.image")
    for change in CHANGES:
        if not change.startswith(("camera", "nothing")) or cells.has(change, "pictures", 0):
            continue
        before, met = cells.base(change), cells.played(change, None, LABEL_SEED, len(cells.robots.pipes))
        places, *alike = align(first, np.stack([one.picture for one in met]) / 255)
        _with_plan(cells, planner(act, options.device, places.astype(np.float32)), change, "pictures", before, alike)
    for change in CHANGES if options.state else ():
        place = folder / "state"
        if not (place / "act").exists():
            shutil.rmtree(place, ignore_errors=True)
            without_pictures(folder / "dataset", place / "dataset")
            train(place / "dataset", place / "act", options.state, sizes)
        if not cells.has(change, "state alone", 0):
            plan, before = planner(checkpoint(place / "act"), options.device), cells.base(change)
            _with_plan(cells, plan, change, "state alone", before, [])
    if options.tune and not cells.has(TUNED, "demonstrations", 0):
        place, before = folder / "tuned", cells.base(TUNED)
        shutil.rmtree(place, ignore_errors=True)
        collect(cells.robots, place / "dataset", TUNED, 500_000, 5)
        train(place / "dataset", place / "act", options.tune, sizes | {"save": 50}, act)
        _with_plan(cells, planner(checkpoint(place / "act"), options.device), TUNED, "demonstrations", before, [])


def _with_plan(cells: Cells, plan: Plan, change: str, kind: str, before: np.ndarray, alike: Sequence[float]) -> None:
    """Measure another policy in a world, and add its row."""
    own, cells.plan = cells.plan, plan
    after = np.array([one.success for one in cells.played(change)], float)
    cells.plan = own
    cells.add(outcome(change, kind, before, after) | {"words": [f"alike {value:.3f}" for value in alike]})


def table(out: Path) -> None:
    """Print, for each task and change, success before and after."""
    rows = [row for file in sorted(out.glob("*/cells.parquet")) for row in pq.read_table(file).to_pylist()]
    print(f"{'task':<26}{'change':<28}{'by':<15}cells unchanged before corrected after  used better worse")
    for key in dict.fromkeys((row["task"], row["change"], row["labels"]) for row in rows):
        own = [row for row in rows if (row["task"], row["change"], row["labels"]) == key]
        ends = "  ".join(
            f"{np.mean([r[name] for r in own]):.2f}" for name in ("unchanged", "before", "corrected", "after")
        )
        verdicts = [sum(row["paired"] == verdict for row in own) for verdict in ("better", "worse")]
        counts = "  ".join(map(str, [sum(row["used"] for row in own), *verdicts]))
        print(f"{key[0]:<26}{key[1]:<28}{key[2]:<15}{len(own)}  {ends}  {counts}")
    for by, kind in (("pictures", "camera"), *(("labels", kind) for kind in ("camera", "gain", "motion"))):
        own = [r for r in rows if r["labels"] == by and r["change"].startswith(kind) and r["task"] in TASKS]
        loss, back = (sum(r[a] - r[b] for r in own) for a, b in (("unchanged", "before"), ("after", "before")))
        tested = sum(r["corrected"] - r["before"] for r in own if r["paired"] == "better")
        print(f"{kind}, {by}, {len(own)} cells: lost {loss:.2f}, back {back:.2f}, by the test {tested:.2f}")
    if rows:
        pq.write_table(pa.Table.from_pylist(rows), out / "lerobot_metaworld.parquet", compression="zstd")


def run(options: argparse.Namespace) -> None:
    """Do the chosen parts for one task."""
    folder, doing = options.out / options.task, options.do
    robots = Robots(options.task, options.processes, options.size)
    folder.mkdir(parents=True, exist_ok=True)
    sizes = {name: getattr(options, name) for name in ("device", "batch", "save", "workers", "act")}
    if doing in ("collect", "all") and not (folder / "dataset" / "meta" / "info.json").exists():
        collect(robots, folder / "dataset", "nothing", TRAIN_SEED, options.demonstrations)
    if doing in ("train", "all") and not (folder / "act" / "checkpoints" / "last").exists():
        train(folder / "dataset", folder / "act", 60 * options.minutes, sizes)
        print(f"{options.task}: {checkpoint(folder / 'act').resolve()}", flush=True)
    if doing in ("evaluate", "all"):
        cells = Cells(robots, planner(checkpoint(folder / "act"), options.device), folder, options)
        cells.measure(options.seeds)
        without_labels(cells, folder, options, sizes)


def main(arguments: Sequence[str] | None = None) -> None:
    """Run parts of the demonstration for one task, or print the table of all tasks."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("do", choices=("collect", "train", "evaluate", "all", "table"))
    parser.add_argument("--task", choices=(*TASKS, *TUNING), default=TASKS[0])
    parser.add_argument("--out", type=Path, default=Path("runs/lerobot_metaworld"))
    parser.add_argument("--size", type=int, default=SIZE, help="of pictures [pixels]")
    parser.add_argument("--device", default="cuda")
    parser.add_argument("--processes", type=int, default=17, help="that simulate")
    parser.add_argument("--demonstrations", type=int, default=DEMONSTRATIONS)
    parser.add_argument("--episodes", type=int, default=REPORTED, help="of each measurement")
    parser.add_argument("--seeds", type=int, default=3, help="of labels")
    parser.add_argument("--minutes", type=float, default=4.5, help="of training")
    parser.add_argument("--tune", type=float, default=0.0, help="seconds of fine-tuning; 0: none")
    parser.add_argument("--state", type=float, default=0.0, help="seconds of training without pictures; 0: none")
    parser.add_argument("--batch", type=int, default=64)
    parser.add_argument("--save", type=int, default=500, help="steps between checkpoints")
    parser.add_argument("--workers", type=int, default=12, help="that read the dataset")
    parser.add_argument("--act", type=json.loads, default={}, help="other options of ACT, as JSON")
    options = parser.parse_args(arguments)
    warnings.simplefilter("ignore")
    if options.do == "table":
        table(options.out)
    else:
        run(options)


if __name__ == "__main__":
    main()
