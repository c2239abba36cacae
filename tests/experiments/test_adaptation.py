"""The studies of adaptation: every piece can be run, and scenarios hold the recipes that are reported."""

import dataclasses
import importlib
import sys
from pathlib import Path

import numpy as np
import pytest

from cuelearner_jax.agents import ddqn
from cuelearner_jax.config import GuideSizes, check_guide
from cuelearner_jax.guides import intent
from cuelearner_jax.run_config import GROUPS, check
from cuelearner_jax.storage import table as tables
from cuelearner_jax.studies.adapt import AdaptRequest
from cuelearner_jax.tasks import registry

FOLDER = Path(__file__).parents[2] / "experiments"
PRESETS = {"billiards": "regulation", "navigation": "paper"}


@pytest.fixture(scope="module")
def modules():
    sys.path.insert(0, str(FOLDER))
    yield {name: importlib.import_module(name) for name in ("_adaptation", *(f"adaptation_{task}" for task in PRESETS))}
    sys.path.remove(str(FOLDER))


@pytest.fixture(params=PRESETS)
def study(request, modules):
    return modules[f"adaptation_{request.param}"].STUDY


def bench_of(modules, study, piece):
    """Where a piece would be run, but for its agents and their world's arrays."""
    task = registry.find(study.task)
    config = task.presets[PRESETS[study.task]].config
    return modules["_adaptation"].Bench(task, config, None, np.arange(2), None, piece, 4, 3)


# What README and docs/results/adaptation.md report of a world, and the scale at which it was run.
REPORTED = {
    **{f"corridor_{side}/intent-180": "paper" for side in ("left", "right")},
    "turned_lidar/relative-narrowed": "paper",
    "rooms/intent-180-look-ahead": "cpu",
}


@pytest.mark.parametrize("path", REPORTED)
def test_a_scenario_holds_the_recipe_that_is_reported(path, modules):
    known, study = modules["_adaptation"], modules["adaptation_navigation"].STUDY
    (piece,) = [one for one in study.pieces if one.path == path]
    bench = bench_of(modules, study, known.scaled(piece, study.scales[REPORTED[path]]))
    piece = bench.piece
    asked = AdaptRequest.of(bench.task, bench.config, piece.world)
    assert asked.guidance == piece.method
    assert (asked.bound_deg, asked.judge_by) == ((piece.bound_deg,), piece.judge_by)
    assert asked.judge_bounds == piece.judge_bounds
    assert asked.scalars == bench.scalars()
    sizes = bench.set("sizes.", GuideSizes(frame=asked.sizes.frame))
    if asked.guidance == "intent":  # whose network is of its own `aim_layers`
        assert asked.kinds == {"intent": bench.set("intent.", intent.IntentConfig())}
        sizes = dataclasses.replace(sizes, frame=asked.sizes.frame, feedback_layers=asked.sizes.feedback_layers)
    assert asked.sizes == sizes
    own = {key.partition(".")[2]: value for key, value in piece.settings.items() if key.startswith("task.")}
    world = bench.task.scenario(piece.world).apply(bench.config.task)
    assert asked.task == dataclasses.replace(world, **own)


@pytest.mark.parametrize("scale", ["smoke", "paper"])
def test_every_piece_has_settings_that_can_be(study, scale, modules):
    known, task = modules["_adaptation"], registry.find(study.task)
    groups = {**GROUPS, "agent": ddqn.DdqnConfig, "task": task.config, "intent": intent.IntentConfig}
    assert len({piece.path for piece in study.pieces}) == len(study.pieces)
    for piece in study.pieces:
        assert piece.world in (*task.scenarios, "unchanged")
        left = known.scaled(piece, study.scales[scale])
        if left is None:
            continue
        bench = bench_of(modules, study, left)
        for group, _, field in (name.partition(".") for name in left.settings):
            assert field in {each.name for each in dataclasses.fields(groups[group])}, piece.path
        if left.labels:
            check_guide(bench.set("sizes.", GuideSizes()), bench.scalars())
        if left.method == "finetuning":
            sizes, agent = bench.set("sizes.", bench.config.sizes), bench.set("agent.", bench.config.agent)
            check(dataclasses.replace(bench.config, sizes=sizes, agent=agent))
            assert left.steps % left.every == left.every % sizes.num_envs == 0


def test_a_piece_is_finished_resumed_refused_and_in_the_table(modules, tmp_path, capsys, monkeypatch):
    data, known = modules["adaptation_billiards"], modules["_adaptation"]
    monkeypatch.setattr(known, "open_bench", lambda *_: None)  # what `make smoke` runs
    monkeypatch.setitem(known.METHODS, "none", lambda bench: [{"base": [7, 8], "labels": 0, "steps": 0, "reward": 0.5}])
    asked = ["--bases", "run", "--out", str(tmp_path), "--pieces", "turned_strike/none"]
    assert data.main(asked) == 0
    assert "reward 0.500 [0.500, 0.500]" in capsys.readouterr().out.splitlines()[-1]
    rows = tables.read(tmp_path / "billiards/turned_strike/none/adaptation.parquet", known.SCHEMA).to_pylist()
    assert [(row["base"], row["reward"], row["world"]) for row in rows] == [
        (7, 0.5, "turned_strike"),
        (8, 0.5, "turned_strike"),
    ]
    assert data.main([*asked, "--resume"]) == 0
    assert "turned_strike/none: finished" in capsys.readouterr().out
    assert data.main(asked) == 2
    assert "give --resume to go on" in capsys.readouterr().out
