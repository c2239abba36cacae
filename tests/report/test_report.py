"""Reports: a known difference is found and shown, what is missing is said, and nothing is overwritten unasked."""

import csv
from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest

from cuelearner_jax.errors import UserError
from cuelearner_jax.report.document import ReportRequest, report
from cuelearner_jax.storage import formats, results
from cuelearner_jax.storage.table import TableWriter, finish

STEPS = np.arange(0, 101, 10)


def planned(folder, **values):
    """What a run is to do."""
    formats.write("config", folder / "config.json", values)


def write(folder, guidance, level, labels=0, *, seeds: Sequence[int] = range(8), steps=STEPS, **constants: Any):
    """Seeds that all stand at 0 until step 30 and at `level`, give or take 0.02, from step 40 on."""
    known = {"run": folder.name, "task": "one_ball", "guidance": guidance, "config_hash": "0f"}
    known |= {"commit": "abc", "versions": "jax 0", "hardware": "1 x cpu"} | constants
    rng = np.random.default_rng(len(seeds))  # variants of one size differ in nothing but their level
    with TableWriter(folder, results.SCHEMA, known) as writer:
        for step in steps:
            reward = (step > 30) * level + rng.uniform(-0.02, 0.02, len(seeds))
            row = {"reward": reward, "reward_each": reward[:, None] + [-0.01, 0.01], "episodes": 30}
            writer.append(step=step, split="validation", seed=np.array(seeds), labels=labels, wall_s=1.0, **row)
    planned(folder, total_steps=int(STEPS[-1]))


def summary(out):
    rows = csv.DictReader((out / "summary.csv").read_text().splitlines())
    return {(row["guidance"], int(row["labels"])): row for row in rows}


@pytest.fixture
def runs(tmp_path):
    write(tmp_path / "runs" / "unguided", "none", 0.23)
    for labels, level in ((100, 0.3), (500, 0.6)):
        write(tmp_path / "runs" / f"relative-{labels}", "relative", level, labels)
    finish(tmp_path / "runs" / "unguided", results.SCHEMA)
    return tmp_path / "runs"


def test_a_known_difference_is_found(runs, tmp_path):
    out = tmp_path / "report"
    text = report([runs], out, command="cuelearner report runs").read_text()
    table = summary(out)
    assert list(table) == [("none", 0), ("relative", 100), ("relative", 500)]
    best = table["relative", 500]
    assert float(best["final"]) == pytest.approx(0.6, abs=0.02)
    assert float(best["final_lower"]) <= float(best["final"]) <= float(best["final_upper"])
    # Trapezoids: level for the six intervals from 40 to 100 and half of it from 30 to 40, over a span of 100.
    assert float(best["mean"]) == pytest.approx(0.6 * 0.65, abs=0.01)
    assert [float(best[f"improvement{end}"]) for end in ("", "_lower", "_upper")] == [1.0] * 3
    assert float(best["mean_difference"]) == pytest.approx(float(best["mean"]) - float(table["none", 0]["mean"]))
    assert float(best["mean_difference_lower"]) > 0.1
    # A third of the way from 30 to 40: nine tenths of the unguided agents' last value are 0.345 times 0.6.
    reached = [int(best[f"reaches_unguided{end}"]) for end in ("_lower", "", "_upper")]
    assert reached == sorted(reached)
    assert 32 <= reached[0] < reached[2] <= 35
    assert (best["seeds"], best["episodes"]) == ("8", "30")
    assert text.startswith("# one_ball: validation reward, 8 seeds x 30 episodes")
    for line in ("runs that have begun are complete", "`cuelearner report runs`", "`0f`", "`abc`", "jax 0", "1 x cpu"):
        assert line in text


def test_nothing_is_overwritten_unasked_and_stale_figures_go(runs, tmp_path):
    out = tmp_path / "report"
    report([runs], out)
    with (out / "curves.csv").open() as file:
        assert len(list(csv.DictReader(file))) == 3 * len(STEPS)
    (out / "notes.txt").write_text("mine")
    with pytest.raises(UserError, match="exists already"):
        report([runs], out)
    report([runs / "unguided", runs / "relative-500"], out, overwrite=True)
    assert not (out / "label_efficiency.png").exists()
    assert "label_efficiency" not in (out / "report.md").read_text()
    assert (out / "notes.txt").read_text() == "mine"


DURATION = {"less_is_better": ["duration"]}


@pytest.mark.parametrize(
    ("metric", "own", "best"),
    [
        ("collision", {}, (0.3, 10, "8")),  # by default
        ("duration", DURATION, (0.3, 10, "8")),
        ("collision", DURATION, (0.8, 0, "")),  # a task that names its own leaves no default: unguided agents lose
    ],
)
def test_of_some_metrics_the_least_is_best(metric, own, best, tmp_path):
    (tmp_path / "runs").mkdir()
    planned(tmp_path / "runs", **own)
    for kind, values in (("none", (0.8, 0.5, 0.4)), ("heuristic", (0.8, 0.3, 0.35))):
        constants = {"run": kind, "task": "hall", "guidance": kind, "config_hash": "0f", "labels": 0}
        with TableWriter(tmp_path / "runs" / kind, results.SCHEMA, constants) as writer:
            for step, value in zip((0, 10, 20), values, strict=True):
                writer.append(step=step, split="validation", seed=[0, 1], **{metric: [value, value]})
    report([tmp_path / "runs"], tmp_path / "out", ReportRequest(metric=metric))
    row = summary(tmp_path / "out")["heuristic", 0]
    assert (float(row["best"]), int(row["best_step"]), row["reaches_unguided"]) == best


def test_says_what_is_missing(runs, tmp_path):
    write(runs / "scalar-a", "scalar", 0.2, 100, seeds=[0, 1], steps=STEPS[:6])
    write(runs / "scalar-b", "scalar", 0.2, 100, seeds=[2], steps=STEPS)
    write(runs / "heuristic", "heuristic", 0.2, seeds=[0], config_hash="1e")
    write(runs / "intent", "intent", 0.2, 100, steps=STEPS[1::2])
    (runs / "planned").mkdir()
    planned(runs / "planned")
    (runs / "tuned").mkdir()
    planned(runs / "tuned", split="tuning", grid={"guidance": ["none"]})
    write(runs / "sweep" / "demonstration", "demonstration", 0.2, 100, steps=STEPS[:9])
    (runs / "sweep" / "demonstration" / "config.json").unlink()
    planned(runs / "sweep", total_steps=100, grid={"guidance": ["none", "demonstration"]})
    text = report([runs], tmp_path / "report").read_text()
    missing = text.split("## Missing")[1].split("## Where")[0]
    assert "scalar-a: at step 50 of 100 (50%)" in missing
    assert "scalar, 100 labels: some seeds have reached step 100; the curve ends at 50" in missing
    assert "heuristic: a single seed, so there is no interval" in missing
    assert "nan" not in text
    assert "planned: no results" in missing
    assert "tuned: evaluated on tuning episodes" in missing
    assert "sweep/demonstration: at step 80 of 100 (80%)" in missing
    assert "sweep: no results of none guidance" in missing
    assert "no results of demonstration" not in missing
    assert "configurations 0f, 1e" in missing
    assert "means over the curve are taken from step 10 to 50, shared by all" in missing
    assert "scalar-b: at step" not in missing
    # The mean over the curve of a finished variant is over what all share: half of 30..40 and 40..50, over 40.
    assert float(summary(tmp_path / "report")["relative", 500]["mean"]) == pytest.approx(0.6 * 15 / 40, abs=0.01)


def test_seeds_budgets_and_pieces_of_the_plan_without_results_are_named(runs, tmp_path):
    grid = {"guidance": ["none", "relative"], "seeds": list(range(10)), "labels": [100, 700]}
    planned(runs, total_steps=100, grid=grid)
    for name, index in (("unguided", 3), ("relative-100", 5)):
        planned(runs / name, total_steps=100, shard={"index": index, "count": 1000, "seeds": list(range(1000))})
    missing = report([runs], tmp_path / "report").read_text().split("## Missing")[1].split("## Where")[0]
    for kind in grid["guidance"]:
        assert f"no results of {kind} guidance with the seeds 8, 9" in missing
    assert "no results of relative guidance with the label budgets 700" in missing
    assert "none guidance with the label" not in missing
    assert "shards not begun, of 1000: 1, 2, 4, 6, 7" in missing


def test_a_metric_that_is_not_finite_is_left_out_and_said(tmp_path):
    constants = {"run": "a", "task": "one_ball", "guidance": "none", "config_hash": "0f", "labels": 0}
    with TableWriter(tmp_path / "a", results.SCHEMA, constants) as writer:
        for step, second in ((0, 0.1), (10, float("nan")), (20, 0.3)):
            writer.append(step=step, split="validation", seed=[0, 1], reward=[0.1, second])
    text = report([tmp_path / "a"], tmp_path / "report").read_text()
    assert "1 validation rows have no finite reward" in text
    assert "not all seeds keep results of equally many episodes" in text
    assert float(summary(tmp_path / "report")["none", 0]["final"]) == pytest.approx(0.2)


def lose(folder, guidance, labels=0, seeds=(0, 1, 2), by=20):
    """Appends lanes that had failed by a step: their values before then must not count, those after are null."""
    constants = {"run": folder.name, "task": "one_ball", "guidance": guidance, "config_hash": "0f", "labels": labels}
    with TableWriter(folder, results.SCHEMA, constants) as writer:
        for step in STEPS:
            reward = np.full(len(seeds), 7.0 if step < by else np.nan)
            writer.append(step=step, split="validation", seed=seeds, reward=reward, failed=float(step >= by))


def test_failed_lanes_count_in_no_mean_and_are_marked_everywhere(runs, tmp_path):
    report([runs], tmp_path / "before")
    lose(runs / "relative-500", "relative", 500, seeds=[8, 9, 10])
    lose(runs / "first-try", "relative", 500, seeds=[0])  # trained again
    lose(runs / "scalar", "scalar", 100, seeds=[0, 1])
    text = report([runs], tmp_path / "after").read_text()
    before, after = summary(tmp_path / "before"), summary(tmp_path / "after")
    assert after["relative", 500] | {"failed": ""} == before["relative", 500] | {"failed": ""}
    assert [after[key]["failed"] for key in before] == ["0", "0", "3"]
    assert after.keys() == before.keys()
    assert "| relative | 500 | 8 of 11, 3 failed | 30 |" in text
    assert (
        "relative, 500 labels: seeds 8 (by step 20), 9 (by step 20), 10 (by step 20) failed, no longer finite: curve "
        "and means are over the other 8"
    ) in text
    assert "scalar, 100 labels: seeds 0 (by step 20), 1 (by step 20) failed, no longer finite: no lane is left" in text
    assert "all runs that have begun" not in text
    assert "rows have no finite" not in text  # they are counted once
    for name in ("curves.csv", "label_efficiency.svg"):
        assert (tmp_path / "after" / name).read_text() == (tmp_path / "before" / name).read_text()
    marked, plain = ((tmp_path / out / "curves.svg").read_text() for out in ("after", "before"))
    note = "a failed seed, left out"
    assert note in marked
    crosses = marked.count("<use ") - plain.count("<use ") - len(note)  # letters are drawn so too
    assert crosses == 3 + 1  # one for each lane that a curve lacks, and the legend's


def test_errors_are_clear_and_leave_no_folder(runs, tmp_path):
    out = tmp_path / "report"
    with pytest.raises(UserError, match="there are reward"):
        report([runs], out, ReportRequest(metric="success"))
    with pytest.raises(UserError, match="there are validation rows"):
        report([runs], out, ReportRequest(split="training"))
    lose(runs / "lost", "none", by=0)
    with pytest.raises(UserError, match=r"3 of 3 lanes failed, no longer finite \(none: seeds 0 \(by step 0\)"):
        report([runs / "lost"], out)
    write(runs / "again", "relative", 0.3, 100, seeds=[5])
    with pytest.raises(UserError, match=r"seed 5 of relative guidance with 100 labels occurs twice, in .*again and"):
        report([runs], out)
    assert not out.exists()
