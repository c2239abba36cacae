"""The studies of adaptation: every piece can be run, and the tables say what hand-made rows say."""

import dataclasses
import importlib
import json
import sys
from pathlib import Path

import numpy as np
import pytest

from cuelearner_jax.adaptation.by_model import check_amounts
from cuelearner_jax.agents import ddqn
from cuelearner_jax.config import GuideSizes, check_guide
from cuelearner_jax.errors import UserError
from cuelearner_jax.feedback.answers import check_teacher
from cuelearner_jax.guides import intent
from cuelearner_jax.run_config import GROUPS, check
from cuelearner_jax.runs.trained import PolicySource
from cuelearner_jax.spaces import DIRECTIONS
from cuelearner_jax.storage import table as tables
from cuelearner_jax.studies.adapt import suggested
from cuelearner_jax.tasks import registry

FOLDER = Path(__file__).parents[2] / "experiments"
NAMES = ("_adaptation", "_adaptation_tables", "_trajectories", "adaptation_billiards", "adaptation_navigation")
PRESETS = {"billiards": "regulation", "navigation": "paper"}


@pytest.fixture(scope="module")
def modules():
    """Those of the experiments, as Python finds them when it runs one of the files."""
    sys.path.insert(0, str(FOLDER))
    yield {name: importlib.import_module(name) for name in (*NAMES, "adaptation_page")}
    sys.path.remove(str(FOLDER))


@pytest.fixture(params=["billiards", "navigation"])
def study(request, modules):
    return modules[f"adaptation_{request.param}"].STUDY


def bench_of(modules, study, piece):
    """Where a piece would be run, but for its agents and their world's arrays."""
    task = registry.find(study.task)
    config = task.presets[PRESETS[study.task]].config
    return modules["_adaptation"].Bench(task, config, None, np.arange(2), None, piece, 4, 3, Path())


# What README and docs/results/adaptation.md report of a world, and the scale at which it was run.
REPORTED = {
    **{("navigation", f"corridor_{side}/intent-180"): "paper" for side in ("left", "right")},
    ("navigation", "turned_lidar/relative-narrowed"): "paper",
    ("navigation", "rooms/intent-180-look-ahead"): "cpu",
}


@pytest.mark.parametrize(("name", "path"), REPORTED)
def test_a_scenario_holds_the_recipe_that_is_reported(name, path, modules):
    known, study = modules["_adaptation"], modules[f"adaptation_{name}"].STUDY
    (piece,) = [one for one in study.pieces if one.path == path]
    bench = bench_of(modules, study, known.scaled(piece, study.scales[REPORTED[name, path]]))
    piece, source = bench.piece, PolicySource(bench.task, bench.config, None, Path())
    asked = suggested(source, piece.world)
    assert asked.guidance == piece.settings.get("guidance", piece.method)
    assert (asked.bound_deg, asked.judge_by) == ((piece.bound_deg,), piece.judge_by)
    assert asked.judge_bounds == piece.judge_bounds
    assert asked.scalars == bench.scalars()
    sizes = bench.set("sizes.", GuideSizes(frame=asked.sizes.frame))
    if asked.guidance == "intent":  # whose network is of its own `aim_layers`
        assert asked.kinds == {"intent": bench.set("intent.", intent.Config())}
        sizes = dataclasses.replace(sizes, frame=asked.sizes.frame, feedback_layers=asked.sizes.feedback_layers)
    assert asked.sizes == sizes
    own = {key.partition(".")[2]: value for key, value in piece.settings.items() if key.startswith("task.")}
    world = bench.task.scenario(piece.world).apply(bench.config.task)
    assert asked.task == dataclasses.replace(world, **own)


@pytest.mark.parametrize("scale", ["smoke", "paper"])
def test_every_piece_has_settings_that_can_be(study, scale, modules):
    known = modules["_adaptation"]
    groups = {**GROUPS, "agent": ddqn.Config}
    for piece in study.pieces:
        left = known.scaled(piece, study.scales[scale])
        if left is None:
            continue
        bench = bench_of(modules, study, left)
        names = {name.partition(".")[0]: set() for name in left.settings}
        for name in left.settings:
            names[name.partition(".")[0]].add(name.partition(".")[2])
        assert names.pop("guidance", set()) <= {""}, piece.path
        groups |= {"task": bench.task.config, "intent": intent.Config}
        for group, fields in names.items():
            assert fields <= {field.name for field in dataclasses.fields(groups[group])}, piece.path
        if left.labels:
            scalars = bench.scalars()
            check_guide(bench.set("sizes.", GuideSizes()), scalars)
            assert scalars.k_max * scalars.eps_deg >= left.bound_deg or "scalars.k_max" in left.settings
        if left.method == "finetuning":
            sizes, agent = bench.set("sizes.", bench.config.sizes), bench.set("agent.", bench.config.agent)
            check(dataclasses.replace(bench.config, sizes=sizes, agent=agent))
            assert left.steps % left.every == left.every % sizes.num_envs == 0
            assert min(left.rates) > 0


def test_pieces_are_told_apart_and_worlds_are_scenarios(study):
    assert len({piece.path for piece in study.pieces}) == len(study.pieces)
    scenarios = registry.find(study.task).scenarios
    for piece in study.pieces:
        assert piece.world in (*scenarios, "unchanged")
        assert 0 < piece.minutes <= 30
        assert (piece.split == "tuning") == piece.path.startswith("tuning/")
        registry.find(study.task).on(piece.robot)
    reported = {piece.world for piece in study.pieces if piece.split != "tuning" and piece.robot is None}
    assert reported == {*scenarios, "unchanged"} - {"corridor"}  # which has two wishes


def test_the_teacher_of_billiards_knows_the_nearest_good_shot(modules):
    """Every world has one, and none is refused."""
    data = modules["adaptation_billiards"]
    task = registry.find("billiards")
    for piece in data.PIECES:
        if piece.method in ("relative", "teacher") and piece.split != "tuning":
            bench = bench_of(modules, data.STUDY, piece)
            world = bench.config.task
            world = world if piece.world == "unchanged" else task.scenario(piece.world).apply(world)
            world = dataclasses.replace(world, teacher=piece.settings["task.teacher"])
            scalars = bench.scalars()
            assert (scalars.eps_deg, scalars.tau_max_deg) == (0.1, 180.0)
            check_teacher(task.make_teacher(world, task.environment(world)), scalars)


def wrote(modules, folder, rows, **constants):
    """A finished piece with these rows."""
    schema = modules["_adaptation"].SCHEMA
    common = {"task": "billiards", "variant": "", "split": "validation", **constants}
    with tables.TableWriter(folder, schema, common) as writer:
        for row in rows:
            writer.append(**{"labels": 0, "steps": 0, **row})
    tables.finish(folder, schema)


@pytest.fixture
def recorded(modules, tmp_path):
    """Four base agents, one of them unfinished, in a world that takes half of their reward."""
    whole = np.array([0.5, 0.4, 0.45, 0.1])
    bases = np.arange(4)
    for split in ("validation", "tuning"):
        row = {"base": bases, "reward": whole}
        wrote(modules, tmp_path / "billiards" / split, [row], world="unchanged", method="none", split=split)
    world = "tilted_table"
    place = tmp_path / "billiards" / world
    wrote(modules, place / "none", [{"base": bases, "reward": whole / 2}], world=world, method="none")
    points = [(100, 0.6), (200, 0.9)]
    rows = [{"base": bases, "labels": after, "reward": part * whole, "used": 1.0} for after, part in points]
    command = "experiments/adaptation_billiards.py --bases runs/billiards"
    wrote(modules, place / "relative", rows, world=world, method="relative", command=command)
    points = [(0, 0.5), (1_000, 0.6), (2_000, 0.8), (4_000, 1.0)]
    rows = [{"base": bases, "steps": after, "reward": part * whole} for after, part in points]
    wrote(modules, place / "finetuning", rows, world=world, method="finetuning")
    return tmp_path


def test_tables_say_what_rows_say(modules, recorded):
    found = modules["_adaptation_tables"]
    rows = found.read(recorded / "billiards")
    known = found.lines(rows, "tilted_table", least=0.4)
    assert [(line.method, line.after) for line in known if line.method != "finetuning"] == [
        ("none", 0),
        ("relative", 100),
        ("relative", 200),
    ]
    assert all(line.bases.tolist() == [0, 1, 2] for line in known)  # the fourth is no finished agent
    whole = found.lines(rows, "unchanged", least=0.4)[0]
    np.testing.assert_allclose(found.share(known[2], whole), [[0.9]] * 3)
    assert found.percent(found.share(known[2], whole)) == "90.0 [90.0, 90.0]"
    assert len(found.lines(rows, "tilted_table")[0].bases) == 4


def test_settings_are_chosen_on_other_agents_than_are_reported(modules):
    known = modules["_adaptation"]
    scale = known.Scale("", envs=1, steps=1, tuning_bases=2)
    pieces = {split: known.Piece("rooms", "relative", split=split) for split in ("tuning", "validation")}
    assert known.bases_of(pieces["tuning"], scale, (5, 6, 7, 8)) == (5, 6)
    assert known.bases_of(pieces["validation"], scale, (5, 6, 7, 8)) == (7, 8)
    finished = known.Piece("unchanged", "none", split="tuning")
    assert known.bases_of(finished, scale, (5, 6)) == (5, 6)
    with pytest.raises(UserError, match="the first 2: give --bases a run of more"):
        known.bases_of(pieces["validation"], scale, (5, 6))


def test_seeds_of_labels_are_members_of_their_agent_and_labels_judge_in_lines_of_their_own(modules, tmp_path):
    """Agents 0 and 1 with two seeds each; of agent 1's second the model is not used where labels judge."""
    row = {"base": np.array([0, 0, 1, 1]), "label_seed": np.array([0, 1, 0, 1]), "labels": 50, "used": 1.0}
    row |= {"reward": np.array([0.1, 0.3, 0.5, 0.5]), "rewarded_steps": 20_000.0}
    row |= {"unrewarded_reward": np.array([0.1, 0.3, 0.5, 0.2]), "unrewarded_used": np.array([1.0, 1, 1, 0])}
    wrote(modules, tmp_path / "relative", [row], world="tilted_table", method="relative")
    found = modules["_adaptation_tables"]
    rewarded, judged = found.lines(found.read(tmp_path), "tilted_table")
    np.testing.assert_array_equal(rewarded.columns["reward"], [[0.1, 0.3], [0.5, 0.5]])
    np.testing.assert_array_equal(judged.columns["reward"], [[0.1, 0.3], [0.5, 0.2]])
    assert (rewarded.name, judged.name) == ("relative labels", "relative labels (judged by labels)")
    study = modules["adaptation_billiards"].STUDY
    assert [found.rewarded_steps(line, rewarded, study) for line in (rewarded, judged)] == [20_000, 0]
    assert found.spread(rewarded.columns["reward"]).startswith("0.350 [0.1")  # the mean over agents of means over seeds


def test_a_gain_is_made_where_lines_between_points_say(modules, recorded):
    """Of relative labels 0.5 -> 0.6 -> 0.9: 95% of 0.4 is reached at 0.88, 28/30 of the way from 100 to 200."""
    found, page = modules["_adaptation_tables"], modules["adaptation_page"]
    rows = found.read(recorded / "billiards")
    known = found.lines(rows, "tilted_table", least=0.4)
    points = page.curve_points(known, "reward", found.lines(rows, "unchanged", least=0.4)[0])
    labels, values = points["relative", ""]
    assert labels == [0, 100, 200]
    reference = values[..., [0, -1]]
    made = found.first_reaching(values, labels, reference, own=True)
    assert made.estimate == pytest.approx(100 + 100 * 0.28 / 0.3)
    assert (made.lower, made.upper) == pytest.approx((made.estimate, made.estimate))  # all agents are alike
    steps, values = points["finetuning", ""]
    assert found.first_reaching(values, steps, reference, own=False).estimate == pytest.approx(
        2_000 + 2_000 * 0.08 / 0.2
    )
    never = found.first_reaching(values * 0.5, steps, reference, own=False)
    assert never.in_words(4_000) == "above 4,000 [above 4,000, above 4,000]"


def test_rewarded_steps_are_those_that_the_use_of_a_model_was_decided_by(modules):
    """Two policies of 200 x 50 shots; in navigation 500 episodes at most, each until its end, for every bound tried."""
    found, line = modules["_adaptation_tables"], modules["_adaptation_tables"].Line
    ten = {"used": np.ones(2), "duration": np.full((2, 1), 10.0)}
    start = line("none", "", 0, np.arange(2), {"duration": np.full((2, 1), 20.0)}, "turned_lidar/none", "")
    command = "experiments/adaptation_navigation.py --bases runs/navigation --envs 1000 --pieces turned_lidar"
    steps = {}
    for variant in ("", "narrowed"):
        path = "turned_lidar/relative" + (f"-{variant}" if variant else "")
        own = line("relative", variant, 250, np.arange(2), ten, path, command)
        steps[variant] = found.rewarded_steps(own, start, modules["adaptation_navigation"].STUDY)
    assert steps == {"": 500 * (100 + 50), "narrowed": 500 * (100 + 3 * 50)}
    shots = line("relative", "", 250, np.arange(2), {"used": np.ones(2)}, "turned_strike/relative", "adaptation --x 1")
    assert found.rewarded_steps(shots, start, modules["adaptation_billiards"].STUDY) == 2 * 200 * 50
    tuned = line("finetuning", "", 5_000, np.arange(2), {}, "turned_lidar/finetuning", command)
    assert found.rewarded_steps(tuned, start, modules["adaptation_navigation"].STUDY) == 5_000
    assert found.rewarded_steps(start, start, modules["adaptation_navigation"].STUDY) is None


def test_what_has_come_back_is_a_ratio_with_an_interval(modules):
    found = modules["_adaptation_tables"]
    before, whole = np.full((8, 1), 0.8), np.full((8, 1), 1.0)
    assert found.recovered(np.full((8, 1), 0.9), before, whole) == "50 [50, 50]"
    now = np.linspace(0.8, 1, 8)[:, None]
    middle, lower, upper = (int(part.strip("[],")) for part in found.recovered(now, before, whole).split())
    assert (middle, lower < 40, upper > 60) == (50, True, True)
    assert found.recovered(before, whole, before) == ""  # nothing was lost


def test_agents_that_settings_were_chosen_on_are_told_from_the_others(modules):
    found = modules["_adaptation_tables"]
    rows = [{"base": base, "split": "tuning", "world": "rooms"} for base in (1, 2)]
    rows += [{"base": 3, "split": "validation", "world": "rooms"}, {"base": 4, "split": "tuning", "world": "lidar"}]
    assert found.tuned(rows, "rooms") == {1, 2}
    line = found.Line(
        "intent", "", 250, np.array([1, 2, 3, 4]), {"success": np.array([[0.1], [0.1], [0.6], [0.6]])}, "", ""
    )
    assert found.held_out(line, "success", {1, 2}) == "60.0 [60.0, 60.0]"
    assert found.held_out(line, "success", {1, 2, 3, 4}) == ""


def test_the_page_holds_tables_where_there_are_rows(modules, recorded):
    page = modules["adaptation_page"]
    text = (FOLDER.parent / "docs" / "results" / "adaptation.md").read_text(encoding="utf-8")
    (recorded / "page.md").write_text(text, encoding="utf-8")
    asked = ["--data", str(recorded), "--page", str(recorded / "page.md")]
    assert page.main(asked) == 0
    written = (recorded / "page.md").read_text(encoding="utf-8")
    assert "| relative labels, 200 labels | 90.0 [90.0, 90.0] |" in written
    whole = (recorded / "tables" / "billiards.csv").read_text(encoding="utf-8").splitlines()
    row = 'tilted_table,relative labels,200,"20,000",0.405,0.360,0.450,90.0,90.0,90.0,'
    assert any(line.startswith(row) for line in whole)
    of_lidar = text[text.index("<!-- lidar -->") : text.index("<!-- end of lidar -->")]
    assert of_lidar in written  # of which there are no rows
    assert (recorded / "billiards" / "shares.png").exists()
    assert page.main(asked) == 0
    assert (recorded / "page.md").read_text(encoding="utf-8") == written
    names = page.sections(recorded, recorded / "page.md")
    assert set(names) == {"billiards"}  # the overview needs 250 labels


def test_the_preferred_side_is_counted_among_those_who_passed_anything(modules, tmp_path):
    row = {"base": np.arange(2), "success": 0.8, "passed_left": 0.6, "passed_right": 0.1, "passed_both": 0.1}
    world = {"task": "navigation", "world": "corridor_left", "method": "none"}
    wrote(modules, tmp_path / "navigation" / "none", [row], **world)
    rows = modules["_adaptation_tables"].read(tmp_path / "navigation")
    page = modules["adaptation_page"]
    text = page.sides(rows, tmp_path, page.Output(tmp_path, tmp_path / "page.md"))
    assert "| left | not adapted |  | 80.0 [80.0, 80.0] | 75.0 [75.0, 75.0] |" in text
    (row,) = page.side_table(rows, "corridor_left", "left").cells
    assert row[-1] == "12.5 [12.5, 12.5]"


def test_ceilings_are_those_after_the_most_actions(modules, tmp_path):
    row = {"base": np.arange(2), "success": 0.5, "collision": 0.3, "timeout": 0.2}
    world = {"task": "navigation", "world": "rooms", "method": "none"}
    wrote(modules, tmp_path / "rooms" / "none", [row], **world)
    rows, page = modules["_adaptation_tables"].read(tmp_path), modules["adaptation_page"]
    out = page.Output(tmp_path, tmp_path / "page.md")
    assert "eilings" not in page.rooms(rows, tmp_path, out)
    measured = [("road map", 0, 0, 0.9), ("ways", 10, 0, 0.1), ("ways", 20, 0, 0.4), ("ways", 20, 1, 0.4)]
    names = ("variant", "actions", "seed", "success")
    found = [dict(zip(names, each, strict=True), collision=0.0, timeout=0.1) for each in measured]
    (tmp_path / "rooms" / "ceilings.json").write_text(json.dumps(found))
    assert "eilings" in page.rooms(rows, tmp_path, out)
    assert page.ceiling_cells(tmp_path / "rooms" / "ceilings.json") == [
        ["road map", "0", "1", "90.0", "0.0", "10.0"],
        ["ways", "20", "2", "40.0 [40.0, 40.0]", "0.0 [0.0, 0.0]", "10.0 [10.0, 10.0]"],
    ]


def test_a_piece_is_finished_resumed_and_refused(modules, tmp_path, capsys, monkeypatch):
    data, known = modules["adaptation_billiards"], modules["_adaptation"]
    monkeypatch.setattr(known, "open_bench", lambda *_: None)  # what `make smoke` runs
    monkeypatch.setitem(known.METHODS, "none", lambda bench: [{"base": [7, 8], "labels": 0, "steps": 0, "reward": 0.5}])
    asked = ["--bases", "run", "--out", str(tmp_path), "--pieces", "turned_strike/none"]
    assert data.main(asked) == 0
    file = tmp_path / "billiards" / "turned_strike" / "none" / "adaptation.parquet"
    rows = tables.read(file, known.SCHEMA).to_pylist()
    assert [(row["base"], row["reward"], row["world"], row["split"]) for row in rows] == [
        (7, 0.5, "turned_strike", "validation"),
        (8, 0.5, "turned_strike", "validation"),
    ]
    written = file.stat().st_mtime_ns
    capsys.readouterr()
    assert data.main([*asked, "--resume"]) == 0
    assert "turned_strike/none: finished" in capsys.readouterr().out
    assert data.main(asked) == 2
    assert "give --resume to go on" in capsys.readouterr().out
    assert file.stat().st_mtime_ns == written
    with pytest.raises(SystemExit):
        data.main(["--pieces", "turned_strike/nobody"])
    with pytest.raises(SystemExit):
        data.main([])
    assert "give --bases the run folder of the base agents" in capsys.readouterr().err


def test_agents_of_another_task_are_refused(modules, tmp_path, capsys):
    data = modules["adaptation_billiards"]
    agent = FOLDER.parent / "docs" / "data" / "navigation_agent"
    assert data.main(["--bases", str(agent), "--out", str(tmp_path), "--pieces", "turned_strike/none"]) == 2
    assert "holds agents of navigation: give --bases a run of billiards" in capsys.readouterr().out
    assert not list(tmp_path.iterdir())


def test_the_guide_to_billiards_says_what_was_measured_of_its_teachers():
    root = FOLDER.parent
    rows = json.loads((root / "benchmarks" / "results" / "changed_teachers.json").read_text())["rows"]
    told = (root / "docs" / "billiards.md").read_text(encoding="utf-8")
    for who, name in (("local_search", "`local_search`"), ("learned, unaware", "`learned`, unaware")):
        shares = [100 * row[who]["of_the_best"] for row in rows]
        cells = [f"{share:.1f}%" if share > 99 else f"{share:.0f}%" for share in shares]
        assert f"| {name} | {' | '.join(cells)} |" in told


@pytest.fixture(scope="module")
def pooltool(modules):
    return importlib.import_module("adaptation_pooltool")


def test_the_study_on_pooltools_table_has_settings_that_can_be(pooltool):
    assert check_amounts(DIRECTIONS, [pooltool.BOUND_DEG], pooltool.SCALARS) == ""
    for scale in pooltool.SCALES.values():
        check_guide(scale.sizes, pooltool.SCALARS)
        assert list(scale.labels) == sorted(scale.labels)
        assert all(budget % scale.sizes.labels_per_round == 0 for budget in scale.labels)


def test_the_table_of_pooltool_compares_rack_by_rack(pooltool):
    """On the first rack both seeds gain 0.2, on the second 0.1 and 0.3."""
    before = {"what": "not adapted", "seed": 0, "labels": 0, "rewards": [0.2, 0.4]}
    adapted = [
        {"what": "adapted", "seed": 0, "labels": 500, "rewards": [0.4, 0.5]},
        {"what": "adapted", "seed": 1, "labels": 500, "rewards": [0.4, 0.7]},
    ]
    teacher = {"what": "teacher", "seed": 0, "labels": 0, "rewards": [0.5]}  # played on the first rack alone
    lines = pooltool.table([before, teacher, *adapted]).splitlines()
    assert lines[2].startswith("| not adapted |  | 0.300")
    assert lines[3] == "| teacher |  | 0.500 | 0.300 |"
    assert lines[4] == "| adapted | 500 | 0.500 [0.400, 0.600] | 0.200 |"
