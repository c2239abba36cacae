"""The result pages: short enough to read, true to the data they are generated from, and their tables are there."""

import importlib
import re
import sys
from pathlib import Path

import pytest

DOCS = Path(__file__).parents[2] / "docs"
PAGES = sorted(
    [*(DOCS / "results").glob("*.md"), *(DOCS / f"{name}.md" for name in ("results", "scaling", "reliability"))]
)
MOST_WORDS = 900


@pytest.fixture(scope="module", autouse=True)
def experiments():
    sys.path.insert(0, str(DOCS.parent / "experiments"))
    yield
    sys.path.remove(str(DOCS.parent / "experiments"))


def visible(text):
    """The words of a page that stand before no fold, in no code, and are no addresses."""
    text = re.sub(r"^( *)```.*?^\1```", "", text, flags=re.DOTALL | re.MULTILINE)
    text = re.sub(r"^\?\?\?.*\n(?:(?:    .*)?\n)*", "", text, flags=re.MULTILINE)
    text = re.sub(r"\]\([^)]*\)|<!--.*?-->", " ", text)
    return [word for word in re.split(r"[\s|]+", text) if re.search(r"\w", word)]


def test_words_behind_a_fold_in_code_and_in_addresses_do_not_count():
    text = 'one [two](far/away.md)\n\n??? note "title"\n\n    folded\n\n    too\n\nthree\n```sh\ncode\n```\n| 4 | - |\n'
    assert visible(text) == ["one", "[two", "three", "4"]


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_a_page_has_few_words_and_its_tables_and_pictures_are_there(page):
    text = page.read_text(encoding="utf-8")
    assert len(visible(text)) <= MOST_WORDS
    for file in re.findall(r"tables\.md\?file=([^)]+)\)", text):
        assert (DOCS / file).is_file()
    for picture in re.findall(r"!\[[^]]*\]\(([^)]+)\)", text):
        assert (page.parent / picture).is_file()


def test_findings_and_arms_are_those_of_the_data():
    for name, page, data in (
        ("results_page", "results.md", ()),
        ("arms_page", "results/arms.md", (DOCS / "data/arms",)),
    ):
        made = importlib.import_module(name)
        text = (DOCS / page).read_text(encoding="utf-8")
        assert made.rendered(text, made.sections(*data, DOCS / page)) == text


def test_the_page_of_adaptation_begins_with_what_was_recorded():
    overview = importlib.import_module("_adaptation_overview")
    text = (DOCS / "results" / "adaptation.md").read_text(encoding="utf-8")
    assert overview.table(overview.found_in(DOCS / "data" / "adaptation")) in text


@pytest.mark.long
def test_all_tables_of_adaptation_are_what_was_recorded():
    page, file = importlib.import_module("adaptation_page"), DOCS / "results" / "adaptation.md"
    text, data = file.read_text(encoding="utf-8"), DOCS / "data" / "adaptation"
    before = {path: path.read_bytes() for path in (data / "tables").iterdir()}
    assert page.rendered(text, page.sections(data, file)) == text
    assert {path: path.read_bytes() for path in (data / "tables").iterdir()} == before


def test_a_page_shows_sections_between_their_marks_and_nothing_else_changes():
    pages = importlib.import_module("_pages")
    text = "# A\n\n<!-- easy -->\nold\n<!-- end of easy -->\n\nrest\n"
    once = pages.rendered(text, {"easy": "| a |"})
    assert once == "# A\n\n<!-- easy -->\n\n| a |\n\n<!-- end of easy -->\n\nrest\n"
    assert pages.rendered(once, {"easy": "| a |"}) == once
    with pytest.raises(ValueError, match="no place for full"):
        pages.rendered(text, {"full": "x"})


def test_intervals_have_columns_of_their_own_in_a_csv_file(tmp_path):
    pages = importlib.import_module("_pages")
    rows = [["a", "0.62 [0.54, 1,071]", "above 500 [99, above 500] labels"], ["b", "0.3", ""]]
    pages.write_csv(tmp_path / "table.csv", ["name", "value", "after"], rows)
    assert (tmp_path / "table.csv").read_text(encoding="utf-8").splitlines() == [
        'name,value,"value, lower","value, upper",after',
        'a,0.62,0.54,"1,071","above 500 [99, above 500] labels"',
        "b,0.3,,,",
    ]
