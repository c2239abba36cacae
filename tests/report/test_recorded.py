"""What docs/results/training.md says of recorded runs is what their data in docs/data give."""

import json
from pathlib import Path

import numpy as np
import pyarrow.compute as pc
import pytest

from cuelearner_jax.report.statistics import interval, mean_over_curve
from cuelearner_jax.storage import results

ROOT = Path(__file__).parents[2]
DATA = ROOT / "docs" / "data"
KINDS = [("none", 0), ("heuristic", 0), ("relative", 100), ("relative", 350), ("relative", 500)]


@pytest.fixture(scope="module")
def said():
    return (ROOT / "docs" / "results" / "training.md").read_text(encoding="utf-8")


def told(values):
    """As the page writes a variant: 0.417 [0.400, 0.449]."""
    found = interval(np.asarray(values, float))
    return f"{float(found.estimate):.3f} [{float(found.lower):.3f}, {float(found.upper):.3f}]"


def rows_of(table, guidance, labels):
    return table.filter((pc.field("guidance") == guidance) & (pc.field("labels") == labels))


def at(rows, step, metric):
    return [value for value in rows.filter(pc.field("step") == step)[metric].to_pylist() if value is not None]


def cells(page, beginning):
    """The cells of the rows of tables that begin so."""
    lines = [line for line in map(str.strip, page.splitlines()) if line.startswith(f"| {beginning}")]
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in lines]


def test_the_quickstart(said):
    for name, machine in (("quickstart", "CPU"), ("quickstart_h200", "H200")):
        table = results.read(DATA / name)
        for kind, labels, row in (
            ("none", 0, f"no guidance, {machine}"),
            ("relative", 100, f"100 relative labels, {machine}"),
        ):
            assert cells(said, row)[0][1] == told(at(rows_of(table, kind, labels), 3_000, "reward"))


def test_three_large_balls(said):
    section = said.split("## Three balls")[1].split("\n## ")[0]
    curves, alone = section.split("The guide alone, before")
    names = ["unguided", "heuristic", "relative, 500", "relative, 1,000"]
    for column, (name, step) in enumerate([("plain", 200_000), ("mirrors", 180_000), ("mirrors", 200_000)], start=1):
        table = results.read(DATA / "billiards_easy" / name)
        most = 1_000 if name == "plain" else 2_000
        kinds = [("none", 0), ("heuristic", 0), ("relative", 500), ("relative", most)]
        for row, kind in zip(names, kinds, strict=True):
            values = at(rows_of(table, *kind), step, "reward")
            assert cells(curves, row)[0][column] == (told(values) if values else "")
            guide = at(rows_of(table, *kind), 0, "guide_reward")
            shown = cells(alone, row if row != "unguided" else "none")[0][1 if name == "plain" else 2]
            assert shown == (told(guide) if kind[1] else f"{np.mean(guide):.3f}")
            assert kind[1] or len(set(guide)) == 1


def test_the_papers_table(said):
    table = rows_of(results.read(DATA / "billiards_paper"), "none", 0)
    shown = cells(said.split("## The paper's table")[1], "reward a shot")[0][1:]
    steps = [0, 800_000, 1_600_000, 2_400_000]
    assert shown[:-1] == [told(at(table, step, "reward")).split()[0] for step in steps]
    assert shown[-1] == told(at(table, 3_000_000, "reward"))


def test_navigation(said):
    section = said.split("\n## Navigation")[1].split("\n## ")[0]
    table = results.read(DATA / "navigation")
    names = ["unguided", "heuristic", "relative, 100", "relative, 350", "relative, 500"]
    for name, kind in zip(names, KINDS, strict=True):
        rows = rows_of(table, *kind)
        late, early = cells(section, name)
        assert late[1:3] == [told(at(rows, step, "success")) for step in (50_000, 140_000)]
        assert late[3] == told(at(rows, 140_000, "collision"))
        assert early[1:3] == [told(at(rows, step, "success")) for step in (10_000, 20_000)]
        steps = 10_000 * np.arange(15)
        curves = np.array([at(rows, step, "success") for step in steps]).T
        assert early[3] == told(mean_over_curve(steps, curves))


def test_navigation_after_training(said):
    for labels in (100, 350, 500):
        (shown,) = (row for row in cells(said, f"{labels} |") if len(row) == 7)
        file = DATA / "navigation" / "evaluations"
        found = {}
        for name in ("agent", "agent-corridor", "agent-rooms", "guide"):
            (found[name],) = json.loads((file / f"relative-{labels}-{name}.json").read_text())["rows"]
        assert shown[1:3] == [told(found["agent"]["success"]), told(found["agent"]["collision"])]
        rest = [found[name]["success"] for name in ("agent-corridor", "agent-rooms", "guide")]
        assert shown[3:6] == [told(values) for values in rest]
        assert shown[6] == f"{min(found['agent']['success']):.3f}"


def test_label_strength(said):
    recorded = json.loads((DATA / "label_strength.json").read_text())
    assert "dirty" not in recorded["commit"]
    for row in recorded["rows"]:
        low, high = row["interval"]
        shown = cells(said, f"{row['eps_deg']} deg")[0][1:]
        assert shown == [f"{row['iqm']:.3f} [{low:.3f}, {high:.3f}]", f"{row['mean']:.3f}", f"{row['rewards'][0]:.3f}"]


def test_the_quadruped():
    page = (ROOT / "docs" / "anymal.md").read_text(encoding="utf-8")
    rows = json.loads((DATA / "anymal_navigation.json").read_text())["rows"]
    found = {(row["style"], row["robot"], row["episodes"]): row for row in rows}
    for style in ("clutter", "corridor", "rooms"):
        shown = cells(page, f"{style} |")[0]
        simple, legged = found[style, "simple", 500], found[style, "anymal", 500]
        assert shown[1].split()[0] == f"{100 * simple['success']:.1f}"
        assert shown[2].split()[0] == f"{100 * legged['success']:.1f}"
        assert shown[3] == " / ".join(f"{100 * legged[name]:.1f}" for name in ("collision", "fall", "timeout"))
    legged, simple = found["clutter", "anymal", 500], found["clutter", "simple", 500]
    lost = simple["success"] - legged["success"]
    assert legged["fall"] == pytest.approx(lost)  # "The gap is falls ... as much as it loses"
    both = [row["collision"] + row["timeout"] for row in (legged, simple)]
    assert both[0] == pytest.approx(both[1])
