"""The sweeps of label efficiency: every piece is a legal command, fits its half hour, runs, and ends in a report."""

import csv
import dataclasses
import importlib
import json
import sys
from itertools import chain
from pathlib import Path
from typing import cast

import jax
import jax.numpy as jnp
import label_efficiency
import numpy as np
import pytest
from _efficiency import efficiency_of

from cuelearner_envs.billiards.config import BilliardsConfig, make_environment
from cuelearner_envs.billiards.teacher import Transferred
from cuelearner_jax.agents import ddqn
from cuelearner_jax.arbiters import Paced
from cuelearner_jax.cli import main
from cuelearner_jax.config import GuideScalars, GuideSizes
from cuelearner_jax.guides import registry
from cuelearner_jax.report.tables import write_csv
from cuelearner_jax.report.variants import read_groups, variants_of
from cuelearner_jax.run_config import GROUPS
from cuelearner_jax.runs.order import make_plan
from cuelearner_jax.spaces import DIRECTIONS
from cuelearner_jax.spaces.directions import evenly_spaced
from cuelearner_jax.studies import train
from cuelearner_jax.tasks.billiards import make_teacher

FOLDER = Path(__file__).parents[2] / "experiments"
# What is called once a kind has been begun, and with what.
KINDS = {
    "heuristic": ["report"],
    "none": ["label_efficiency"],
    "relative": ["label_efficiency", "--reference"],
}  # what each adds
BUDGETS = [25, 50, 100, 350, 500, 1_000, 2_000, 5_000]


@pytest.fixture(scope="module")
def modules():
    """Those of the experiments, as Python finds them when it runs one of the files."""
    sys.path.insert(0, str(FOLDER))
    names = ("_pieces", "billiards_bootstrapping", "navigation_bootstrapping", "bootstrapping_page")
    kinds = dict(registry._KINDS)  # without those that an experiment brings along
    yield {name: importlib.import_module(name) for name in names}
    sys.path.remove(str(FOLDER))
    registry._KINDS.clear()
    registry._KINDS.update(kinds)


@pytest.fixture(params=["billiards", "navigation"])
def experiment(request, modules):
    return modules[f"{request.param}_bootstrapping"].EXPERIMENT


def test_pieces_are_bounded_and_no_lane_is_trained_twice(experiment):
    assert len({piece.path for piece in experiment.pieces}) == len(experiment.pieces)
    for piece in experiment.pieces:
        assert piece.lanes <= 64, piece.path
        assert 0 < piece.minutes <= 30, piece.path
        if all(map(known_kind, piece.kinds)):
            assert bool(piece.labels) == any(registry.resolve(kind).asks for kind in piece.kinds), piece.path
    lanes = [
        (piece.world, piece.run, kind, budget, piece.first_seed + seed)
        for piece in experiment.pieces
        for kind in piece.kinds
        for budget in piece.labels or (0,)
        for seed in range(piece.seeds)
    ]
    assert len(set(lanes)) == len(lanes)
    first = {piece.world: piece for piece in reversed(experiment.pieces)}
    assert {piece.kinds for piece in first.values()} == {("none",)}  # whom all runs of a world are compared with


def test_every_form_of_feedback_has_every_budget(modules):
    pieces = modules["billiards_bootstrapping"].PIECES
    for world in ("regulation", "easy"):
        for kind in ("relative", "demonstration", "scalar", "dcoach"):
            own = [p for p in pieces if (p.world, p.run, p.kinds) == (world, "frame", (kind,))]
            assert sorted(chain(*(p.labels for p in own)))[:8] == BUDGETS
            assert {p.seeds for p in own} == {8}
    for run in ("raw", "frame"):
        own = [p for p in modules["navigation_bootstrapping"].PIECES if p.run == run]
        assert {p.seeds for p in own} == {16}
        assert sorted({budget for p in own for budget in p.labels}) == BUDGETS[:6]


def known_kind(name):
    return ":" in name or registry.find_or_none(name) is not None


def options_known(piece):
    """Are a piece's options and kinds part of this version?"""
    fields = {**GROUPS, "agent": ddqn.Config, "arbiter": Paced}
    known = {f"{group}.{field.name}" for group, kind in fields.items() for field in dataclasses.fields(kind)}
    own = {name.replace("-", "_") for name in piece.options if name.partition(".")[0] in fields and "." in name}
    return own <= known and all(map(known_kind, piece.kinds))


@pytest.mark.parametrize(
    "scale", ["smoke", *(pytest.param(scale, marks=pytest.mark.long) for scale in ("cpu", "paper"))]
)
def test_every_piece_is_a_sweep_that_would_begin(experiment, scale, modules, monkeypatch, tmp_path):
    """The command line itself plans each: options exist, values are legal, counts divide each other."""
    if scale not in experiment.scales:
        pytest.skip(f"{experiment.task} has no scale {scale}")
    orders = []
    monkeypatch.setattr(train, "run", lambda order: orders.append(make_plan(order).order))
    pieces = modules["_pieces"]
    different = {}
    for piece in experiment.pieces:
        if (left := pieces.scaled(piece, experiment.scales[scale])) and options_known(piece):
            different.setdefault((str(left.options), left.kinds), left)
    if scale == "smoke":  # what it changes is the same for all: every sixth says as much
        different = dict(list(different.items())[::6])
    for piece in different.values():
        assert main(pieces.sweep_command(experiment.task, piece, tmp_path, resume=False)) == 0, piece.path
        order = orders[-1]
        assert order.grid.guidance == tuple(registry.resolve(kind).name for kind in piece.kinds)
        assert order.grid.labels == piece.labels or not piece.labels
        assert order.grid.seeds == tuple(range(4000, 4000 + piece.seeds))
        assert order.out == tmp_path / piece.path
    assert len(orders) >= 2
    if scale == "paper":
        found = {piece.run: order.config for piece, order in zip(different.values(), orders, strict=True)}
        compared = [(found[run].sizes.frame, found[run].arbiter.NAME) for run in ("frame", "raw", "paced")]
        assert compared == [("action", "episodes"), ("raw", "episodes"), ("action", "paced")]


@pytest.mark.long
@pytest.mark.parametrize("table", ["regulation", "easy"])
def test_a_perfect_guide_does_what_the_tables_teacher_holds_for_best(modules, table):
    kind, env = registry.resolve(f"_perfect_guide:{table.upper()}"), make_environment(BilliardsConfig(table))
    guidance = registry.make(kind.name, GuideSizes(), env)
    _, obs = jax.vmap(env.reset)(jax.random.split(jax.random.key(3), 12))
    base = DIRECTIONS.sample(jax.random.key(4), (12,))
    active = jnp.arange(12) < 10
    found = guidance.act(guidance.init(jax.random.key(0)), env, obs, base, active, GuideScalars()).actions
    np.testing.assert_array_equal(found[10:], base[10:])
    teacher = cast(Transferred, make_teacher(BilliardsConfig(table, teacher="learned"), env)).teacher
    for seen, action in zip(obs[:10], found[:10], strict=True):
        best = teacher.values(seen, evenly_spaced(3600)).max()  # of all that it knows, searched one by one
        assert teacher.values(seen, action[None])[0] >= best - 0.02


def test_scales_keep_what_they_say(modules):
    pieces, data = modules["_pieces"], modules["billiards_bootstrapping"]
    many = next(piece for piece in data.PIECES if piece.name == "relative")
    assert pieces.scaled(many, data.SCALES["paper"]) == many
    quick = pieces.scaled(many, data.SCALES["quick"])
    assert (quick.labels, quick.seeds) == ((100, 500, 1_000), 4)
    assert quick.options["sizes.frame"] == "action"
    assert pieces.scaled(many._replace(labels=(50,)), data.SCALES["quick"]) is None
    active = next(piece for piece in data.PIECES if "sizes.candidates" in piece.options)
    assert pieces.scaled(active, data.SCALES["smoke"]).options["sizes.candidates"] == 5
    assert "sizes.candidates" not in pieces.scaled(many, data.SCALES["smoke"]).options


def test_names_choose_pieces_and_folders_of_them(modules, capsys):
    pieces, data = modules["_pieces"], modules["billiards_bootstrapping"]
    found = pieces.chosen(data.EXPERIMENT, ["regulation/frame/none", "full/"])
    assert [piece.path for piece in found] == ["regulation/frame/none", "full/raw/none", "full/raw/relative"]
    with pytest.raises(SystemExit):
        data.main(["--pieces", "regulation/fra"])
    assert "no piece 'regulation/fra': see --list" in capsys.readouterr().err
    assert data.main(["--list", "--pieces", "full"]) == 0
    assert "full/raw/relative" in capsys.readouterr().out


def test_what_is_asked_of_a_report_is_what_its_runs_can_answer(experiment, modules, tmp_path):
    world = experiment.pieces[0].world
    asked = modules["_pieces"].report_command
    assert asked(experiment, world, tmp_path, "paper") is None
    begun = {kind: next(p for p in experiment.pieces if p.world == world and p.kinds == (kind,)) for kind in KINDS}
    for kind, options in KINDS.items():
        config = tmp_path / begun[kind].path / "config.json"
        config.parent.mkdir(parents=True)
        config.touch()
        command = asked(experiment, world, tmp_path, "paper")
        assert [name for name in ("report", "label_efficiency", "--reference") if name in command] == options
    assert "--reference" not in asked(experiment, world, tmp_path, "smoke")


def test_what_a_report_says_is_missing_stands_behind_a_fold(modules):
    page = modules["bootstrapping_page"]
    report = "# t\n\n## Missing\n\n- nothing: all runs are complete\n\n## Where the numbers come from\n\n- c\n"
    assert page.missing_lines(report) == []
    (line,) = page.missing_lines(report.replace("nothing: all runs are complete", "b: at step 5 of 10"))
    assert line == "- b: at step 5 of 10"


def test_a_short_table_shows_the_budget_nearest_to_500_of_each_run_and_kind(modules):
    page = modules["bootstrapping_page"]
    rows = [
        {"run": run, "guidance": kind, "labels": float(labels), "mean": mean}
        for run, kind, labels, mean in (
            ("frame", "relative", 100, 0.9),
            ("frame", "relative", 600, 0.2),
            ("frame", "none", 0, 0.1),
            ("raw", "relative", 1_000, 0.3),
        )
    ]
    chosen = [(row["run"], row["guidance"], row["labels"]) for row in page.chosen(rows)]
    assert chosen == [("frame", "none", 0), ("raw", "relative", 1_000), ("frame", "relative", 600)]
    assert page.named(rows[3], labels=True) == "relative, 1,000 labels, raw coordinates"


@pytest.mark.long
def test_a_smoke_of_the_easy_table_runs_resumes_and_reports(modules, tmp_path, capsys):
    data = modules["billiards_bootstrapping"]
    asked = ["--scale", "smoke", "--out", str(tmp_path), "--pieces", "easy/frame/none", "easy/frame/relative"]
    assert data.main(asked) == 0
    out = tmp_path / "smoke" / "easy"
    with (out / "report" / "efficiency.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [(row["run"], row["guidance"], row["labels"], row["seeds"]) for row in rows] == [
        ("frame", "none", "0", "2"),
        ("frame", "relative", "5", "2"),
        ("frame", "relative", "10", "2"),
    ]
    before = (out / "frame" / "none" / "none" / "results.parquet").stat().st_mtime_ns
    capsys.readouterr()
    assert data.main([*asked, "--resume"]) == 0
    assert (out / "frame" / "none" / "none" / "results.parquet").stat().st_mtime_ns == before
    assert data.main(asked) == 2  # begun already, and --resume was not given


DOCS = FOLDER.parent / "docs"
DATA, PAGE = DOCS / "data" / "bootstrapping", DOCS / "results" / "bootstrapping.md"


def test_the_page_says_what_its_tables_say(modules):
    page, text = modules["bootstrapping_page"], PAGE.read_text(encoding="utf-8")
    places = list(page.places())
    assert [place.mark for place in places] == ["regulation", "easy", "full", "clutter-cpu", "clutter"]
    found = {place.mark: page.section(place, DATA, PAGE) for place in places} | {"findings": page.findings(DATA)}
    assert page.rendered(text, found) == text


MARKS = [
    "easy",
    *(pytest.param(mark, marks=pytest.mark.long) for mark in ("regulation", "full", "clutter", "clutter-cpu")),
]


def cells_of(file):
    """Rows of a table. Numbers have twelve digits, as processors differ in the last of a sum's sixteen."""

    def cell(text):
        try:
            return f"{float(text):.12g}"
        except ValueError:
            return text

    with file.open(newline="") as lines:
        return [[cell(text) for text in row] for row in csv.reader(lines)]


@pytest.mark.parametrize("mark", MARKS)
def test_the_tables_hold_what_the_recorded_runs_give(mark, modules, tmp_path):
    page = modules["bootstrapping_page"]
    (place,) = (place for place in page.places() if place.mark == mark)
    asked = label_efficiency.parsed(place.command(DATA)[1:])
    groups = read_groups(asked.folders, None, asked.metric, "validation", by_run=True)
    found = efficiency_of(variants_of(groups, asked.metric), asked.question, asked.lower_is_better)
    for name, rows in found.tables().items():
        write_csv(tmp_path / f"{name}.csv", rows)
        assert cells_of(tmp_path / f"{name}.csv") == cells_of(place.report(DATA) / f"{name}.csv")


def test_the_page_tells_what_aims_are_worth_without_a_label():
    page = " ".join((FOLDER.parent / "docs" / "results" / "bootstrapping.md").read_text().split())
    rows = json.loads((FOLDER.parent / "docs" / "data" / "aims_alone.json").read_text())["rows"]
    for row in rows:
        assert f"{row['aim_at_random']:.3f} on `{row['table']}`" in page
