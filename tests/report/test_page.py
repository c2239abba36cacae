"""The report as a page: its numbers are the table's, and what names hold is text."""

import json
import re
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest

from cuelearner_jax.report import page
from cuelearner_jax.report.document import report
from cuelearner_jax.report.statistics import Curve, Interval
from cuelearner_jax.report.tables import summary
from cuelearner_jax.report.variants import Variant

ROOT = Path(__file__).parents[2]


class Tags(HTMLParser):
    def __init__(self, text):
        super().__init__()
        self.found, self.sources, self.data, self._inside = [], [], "", False
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        self.found.append(tag)
        self.sources += [value for name, value in attrs if name in ("src", "href")]
        self._inside = ("id", "data") in attrs

    def handle_data(self, data):
        if self._inside:
            self.data, self._inside = data, False


def variant(guidance, labels, values, run=""):
    values = np.asarray(values, float)
    mean = values.mean(0)
    known = Curve(np.array([0, 100]), mean, values.min(0), values.max(0))
    around = Interval(mean.mean(), values.min(), values.max())
    return Variant(guidance, labels, np.arange(len(values)), values, known, around, np.zeros(0, int), run)


def test_the_page_of_recorded_results_is_one_file_with_the_numbers_of_the_curves(tmp_path):
    report(ROOT / "docs" / "data" / "quickstart", tmp_path / "report")
    text = (tmp_path / "report" / "report.html").read_text()
    tags = Tags(text)
    assert tags.sources == []
    assert "http" not in re.sub(r"http://www.w3.org/2000/svg", "", text.partition("Where the numbers")[0])
    curves = json.loads(tags.data)[0]
    rows = (tmp_path / "report" / "curves.csv").read_text().splitlines()[1:]
    told = [point for series in curves["series"] for point in series["points"]]
    assert len(told) == len(rows)
    for point, row in zip(told, rows, strict=True):
        step, *values = row.split(",")[-4:]
        assert point["x"] == int(step)
        assert [point["y"], point["lower"], point["upper"]] == pytest.approx([float(v) for v in values], rel=1e-5)


def test_budgets_have_a_figure_in_which_what_takes_no_labels_is_a_level():
    found = [
        variant("none", 0, [[0.0, 0.2], [0.0, 0.4]]),
        variant("relative", 50, [[0.0, 0.5], [0.1, 0.7]]),
        variant("relative", 100, [[0.0, 0.9], [0.1, 0.9]]),
    ]
    text = page.page("t", found, summary(found), "reward", [], [])
    curves, budgets = json.loads(Tags(text).data)
    assert [len(series["points"]) for series in curves["series"]] == [2, 2, 2]
    level, guided = budgets["series"]
    assert (level["level"], guided["level"]) == (True, False)
    assert [point["x"] for point in level["points"]] == [point["x"] for point in guided["points"]] == [50, 100]
    assert [point["y"] for point in guided["points"]] == pytest.approx([0.325, 0.475])


def test_names_are_text_and_missing_values_are_none():
    bad = "</script><script>alert(1)</script>{{data}}"
    found = [variant(bad, 0, [[np.nan, 0.2]], run=bad), variant("none", 0, [[0.0, 0.1]], run="a")]
    rows = [{**row, "guidance": bad} for row in summary(found)]
    text = page.page(bad, found, rows, "reward", [bad], [("command", bad)])
    tags = Tags(text)
    assert tags.found.count("script") == 2  # the data and the page's own
    curves = json.loads(tags.data)[0]
    assert curves["series"][0]["points"][0] == {"x": 0, "y": None, "lower": None, "upper": None}
    assert "<script>alert" not in text
