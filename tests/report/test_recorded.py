"""What docs/results/training.md says of recorded runs is what their data in docs/data give."""

import json
from pathlib import Path

import numpy as np
import pyarrow.compute as pc
import pytest

from cuelearner_jax.report.statistics import interval
from cuelearner_jax.storage import results

ROOT = Path(__file__).parents[2]
DATA = ROOT / "docs" / "data"


@pytest.fixture(scope="module")
def said():
    return (ROOT / "docs" / "results" / "training.md").read_text(encoding="utf-8")


def told(values, each=None):
    """As the page writes a variant, with episodes' results where there are any: 0.417 [0.400, 0.449]."""
    mean, lower, upper = map(float, interval(np.asarray(values, float), each))
    return f"{mean:.3f} [{f'{lower:.3f}, {upper:.3f}' if lower < upper else 'no spread'}]"


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
        (shown,) = cells(said, f"one ball, {machine}")
        for column, kind in ((1, ("none", 0)), (3, ("relative", 100))):
            rows = rows_of(table, *kind)
            each = np.array(at(rows, 3_000, "reward_each")) if "reward_each" in table.column_names else None
            assert shown[column] == told(at(rows, 3_000, "reward"), each)


def test_navigation(said):
    table = results.read(DATA / "navigation")
    kinds = [("none", 0), ("heuristic", 0), ("relative", 100), ("relative", 500)]
    for beginning, step, metric in (
        ("navigation: success after 50,000", 50_000, "success"),
        ("navigation: success after 140,000", 140_000, "success"),
        ("navigation: collisions", 140_000, "collision"),
    ):
        (shown,) = cells(said, beginning)
        assert shown[1:] == [told(at(rows_of(table, *kind), step, metric)) for kind in kinds]


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
