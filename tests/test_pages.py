"""Hold pages and docstrings to a width of line and a length of sentence that a reader of two minutes can take."""

import itertools
import re
from pathlib import Path

import pytest
from prose import LINE, SENTENCE, in_docstrings, in_markdown, long_lines, sentences

ROOT = Path(__file__).parents[1]
WRITTEN = sorted(page for page in (ROOT / "docs").rglob("*.md") if "data" not in page.relative_to(ROOT).parts)
PAGES = [ROOT / "README.md", ROOT / "CHANGELOG.md", *WRITTEN]  # reports in docs/data are written by commands
PACKAGES = [ROOT / "cuelearner_jax", ROOT / "envs" / "cuelearner_envs"]


def text_of(page: Path) -> str:
    """Return a page, of the changelog its newest section that has entries."""
    text = page.read_text(encoding="utf-8")
    if page.name != "CHANGELOG.md":
        return text
    starts = [*(match.start() for match in re.finditer(r"^## ", text, re.MULTILINE)), len(text)]
    for start, end in itertools.pairwise(starts):
        if re.search(r"^- ", text[start:end], re.MULTILINE):
            return "\n" * text[:start].count("\n") + text[start:end]
    return ""


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_lines_and_sentences_of_a_page_are_short(page: Path):
    text, name = text_of(page), page.relative_to(ROOT)
    faults = [f"{name}:{line}: {length} characters, at most {LINE}" for line, length in long_lines(text)]
    faults += [
        f"{name}:{each.line}: a sentence of {each.words} words, at most {SENTENCE}: {each.text}"
        for each in in_markdown(text)
        if each.words > SENTENCE
    ]
    assert not faults, "\n" + "\n".join(faults)


@pytest.mark.parametrize("package", PACKAGES, ids=lambda package: package.name)
def test_sentences_of_public_docstrings_are_short(package: Path):
    faults = [
        f"{file.relative_to(ROOT)}:{each.line}: a sentence of {each.words} words, at most {SENTENCE}: {each.text}"
        for file in sorted(package.rglob("*.py"))
        for each in in_docstrings(file.read_text(encoding="utf-8"))
        if each.words > SENTENCE
    ]
    assert not faults, "\n" + "\n".join(faults)


def test_sentences_end_where_a_reader_ends_them():
    text = "Run `a b. C d` (see [the page](https://x.org/a.b)). Griffith et al. (2013) say 0.5 s. *More.* Yes? `a` is."
    assert sentences(text) == [
        "Run `a b. C d` (see the page).",
        "Griffith et al. (2013) say 0.5 s.",
        "*More.*",
        "Yes?",
        "`a` is.",
    ]


def test_code_tables_and_options_are_no_prose():
    page = """# A title of a page
First sentence,
continued. Second.

| a table of words | and more |
- an item
  continued
- another ![picture](a.png)

??? note "A fold"
    Inside.

    ```sh
    no prose. At all
    ```

::: package.module
    options: { heading_level: 2 }
"""
    found = in_markdown(page)
    assert [(each.line, each.text) for each in found] == [
        (1, "A title of a page"),
        (2, "First sentence, continued."),
        (2, "Second."),
        (6, "an item continued"),
        (8, "another"),
        (10, 'note "A fold"'),
        (11, "Inside."),
    ]
    assert [each.words for each in found] == [5, 3, 1, 3, 1, 3, 1]


def test_lines_are_measured_without_addresses_code_and_tables():
    long = "x" * 121
    lines = [long, f"[a](https://{long})", f"| {long} |", f"`{long}`", "```", long, "```"]
    assert long_lines("\n".join(lines)) == [(1, 121)]


def test_docstrings_are_those_of_what_is_public():
    module = '''"""One. Two."""
class Shown:
    """Three:

    Args:
        name: Four
            goes on.
        other (int): Five.

        code = "of an example. No prose"
    """
    size: int
    """Six."""

    def _hidden(self):
        """No."""

def shown():
    """Seven."""
    def inner():
        """No."""
'''
    found = [(each.line, each.text) for each in in_docstrings(module)]
    assert [text for _, text in found] == [
        "One.",
        "Two.",
        "Three:",
        "Args:",
        "name: Four goes on.",
        "other (int): Five.",
        "Six.",
        "Seven.",
    ]
    assert found[4][0] == 6
