import json
import re
import shlex
import shutil
import subprocess
import sys
from pathlib import Path
from xml.etree import ElementTree

import imageio.v2 as imageio
import pytest
from probes import long_but
from small_runs import BANDIT

from cuelearner_jax import studies
from cuelearner_jax.api.policies import load_policy
from cuelearner_jax.cli import dispatch, main
from cuelearner_jax.runs.order import make_plan
from cuelearner_jax.studies import train

TRAINED = ("agent", "guide", "guided")
README = Path(__file__).resolve().parents[2] / "README.md"


@pytest.mark.parametrize("policy", long_but(("agent", "uniform"), (*TRAINED, "uniform", "teacher", "heuristic")))
def test_every_policy_is_evaluated(run_folder, tmp_path, capsys, policy):
    out = tmp_path / "measured.json"
    command = ["evaluate", str(run_folder), "--policy", policy, "--steps", "20", "--envs", "10", "--out", str(out)]
    assert main(command) == 0
    told = capsys.readouterr().out
    assert "reward" in told
    trained = policy in TRAINED
    assert ("trained steps" in told) == ("bootstrap over seeds and 10 environments" in told) == trained
    assert ("mean over 10 environments of 2 steps, Student's t" in told) == (not trained)
    rows = json.loads(out.read_text())["rows"]
    lanes = {("none", 0), ("relative", 10), ("relative", 20)}
    assert {row["intervals"]["over"] for row in rows} == {"seeds" if trained else "episodes"}
    assert all(row["intervals"]["reward"][1] <= row["intervals"]["reward"][2] for row in rows)
    assert {(row["guidance"], row["labels"]) for row in rows} == (lanes if trained else {("-", 0)})


def test_two_policies_are_compared_on_the_same_episodes(run_folder, tmp_path, capsys):
    few, out = ["--steps", "20", "--envs", "10"], tmp_path / "compared.json"
    command = ["evaluate", str(run_folder), *few]
    assert main([*command, "--policy", "heuristic", "--compare", "uniform", "--out", str(out)]) == 0
    told = capsys.readouterr().out
    assert "difference over 10 environments of 2 steps, paired" in told
    assert "The 95% interval of the difference" in told
    assert "…" not in told  # every number is whole on a narrow terminal
    recorded = json.loads(out.read_text())
    (found,) = recorded["compared"]["differences"]
    assert (recorded["compared"]["with"], found["over"]) == ("uniform", "episodes")
    less = recorded["rows"][0]["reward"][0] - found["less"]["reward"][0]
    assert found["difference"]["reward"][0] == pytest.approx(less)
    assert main(["evaluate", str(run_folder), "--compare", "heuristic", *few]) == 0
    # a table for each kind and budget
    assert capsys.readouterr().out.count("difference over seeds and 10 environments") == 3


def test_lanes_are_chosen_and_what_cannot_be_is_refused_before_anything_is_measured(
    run_folder, refused, tmp_path, capsys, monkeypatch
):
    command, out = ["evaluate", run_folder, "--steps", "20", "--envs", "10"], tmp_path / "rows.json"
    chosen = ["--guidance", "relative", "--labels", "20", "--seed", "2001"]
    capsys.readouterr()
    for other in ("guided", shutil.copytree(run_folder, tmp_path / "copy")):
        out.unlink(missing_ok=True)
        assert main([str(word) for word in [*command, *chosen, "--compare", other, "--out", out, "--json"]]) == 0
        written = json.loads(out.read_text())
        assert json.loads(capsys.readouterr().out) == written
        for row in (*written["rows"], *(one["less"] for one in written["compared"]["differences"])):
            assert (row["guidance"], row["labels"], row["seeds"]) == ("relative", 20, [2001])
    monkeypatch.setattr(studies.evaluate, "rollout_lanes", None)
    refused([*command, "--policy", "uniform", "--compare", run_folder], "has 3 variants", tmp_path)
    refused([*command, "--seed", "5"], f"{run_folder} has no lane with seed 5: there are seeds 2000, 2001 ", tmp_path)
    refused([*command, "--policy", "uniform", "--seed", "2000"], "belongs to no lane", tmp_path)
    refused(["render", "shipped:billiards", "--policy", "heuristic", "--labels", "100"], "belongs to no lane", tmp_path)


def test_a_run_without_records_asks_for_the_lane(run_folder, refused, tmp_path):
    copy = shutil.copytree(run_folder, tmp_path / "copy", ignore=lambda *_: ["results.parquet"])
    command = ["export", copy, "--format", "numpy", "--out", tmp_path / "new"]
    refused(command, "choose the lane by --guidance, --labels and --seed", tmp_path)
    assert load_policy(copy, guidance="relative", labels=20, seed=2001).lane["seed"] == 2001


def test_a_task_alone_is_drawn_on_any_of_its_tables(tmp_path):
    """What needs no training fits whatever the world shows."""
    assert main(["render", "billiards", "--task.table", "one_ball", "--question", "--out", str(tmp_path)]) == 0


def test_the_sweep_of_the_readme_would_begin(run_folder, monkeypatch, tmp_path):
    (line,) = re.findall(r"^cuelearner (sweep .*)$", README.read_text(encoding="utf-8"), re.MULTILINE)
    orders = []
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(train, "run", lambda order: orders.append(make_plan(order).order))
    assert main(shlex.split(line)) == 0
    assert orders[0].grid.guidance == ("none", "relative")
    assert main(["sweep", "billiards", "--labels", "0", "50", "--seeds", "5:7", "--schedule.total-steps", "6e4"]) == 0
    grid = orders[1].grid
    assert (grid.guidance[0], grid.labels, grid.seeds) == ("none", (50,), (5, 6))
    assert orders[1].config.schedule.total_steps == 60_000
    for command in (["sweep", BANDIT, "--seeds", "2"], ["train", BANDIT, "--seed", "2001"]):  # all labels of a file
        options = ["--guidance", "relative", "--labels-from", str(run_folder / "relative" / "labels.parquet")]
        assert main([*command, *options]) == 0
        assert orders.pop().grid.labels == (20,)


def test_a_report_has_curves_and_tables(run_folder, tmp_path, capsys):
    out = tmp_path / "report"
    assert main(["report", str(run_folder), "--out", str(out)]) == 0
    assert ElementTree.parse(out / "curves.svg").getroot().tag.endswith("svg")
    assert imageio.imread(out / "curves.png").std() > 1
    capsys.readouterr()
    assert main(["report", str(run_folder), "--json"]) == 0
    rows = json.loads(capsys.readouterr().out)["rows"]
    assert [(row["guidance"], row["labels"]) for row in rows] == [("none", 0), ("relative", 10), ("relative", 20)]
    assert "| relative | 20 | 2 |" in (out / "report.md").read_text()
    assert (out / "label_efficiency.png").exists()


def test_the_overview_has_a_line_for_each_command(capsys):
    assert main(["--help"]) == 0
    told = capsys.readouterr().out
    for name in dispatch.COMMANDS:
        assert re.search(rf"^  {name} +[A-Z].*\.$", told, re.MULTILINE), name


def test_what_needs_no_jax_does_not_load_it():
    code = """
import sys
from cuelearner_jax.cli import main
assert main(["--help"]) == main(["--version"]) == 0
slow = {"jax", "numpy", "matplotlib", "tyro", "rich", "cuelearner_envs"}
print(*sorted(slow & {name.partition(".")[0] for name in sys.modules}))
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    first, *_, version, loaded = done.stdout.split("\n")[:-1]
    assert first == "usage: cuelearner COMMAND ..."
    assert re.fullmatch(r"cuelearner \d+\.\d+\.\d+", version)
    assert loaded == ""


@pytest.mark.parametrize("command", ["sweep", "evaluate"])
@pytest.mark.parametrize("subject", [[], ["billiards"]], ids=["no task", "a task"])
def test_help_lists_options_and_what_a_task_has_to_choose_from(command, subject, capsys):
    with pytest.raises(SystemExit) as stopped:
        main([command, *subject, "--help"])
    out, err = capsys.readouterr()
    assert (stopped.value.code, err) == (0, "")
    assert all(option in out for option in ("--env", "--teacher", "--preset"))
    if subject:
        default = "quickstart" if command == "sweep" else "paper"
        assert f"presets (--preset; {default} where none is given):\n  paper " in out
        assert re.search(r"^  tilted_table +.*\(--task\.acceleration ", out, re.MULTILINE)
        assert "--task.table {one_ball,easy,regulation}" in out
    else:
        assert "tasks: arm, billiards, " in " ".join(out.split())
