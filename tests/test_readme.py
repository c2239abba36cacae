"""The README is short, its numbers are what docs/data hold, and each kind of feedback has a page."""

import csv
import re
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest

from cuelearner_jax.arbiters import ARBITERS
from cuelearner_jax.guides import registry
from cuelearner_jax.report.document import ReportRequest, contents_of
from cuelearner_jax.report.statistics import interquartile_mean

ROOT = Path(__file__).resolve().parents[1]
README, DATA, PAGES = (ROOT / "README.md").read_text(encoding="utf-8"), ROOT / "docs/data", ROOT / "docs/feedback"
UNTAUGHT = {"none", "heuristic", "any_aim"}
PAGE_OF = dict.fromkeys(UNTAUGHT, "no_labels") | {"clic_shown": "clic"}


def row(of):
    """The cells of the README's one row about something."""
    (line,) = [line for line in README.splitlines() if line.startswith(f"| {of}")]
    return [cell.strip() for cell in line.strip("|").split("|")]


def test_the_readme_is_short():
    assert len(README.splitlines()) <= 110
    assert (ROOT / "docs/figures/labels_correct_an_arm.gif").stat().st_size <= 2_000_000


def test_links_of_the_readme_lead_somewhere():
    links = re.findall(r"\]\((?!https?:)([^)#\s]+)", README)
    assert len(links) > 15
    assert [link for link in links if not (ROOT / link).exists()] == []


def test_success_on_fetch_push():
    rows = pq.read_table(DATA / "scripted_arms.parquet").to_pylist()
    own = [r for r in rows if (r["robot"], r["change"]) == ("FetchPush", "camera 3 cm aside, declared")]
    mean = lambda kind, end: 100 * np.mean([row[end] for row in own if row["labels"] == kind])  # noqa: E731
    labelled, without = row("success on FetchPush")[1:3]
    assert labelled == f"100 labels: {mean('labels', 'after'):.0f}%"
    assert without == f"{mean('labels', 'before'):.0f}%; answers by chance: {mean('random', 'after'):.0f}%"


def test_error_left_from_logs():
    with (DATA / "correct_from_logs.csv").open() as file:
        rows = [row for row in csv.DictReader(file) if (row["guidance"], row["questions"]) == ("relative", "rounds")]
    left = {who: np.mean([float(row["left"]) for row in rows if row["answers"] == who]) for who in ("own", "shuffled")}
    labelled, without = row("error left in logs")[1:3]
    assert labelled == f"200 labels: {100 * left['own']:.0f}%"
    assert without == f"100%; shuffled answers: {100 * left['shuffled']:.0f}%"


def test_success_in_rooms():
    def success(piece):
        """Percent of the four agents on which no setting was chosen."""
        file = DATA / "adaptation/cpu/navigation/rooms" / piece / "adaptation.parquet"
        rows = pq.read_table(file, columns=["base", "success"]).to_pylist()
        held_out = [row["success"] for row in sorted(rows, key=lambda row: row["base"])[4:]]
        return 100 * float(interquartile_mean(held_out))

    labelled, without = row("success of a walker in rooms")[1:3]
    assert labelled == f"250 labels, 35,000 rewarded steps: {success('intent-180-look-ahead'):.1f}%"
    assert without == f"{success('none'):.1f}%"


def test_steps_of_an_arm_that_learns_to_pick():
    request = ReportRequest(metric="success", by_run=True, level=0.8)
    rows = contents_of(sorted((DATA / "arms/pick").iterdir()), request).efficiency.tables["efficiency"]
    page = (PAGES.parent / "results/arms.md").read_text(encoding="utf-8")
    assert all(f"| {one['steps_to_level']:,.0f} [{one['steps_to_level_lower']:,.0f}, " in page for one in rows)
    steps = {(one["run"], one["labels"], one["guidance"]): f"{round(one['steps_to_level'], -3):,.0f}" for one in rows}
    both = [f"500 labels: {steps['stored', 500, 'relative']}", steps["alone", 0, "none"]]
    assert row("steps to 80% success of an arm")[1:3] == both


def test_success_of_robots_drawn_by_chance():
    rows = pq.read_table(DATA / "zoo.parquet").to_pylist()
    robots = {(one["cues"], one["robot"]) for one in rows}
    worlds = {(one["error"], one["fault"]) for one in rows}
    what, labelled, without = row(f"success of {len(robots)} small robots")[:3]
    assert f"in {len(worlds)} changed worlds" in what
    assert labelled == f"100 labels: {np.mean([one['after success'] for one in rows]):.2f}"
    assert without == f"{np.mean([one['before success'] for one in rows]):.2f}"


def test_each_kind_of_feedback_has_a_page():
    index = (PAGES / "index.md").read_text(encoding="utf-8")
    for kind in registry.BUILT_IN:
        page = (PAGES / f"{PAGE_OF.get(kind.name, kind.name)}.md").read_text(encoding="utf-8")
        assert f"`{kind.name}`" in index or kind.name == "none"
        assert kind.name in page
        assert {"## Equation", "## Run", "## When"} <= set(page.splitlines()), kind.name
        assert re.search(r"!\[.+\]\(\.\./figures/feedback/\w+\.svg\)", page), kind.name
    arbiters = (PAGES / "arbiters.md").read_text(encoding="utf-8")
    assert [name for name in (kind.NAME for kind in ARBITERS.values()) if f"`{name}`" not in arbiters] == []


def test_the_table_says_what_a_kind_serves():
    lines = (PAGES / "index.md").read_text(encoding="utf-8").splitlines()
    head = next(line for line in lines if line.startswith("| `--guidance` | you say"))
    names = [cell.strip() for cell in head.strip("|").split("|")]
    for kind in registry.BUILT_IN:
        if kind.name in UNTAUGHT:
            continue
        (line,) = [line for line in lines if line.startswith(f"| [`{kind.name}`](")]
        cells = dict(zip(names, (cell.strip() for cell in line.strip("|").split("|")), strict=True))
        assert cells["training"] == ("no" if kind.adapts_only else "yes")
        assert cells["unordered choices"] == ("no" if kind.needs_cues else "yes")


@pytest.mark.long
def test_the_lines_of_the_readme_run(tmp_path, monkeypatch, capsys):
    """They correct the policy whose camera was moved."""
    pytest.importorskip("gymnasium_robotics")
    monkeypatch.chdir(tmp_path)
    (block,) = re.findall(r"```python\n(.*?)```", README, re.S)
    exec(compile(block, "README.md", "exec"), {})
    before, after = [float(line.strip("[]. ")) for line in capsys.readouterr().out.split("\n") if line.startswith("[")]
    assert (before, after) == (0.0, 1.0)
