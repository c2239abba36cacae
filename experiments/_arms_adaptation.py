"""Scripts of the arm in changed worlds, and trained agents in Fetch, corrected by labels.

Held-out answers judge whether a model is used: no step is rewarded. Demonstrations and good/bad labels cannot judge:
20 tuning episodes do, whose steps are counted.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from _pieces import Options, Scale, option, scaled

from cuelearner_jax.evaluate import mean_interval
from cuelearner_jax.guides import registry

CODE = {"reach": "reach", "push": "past", "pick": "pick"}  # names in `cuelearner_envs.arm.scripts`
EVIDENCE = "reading"
# World of a table -> skill, scenario, what else; the metric. Where an offset costs nothing no row is.
CHANGED: dict[str, tuple[str, str, Options, str]] = {
    "reach_turned": ("reach", "turned_camera", {}, "success"),
    "push_turned": ("push", "turned_camera", {}, "success"),
    "pick_turned": ("pick", "turned_camera", {}, "success"),
    "reach_offset": ("reach", "hand_eye", {"task.within": 0.015}, "success"),
    "push_offset": ("push", "hand_eye", {}, "success"),
    "push_slips": ("push", "slippery", {}, "success"),
    "push_left": ("push", "past_left", {}, "passed_left"),
    "push_right": ("push", "past_right", {}, "passed_right"),
}
FORMS = ("relative", "offset", "demonstration", "scalar", "dcoach", "bdcoach", "clic")
KINDS = (EVIDENCE, *(kind for kind in FORMS if registry.find_or_none(kind)))
VARIANTS: dict[str, Options] = {
    "adapted": {},
    "wrong": {"scalars.mistake-probability": 0.2},
    "one_cue": {"scalars.says": "one"},
    "shuffled": {"scalars.answer": "shuffled"},
}
VARIED = {"wrong": (EVIDENCE, "relative"), "one_cue": (EVIDENCE, "relative"), "shuffled": ("relative",)}
LABELS, FETCH_LABELS, SEEDS, EPISODES = 100, 200, 8, 200
JUDGED = 20  # episodes that judge where held-out answers cannot
FETCH_BUDGET = 500  # of the agents that act in Fetch
FETCHED = {
    "reach": "stored",
    "push_free": "stored",
    "pick": "stored",
}  # runs whose finished policies are the agents alone


NOWHERE: Options = {}


class Corrected(NamedTuple):
    """One policy to measure, adapted first or not. Its folder is world/run/name."""

    world: str
    run: str
    name: str
    labels: tuple[int, ...]
    seeds: int
    options: Options  # of the adaptation alone
    minutes: int
    serves: str
    kinds: tuple[str, ...] = ()  # of guidance; none: the policy as it is
    where: Options = NOWHERE  # of adaptation and evaluation
    source: str = ""  # path of a trained piece; empty: the script of the skill
    episodes: int = EPISODES
    metric: str = "success"

    @property
    def path(self) -> str:
        """The piece's folder and name on the command line."""
        return f"{self.world}/{self.run}/{self.name}"

    @property
    def lanes(self) -> int:
        """Seeds times budgets."""
        return self.seeds * max(1, len(self.labels))


def _in_world(world: str) -> list[Corrected]:
    skill, scenario, more, metric = CHANGED[world]
    plain: Options = {"task.skill": skill, **more}
    there: Options = {**plain, "scenario": scenario}
    camera = scenario in ("turned_camera", "hand_eye")
    rows = [
        Corrected(world, "script", "unchanged", (), 1, {}, 1, "the script, nothing changed", where=plain),
        Corrected(world, "script", "changed", (), 1, {}, 1, "the script in the changed world", where=there),
        Corrected(world, "script", "teacher", (), 1, {}, 1, "who answers, in the changed world", where=there),
    ]
    for run, options in VARIANTS.items():
        for kind in VARIED.get(run, KINDS):
            if kind != EVIDENCE or camera:
                rows.append(
                    Corrected(world, run, kind, (LABELS,), SEEDS, options, 3, f"{run}, {kind}", (kind,), where=there)
                )
    return [row._replace(metric=metric) for row in rows]


def _in_fetch(trained: str) -> list[Corrected]:
    """An agent of MJX there and in Fetch, and corrected in Fetch: as it is, and with a turned camera."""
    plain: Options = {"task.skill": trained.removesuffix("_free"), "task.obstacle": False}
    fetch: Options = {**plain, "robot": "fetch"}
    turned: Options = {**fetch, "scenario": "turned_camera"}
    source, world, labels = f"{trained}/{FETCHED[trained]}/relative", f"{trained}_fetch", (FETCH_LABELS,)
    rows = [
        Corrected(world, "agent", "mjx", (), SEEDS, {}, 1, "agents of 500 labels in MJX", where=plain),
        Corrected(world, "agent", "fetch", (), SEEDS, {}, 3, "the agents in Fetch", where=fetch),
        Corrected(world, "agent", "turned", (), SEEDS, {}, 3, "the agents in Fetch, its camera turned", where=turned),
        *(
            Corrected(world, run, kind, labels, SEEDS, {}, 9, f"{run}, {kind}, 200 labels in Fetch", (kind,), where=of)
            for run, of in (("adapted", fetch), ("adapted_turned", turned))
            for kind in (EVIDENCE, "relative")
        ),
    ]
    return [row._replace(source=source, episodes=100) for row in rows]


CORRECTED = (
    *(row for world in CHANGED for row in _in_world(world)),
    *(row for trained in FETCHED for row in _in_fetch(trained)),
)

ADAPTED_SCALES: Mapping[str, Scale] = {
    "paper": Scale("what the figures are of"),
    "quick": Scale("two label seeds", seeds=2),
    "smoke": Scale(
        "seconds a piece on a CPU",
        seeds=1,
        labels={LABELS: 20, FETCH_LABELS: 20},
        options={"sizes.fit-steps": 20, "sizes.feedback-layers": 8},
    ),
}
FEW = {"smoke": 2, "quick": 50}  # episodes, at most
AGENTS = {"smoke": 20}  # what becomes of FETCH_BUDGET


def commands(piece: Corrected, out: Path, scale: str) -> list[list[str]]:
    """The command lines of a piece: none where it is measured, or where its agents are not trained yet."""
    left = scaled(piece, ADAPTED_SCALES[scale])  # pyright: ignore[reportArgumentType]
    folder, run = out / piece.path, out / piece.source
    if left is None or (folder / "measured.json").exists():
        return []
    if piece.source and not (run / "config.json").exists():
        print(f"{piece.path} waits for agents: run --pieces {piece.source} first")
        return []
    script = f"cuelearner_envs.arm.scripts:{CODE[str(piece.where['task.skill'])]}"
    shown = ["--episodes", str(min(piece.episodes, FEW.get(scale, piece.episodes)))]
    shown += ["--out", str(folder / "measured.json")]
    where = [word for name, value in piece.where.items() for word in option(name, value)]
    if not piece.kinds:
        who = "teacher" if piece.name == "teacher" else "heuristic"
        whose = [str(run)] if piece.source else ["arm", "--policy", who]
        return [["evaluate", *whose, *where, *shown]]
    given = {} if piece.kinds == (EVIDENCE,) else dict(ADAPTED_SCALES[scale].options)
    given |= {**piece.options, "guidance": piece.kinds, "labels": left.labels, **_judge(piece)}
    policy = str(folder / "policy")
    if piece.source:
        budget, seeds = AGENTS.get(scale, FETCH_BUDGET), _seeds_in(run)
        whose = [str(run)]
        given |= {"base.labels": budget, **({"base.seeds": seeds} if len(seeds) > 1 else {})}
        again = [policy, *where, *shown]
    else:
        whose, given = [script, "--task", "arm"], {**given, "seeds": left.seeds}
        again = [policy, "--base", script, *shown]
    more = [word for name, value in given.items() for word in option(name, value)]
    return [["adapt", *whose, *where, *more, "--out", policy, "--overwrite"], ["evaluate", *again]]


def _judge(piece: Corrected) -> Options:
    """Return what decides on using a model: held-out answers, or a few tuning episodes for answers without cues."""
    form = registry.find(piece.kinds[0]).form
    if form is not None and form.by_eps:
        return {"judge-by": "labels"}
    return {"judge-by": piece.metric, "judge-episodes": JUDGED}


def _seeds_in(run: Path) -> tuple[int, ...]:
    return tuple(json.loads((run / "config.json").read_text())["grid"]["seeds"])


def measured(out: Path, pieces: Sequence[Corrected]) -> list[dict[str, Any]]:
    """A row for each measured piece and budget; intervals over seeds, or over episodes where there is one policy."""
    found = []
    for piece in pieces:
        file = out / piece.path / "measured.json"
        for row in json.loads(file.read_text())["rows"] if file.exists() else ():
            kind = piece.kinds[0] if piece.kinds else piece.name
            told = {"world": piece.world, "run": piece.run, "guidance": kind, "labels": row["labels"]}
            mean, low, high = row["intervals"][piece.metric]
            if len(row[piece.metric]) > 1:  # the mean, as everywhere in this study
                mean, low, high = mean_interval(np.array(row[piece.metric], float)).tolist()
            found.append(
                {**told, "seeds": len(row["seeds"]), "metric": piece.metric, "mean": mean, "low": low, "high": high}
            )
            found[-1] |= {"rewarded_steps": 0}
    return found


def _paid(folder: Path) -> int:
    """Return the rewarded steps of a lane spent on judging a model."""
    file = folder / "policy" / "policy.json"
    return max(json.loads(file.read_text())["judged"]["rewarded_steps"]) if file.exists() else 0
