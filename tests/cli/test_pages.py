"""First pages of help: short, with examples that can be typed as they stand."""

import shlex
from pathlib import Path

import pytest

from cuelearner_jax.cli import dispatch, main, pages, parsing
from cuelearner_jax.storage import label_files

ROOT = Path(__file__).parents[2]
NAMES = [name for command in dispatch.COMMANDS for name in dispatch.summaries(command)]
NAMED = {  # what is named after a command
    "train": ("billiards", "examples.reach:TASK"),
    "sweep": ("billiards", "navigation"),
    "adapt": ("docs/data/navigation_agent", "arm"),
    "evaluate": ("docs/data/navigation_agent", "billiards"),
    "render": ("billiards",),
    "label": ("navigation",),
    "export": ("docs/data/navigation_agent",),
}
SHORT = [("labels inspect", ""), ("report", ""), ("sweep", "billiards")]  # of one kind each
PAGES = [
    *((name, "") for name in NAMES),
    *((name, subject) for name, subjects in NAMED.items() for subject in subjects),
]
PAGES = [page if page in SHORT else pytest.param(*page, marks=pytest.mark.long) for page in PAGES]


class Parsed(BaseException):
    """The command line was understood: nothing is done."""


@pytest.fixture
def parses(monkeypatch):
    """Whether a command line is understood, without what it would do."""
    real = parsing.tyro.cli

    def stop(*arguments, **options):
        real(*arguments, **options)
        raise Parsed

    def run(command):
        with monkeypatch.context() as patched:
            patched.setattr(parsing.tyro, "cli", stop)
            try:
                status = main(shlex.split(command)[1:])
            except Parsed:
                return True
        return status == 0

    monkeypatch.chdir(ROOT)
    return run


def page_of(command, capsys):
    with pytest.raises(SystemExit) as stopped:
        main([*command, "--help"])
    assert not stopped.value.code
    return capsys.readouterr().out


def examples_in(page):
    """Command lines of a page, those that go on put together."""
    text = page.replace(" \\\n", "")
    return [line.strip() for line in text.splitlines() if line.startswith("  cuelearner ")]


@pytest.mark.parametrize(("name", "subject"), PAGES)
def test_a_first_page_is_short_and_has_three_examples_that_parse(name, subject, capsys, parses):
    page = page_of([*name.split(), *([subject] if subject else [])], capsys)
    lines = page.splitlines()
    assert len(lines) <= pages.LINES
    assert max(map(len, lines)) <= pages.COLUMNS
    assert "--help-all" in " ".join(lines[-3:])
    for option in pages.PAGES[name].options:  # one that was renamed must not drop out unseen
        assert f"--{option}" in page
    examples = examples_in(page)
    assert len(examples) == 3
    assert all(example.startswith(f"cuelearner {name}") for example in examples)
    assert all(subject in example for example in examples)
    for example in examples:
        missing = [word for word in shlex.split(example) if word.startswith(("labels/", "runs/"))]
        if missing and name == "adapt":  # labels that a page is to leave there first
            continue
        assert parses(example), example


@pytest.mark.parametrize("command", [[], ["labels"]])
def test_the_overview_is_short(command, capsys):
    try:
        assert main([*command, "--help"]) == 0
    except SystemExit as stopped:
        assert not stopped.code
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) <= pages.LINES
    assert max(map(len, lines)) <= pages.COLUMNS
    assert sum(line.startswith("  cuelearner ") for line in lines) == 3


def test_files_in_examples_are_there():
    assert label_files.found_in(ROOT / "docs/data/labelling/navigation") is not None
    for page in pages.PAGES.values():
        for example in page.examples:
            for word in shlex.split(example.command):
                assert not word.startswith("docs/") or (ROOT / word).exists(), word
