"""How far labels carry, on curves whose answers are known by hand; and the command that tells it."""

import csv
import json
from collections.abc import Sequence

import numpy as np
import pytest

from cuelearner_jax.cli import main
from cuelearner_jax.errors import UserError
from cuelearner_jax.report.efficiency import Question, cell, efficiency_of
from cuelearner_jax.report.tables import summary
from cuelearner_jax.report.variants import Variant
from cuelearner_jax.storage import formats, results
from cuelearner_jax.storage.table import TableWriter

STEPS = np.arange(0, 101, 10)


def ramp(slope, most=1.0):
    """A curve of that many units over all steps."""
    return np.minimum(slope * STEPS / 100, most)


def variant(guidance, labels, curves, *, run="", guide: Sequence[float] | None = None):
    values = np.atleast_2d(np.asarray(curves, float))
    guides = None if guide is None else np.asarray(guide, float)
    return Variant(guidance, labels, np.arange(len(values)), STEPS, values, run=run, guide=guides)


def same(guidance, labels, slope, **more):
    """Five seeds that are all alike, so that every interval is its estimate."""
    return variant(guidance, labels, [ramp(slope)] * 5, **more)


def known(row, name):
    """Bounds of an estimate and its interval."""
    value = row.get(name)
    bounds = (row[f"{name}_above"], row[f"{name}_below"]) if value is None else (value, value)
    return [*bounds, row[f"{name}_lower"], row[f"{name}_upper"]]


def test_known_curves_give_known_steps_ratios_and_areas():
    unguided, guided = same("none", 0, 1.0), same("relative", 100, 2.0, guide=[0.1] * 5)
    plain, steered = efficiency_of([unguided, guided], Question(level=0.6)).tables["efficiency"]
    assert known(plain, "steps_to_level") == pytest.approx([60.0] * 4)
    assert known(steered, "steps_to_level") == pytest.approx([30.0] * 4)
    assert known(steered, "steps_ratio") == pytest.approx([0.5] * 4)
    assert (plain["reached"], steered["reached"], "steps_ratio" in plain) == (1.0, 1.0, False)
    for name, value in (("mean", 0.75), ("mean_difference", 0.25), ("mean_ratio", 1.5)):
        assert [steered[name + end] for end in ("", "_lower", "_upper")] == pytest.approx([value] * 3)
    assert steered["guide"] == pytest.approx(0.1)
    assert "guide_lower" not in steered  # its episodes are not kept
    shared = np.arange(5)[:, None] / 10  # by equal seeds, which are drawn together
    pair = [variant("none", 0, ramp(1.0) + shared), variant("relative", 100, ramp(1.0) + shared + 0.2)]
    row = efficiency_of(pair, Question(level=0.9)).tables["efficiency"][1]
    assert [row[f"mean_difference{end}"] for end in ("_lower", "_upper")] == pytest.approx([0.2] * 2)
    negative = [same("none", 0, -0.2), same("relative", 100, -0.1)]
    assert "mean_ratio" not in efficiency_of(negative, Question(level=0.1)).tables["efficiency"][1]


def test_a_shorter_curve_is_held_against_the_whole_gain_of_unguided_agents():
    early = Variant("relative", 100, np.arange(5), STEPS[:6], np.array([ramp(2.0)[:6]] * 5))
    assert summary([same("none", 0, 1.0), early])[1]["reaches_unguided"] == 45


def test_the_level_is_the_unguided_agents_at_a_step():
    variants = [same("none", 0, 0.8), same("relative", 100, 1.6)]
    assert efficiency_of(variants, Question(level_at=50)).level == pytest.approx(0.4)
    found = efficiency_of(variants, Question())
    assert (found.level, found.origin) == (pytest.approx(0.72), "90% of the gain of no guidance over the curve")
    with pytest.raises(UserError, match="--level-at 55: no guidance has no such step, but 0, 10, 20"):
        efficiency_of(variants, Question(level_at=55))
    with pytest.raises(UserError, match="no results of unguided agents"):
        efficiency_of(variants[1:], Question())
    with pytest.raises(UserError, match="no better than what no guidance begins with"):
        efficiency_of(variants, Question(level=0.0))


def test_a_curve_that_never_gets_there_is_a_bound_and_no_number():
    variants = [same("none", 0, 1.0), same("relative", 100, 0.3)]
    row = efficiency_of(variants, Question(level=0.5)).tables["efficiency"][1]
    assert known(row, "steps_to_level") == [100.0, np.inf, 100.0, np.inf]
    assert known(row, "steps_ratio") == [2.0, np.inf, 2.0, np.inf]  # more than 100 steps over 50
    assert row["reached"] == 0.0
    assert cell(row, "steps_ratio", "{:.1f}") == "above 2.0 [2.0, no bound]"
    assert cell(row | {"steps_ratio_lower": 0.9}, "steps_ratio", "{:.1f}") == "not told apart"
    assert cell(row | {"steps_ratio_lower": 1.0}, "steps_ratio", "{:.1f}") == "above 2.0 [1.0, no bound]"
    # Unguided agents that never get there: the others need less than their share of all steps.
    variants = [same("none", 0, 0.3), same("relative", 100, 1.0)]
    row = efficiency_of(variants, Question(level=0.5)).tables["efficiency"][1]
    assert known(row, "steps_ratio") == [0, 0.5, 0, 0.5]


def test_labels_for_equal_areas():
    """Ten times as many scalar labels do what relative ones do; outside their budgets there is a bound alone."""
    slopes = {10: 0.2, 100: 0.4, 1000: 0.6}
    variants = [same("relative", budget, slope) for budget, slope in slopes.items()]
    variants += [same("scalar", 10 * budget, slope) for budget, slope in slopes.items()]
    found = efficiency_of(variants, Question(level=0.1)).tables["equal_area"]
    ratios = {(row["reference"], row["reference_labels"]): known(row, "labels_ratio") for row in found}
    assert ratios["relative", 100] == pytest.approx([10.0] * 4)
    assert ratios["relative", 1000] == pytest.approx([10.0] * 4)
    assert ratios["relative", 10] == pytest.approx([0.0, 10.0, 0.0, 10.0])  # its smallest budget does as well
    assert ratios["scalar", 1000] == pytest.approx([0.1] * 4)
    assert found[1]["mean"] == pytest.approx(0.2)
    better = [same("relative", budget, 2 * slope) for budget, slope in slopes.items()]
    found = efficiency_of([*better, *variants[3:]], Question(level=0.1, reference="relative")).tables["equal_area"]
    assert [(row["reference"], row["reference_labels"]) for row in found] == [("relative", b) for b in slopes]
    assert known(found[2], "labels") == [10000.0, np.inf, 10000.0, np.inf]
    with pytest.raises(UserError, match="--reference dcoach: no results with its labels; there are relative, scalar"):
        efficiency_of(variants, Question(level=0.1, reference="dcoach"))


def write(folder, guidance, labels, slope, *, seeds: Sequence[int] = range(4), guide=0.1):
    known = {"run": folder.name, "task": "one_ball", "guidance": guidance, "config_hash": folder.parent.name}
    with TableWriter(folder, results.SCHEMA, known) as writer:
        for step, value in zip(STEPS, ramp(slope), strict=True):
            row = {"reward": value + 0.001 * np.array(seeds)}
            row |= {"guide_reward": guide + 0.001 * np.array(seeds)} if step == 0 else {}
            writer.append(step=step, split="validation", seed=np.array(seeds), labels=labels, wall_s=1.0, **row)
    (folder / "config.json").write_text(json.dumps({"total_steps": int(STEPS[-1])}))


@pytest.fixture
def runs(tmp_path):
    for run, factor in (("raw", 0.5), ("frame", 1.0)):
        write(tmp_path / run / "none", "none", 0, factor)
        for kind, better in (("relative", 1.6), ("scalar", 1.2)):
            for labels, more in ((100, 0.0), (500, 0.5)):
                write(tmp_path / run / f"{kind}-{labels}", kind, labels, factor * (better + more), guide=0.1 * better)
    return tmp_path


def rows(file):
    return list(csv.DictReader(file.read_text().splitlines()))


def test_kinds_and_budgets_are_chosen_and_json_tells_what_is_missing(runs, capsys):
    formats.write("config", runs / "raw" / "config.json", {"grid": {"guidance": ["clic"]}})
    command = ["report", str(runs / "raw"), "--json"]
    assert main([*command, "--guidance", "none", "scalar", "--labels", "500", "--level", "0.4"]) == 0
    shown = json.loads(capsys.readouterr().out)
    assert [(row["guidance"], row["labels"]) for row in shown["rows"]] == [("none", 0), ("scalar", 500)]
    assert [row["steps_ratio"] for row in shown["efficiency"][1:]] == [pytest.approx(1 / 1.7, abs=0.01)]
    assert any("no results of clic guidance" in line for line in shown["missing"])
    assert main([*command, "--labels", "7"]) == 2
    assert "--labels 7: no such results; there are 0, 100, 500" in capsys.readouterr().err


def test_the_command_writes_tables_and_a_section(runs, tmp_path):
    out = tmp_path / "report"
    command = [str(runs / "raw"), str(runs / "frame"), "--by-run", "--level", "0.4"]
    assert main(["report", *command, "--reference", "relative", "--out", str(out)]) == 0
    text = (out / "report.md").read_text()
    section = text.split("## Label efficiency")[1].split("## Missing")[0]
    assert "The level is 0.400: given." in section
    table = {(row["run"], row["guidance"], int(row["labels"])): row for row in rows(out / "efficiency.csv")}
    own = table["frame", "relative", 500]
    assert float(own["steps_ratio"]) == pytest.approx(1 / 2.1, abs=0.01)
    assert own["against"] == "frame: no guidance"
    shown, *_ = (row for row in section.splitlines() if row.startswith("| frame | relative | 500 | "))
    assert f"| {float(own['steps_ratio']):.2f} [" in shown
    assert {row["reference"] for row in rows(out / "equal_area.csv")} == {"relative"}
    assert [float(row["mean"]) for row in rows(out / "summary.csv")] == [float(row["mean"]) for row in table.values()]
    assert "differ in more than" not in text  # each run has one configuration
