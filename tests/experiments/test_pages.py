"""The result pages: short enough to read, and their tables and pictures are there."""

import importlib
import re
from pathlib import Path

import pytest

DOCS = Path(__file__).parents[2] / "docs"
RESULTS = sorted([*(DOCS / "results").glob("*.md"), DOCS / "results.md"])
MOST_ROWS, MOST_WORDS = 12, 250


@pytest.mark.parametrize("page", RESULTS, ids=lambda page: page.stem)
def test_a_page_is_short_and_its_tables_and_pictures_are_there(page):
    text = page.read_text(encoding="utf-8")
    assert len(re.findall(r"^\|.*\|$", text, re.MULTILINE)) - 2 <= MOST_ROWS
    prose = re.sub(r"\]\([^)]*\)|^\|.*\|$", " ", text, flags=re.MULTILINE)
    assert len([word for word in prose.split() if re.search(r"\w", word)]) <= MOST_WORDS
    assert all((DOCS / file).is_file() for file in re.findall(r"tables\.md\?file=([^)]+)\)", text))
    assert all((page.parent / picture).is_file() for picture in re.findall(r"!\[[^]]*\]\(([^)]+)\)", text))


def test_every_figure_is_drawn_from_its_file():
    figures = importlib.import_module("results_figures")
    assert {file.stem for file in (DOCS / "data" / "results").glob("*.csv")} == set(figures.TITLES)
    for name in figures.TITLES:
        assert any(axes.lines for axes in figures.draw(name).axes)
        assert (DOCS / "figures" / f"results_{name}.png").is_file()
