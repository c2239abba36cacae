"""Aggregates over tasks, against numbers by hand; a grid of settings is reported setting by setting."""

import csv
import json

import numpy as np
import pyarrow as pa
import pytest

from cuelearner_jax.cli import main
from cuelearner_jax.errors import UserError
from cuelearner_jax.report import suite
from cuelearner_jax.report.document import ReportRequest, report
from cuelearner_jax.report.variants import Variant
from cuelearner_jax.storage import results
from cuelearner_jax.storage.table import TableWriter

STEPS = (0, 10)


def write(folder, task, guidance, values, labels=0, constants=None):
    """Seeds that stand at a value of their own at all steps, in two groups of equal episodes."""
    columns = {"run": folder.name, "task": task, "guidance": guidance, "config_hash": "0f", "labels": labels}
    with TableWriter(folder, results.SCHEMA, columns | (constants or {})) as writer:
        for step in STEPS:
            each = np.array(values)[:, None] + [0.0, 0.0]
            row = {"reward": values, "reward_each": each, "episodes": 2, "failed": [float(np.isnan(v)) for v in values]}
            writer.append(step=step, split="validation", seed=np.arange(len(values)), **row)


def table(path):
    return list(csv.DictReader(path.read_text().splitlines()))


@pytest.fixture
def tasks(tmp_path):
    """Two tasks: of "small" the scores 0 and 1 are 0.1 and 0.3, of "large" 10 and 50."""
    runs = tmp_path / "runs"
    for task, unguided, guided in (("small", [0.1, 0.1], [0.2, 0.4]), ("large", [0.0, 20.0], [30.0, 70.0])):
        write(runs / f"{task}-none", task, "none", unguided)
        write(runs / f"{task}-relative", task, "relative", guided, 100)
    write(runs / "small-scalar", "small", "scalar", [0.1, 0.2], 100)
    return runs


def test_scores_are_normalised_by_task_and_pooled(tasks, tmp_path):
    text = report([tasks], tmp_path / "report").read_text()
    none, relative = table(tmp_path / "report" / "aggregates.csv")
    assert (none["guidance"], relative["guidance"], relative["labels"]) == ("none", "relative", "100")
    # The scores: 0.5 and 1.5 in both tasks; without guidance 0, 0 and -0.25, 0.25.
    assert [float(relative[name]) for name in ("interquartile_mean", "median", "mean")] == pytest.approx([1.0] * 3)
    assert float(relative["optimality_gap"]) == pytest.approx((0.5 + 0 + 0.5 + 0) / 4)
    assert float(none["optimality_gap"]) == pytest.approx((1 + 1 + 1.25 + 0.75) / 4)
    assert float(relative["probability_of_improvement"]) == 1.0
    assert float(relative["mean_lower"]) == pytest.approx(0.5)  # both seeds of both tasks the low ones: 1 draw in 16
    profile = [row for row in table(tmp_path / "report" / "profiles.csv") if row["labels"] == "100"]
    shares = {round(float(row["score"]), 3): row for row in profile}
    assert [float(shares[tau]["share"]) for tau in (-0.25, 0.475, 0.525, 1.25)] == [1.0, 1.0, 0.5, 0.5]
    assert "- small: 0 is 0.100, 1 is 0.300" in text
    assert "- large: 0 is 10.000, 1 is 50.000" in text
    assert "scalar, 100 labels: not in all tasks, so not among the aggregates" in text
    assert "| large | none |" in text
    assert (tmp_path / "report" / "profiles.png").exists()


def test_a_probability_against_one_unguided_seed_has_no_interval(tmp_path):
    for task, guided in (("small", [0.2, 0.4]), ("large", [30.0, 0.0])):
        write(tmp_path / "runs" / f"{task}-none", task, "none", [0.1])
        write(tmp_path / "runs" / f"{task}-relative", task, "relative", guided, 100)
    _, relative = table(report([tmp_path / "runs"], tmp_path / "report").with_name("aggregates.csv"))
    assert (float(relative["probability_of_improvement"]), relative["probability_of_improvement_lower"]) == (
        0.75,
        "nan",
    )
    assert relative["mean_lower"]


def test_equal_seeds_are_drawn_together_within_a_task_alone():
    values = np.arange(4.0)[:, None]
    one, alike, other = (Variant("none", 0, np.arange(4), np.zeros(1, int), values, task=task) for task in "aab")
    np.testing.assert_array_equal(one.samples(), alike.samples())
    assert (one.samples() != other.samples()).any()


def test_a_suite_draws_one_control_for_all_faulty_teachers_and_names_failed_lanes(tmp_path):
    scores = [0.0, 0.1, 0.2, 0.6]
    cells = [("right", "none", 0, scores), ("right", "clic", 25, scores), ("wrong", "clic", 25, scores)]
    cells += [("late", "clic", 25, [*scores[:3], None]), ("late", "relative", 25, [None] * 4)]
    rows = [
        {"use": "adapt", "task": "zoo", "teacher": teacher, "guidance": kind, "labels": labels, "seed": seed, "step": 7}
        | {"score": score, "failed": float(score is None), "rewarded_steps": 0.0}
        for teacher, kind, labels, each in cells
        for seed, score in enumerate(each)
    ]
    page = suite.write(tmp_path, pa.Table.from_pylist(rows), "right", [], "").read_text()
    own = {row["part"]: row for row in table(tmp_path / "aggregates.csv") if row["guidance"] == "none"}
    assert float(own["adapt, faulty teachers"]["mean_upper"]) == pytest.approx(float(own["adapt"]["mean_upper"]))
    for lost in ("clic, 25 labels: seed 3 (by step 7)", "relative, 25 labels: seeds 0 (by step 7), 1 (by step 7)"):
        assert f"- adapt, zoo, teacher late: {lost}" in page


def test_the_command_takes_a_level_for_the_score_1(tasks, capsys):
    assert main(["report", str(tasks), "--level", "60", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["ends"] == {"large": [10.0, 60.0], "small": [pytest.approx(0.1), 60.0]}
    assert main(["report", str(tasks), "--level", "5", "--json"]) == 2
    assert "5 in large is no better than its unguided agents, 10: give a better --level" in capsys.readouterr().err
    assert main(["report", str(tasks), "--efficiency", "--json"]) == 2
    assert "label efficiency is of one task" in capsys.readouterr().err


def test_tasks_without_a_control_or_a_variant_in_common_are_refused(tasks, tmp_path):
    with pytest.raises(UserError, match="large has no unguided agents, whose score would be 0: add a run with"):
        report([tasks / "large-relative", tasks / "small-none"], tmp_path / "report")
    write(tasks / "third", "third", "none", [0.5, 0.5], 7)
    write(tasks / "third-intent", "third", "intent", [0.6, 0.6], 5)
    with pytest.raises(UserError, match="large, third share no guidance with equal labels"):
        report([*tasks.glob("large-*"), *tasks.glob("third*")], tmp_path / "report")


def test_settings_are_groups_and_one_that_failed_leaves_the_others(tmp_path):
    for eps, level in ((2.0, 0.3), (10.0, np.nan), (5.0, 0.1)):
        write(tmp_path / "runs" / str(eps), "one", "none", [0.2] * 2, constants={"scalars.eps_deg": eps})
        write(tmp_path / "runs" / f"{eps}-r", "one", "relative", [level] * 2, 100, constants={"scalars.eps_deg": eps})
    text = report([tmp_path / "runs"], tmp_path / "report", ReportRequest(guidance=("relative", "none"))).read_text()
    rows = {(row["run"], row["guidance"]): row for row in table(tmp_path / "report" / "summary.csv")}
    names = [f"scalars.eps_deg={eps}" for eps in (2, 2, 5, 5, 10)]  # in the order of the numbers
    assert [run for run, _ in rows] == names
    assert float(rows["scalars.eps_deg=2", "relative"]["final"]) == 0.3
    assert rows["scalars.eps_deg=5", "relative"]["improvement"] == "0.0"
    assert "scalars.eps_deg=10: relative, 100 labels: seeds 0 (by step 0), 1 (by step 0) failed" in text
