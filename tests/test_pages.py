"""Hold pages and docstrings to a width of line and a length of sentence that a reader of two minutes can take."""

import ast
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
LINE, SENTENCE = 120, 40  # characters, words
WRITTEN = sorted(page for page in (ROOT / "docs").rglob("*.md") if "data" not in page.relative_to(ROOT).parts)
PAGES = [ROOT / "README.md", ROOT / "CHANGELOG.md", *WRITTEN]  # reports in docs/data are written by commands
PACKAGES = [ROOT / "cuelearner_jax", ROOT / "envs" / "cuelearner_envs"]

FENCED = re.compile(r"^( *(?:- )?)(```|~~~).*?^ *\2", re.MULTILINE | re.DOTALL)
APART = re.compile(r"^ *(\||>>>|<!--|:::|\$\$).*$", re.MULTILINE)  # a table, an example, a directive, an equation
# or "name: text" of a docstring
ITEM = re.compile(r"^\s*([-*+]|\d+\.|#+|\?\?\?\+?|!!!|===|[\w*,. ]+(\(\w+\))?:)(\s|$)")
CODE, LINK = re.compile(r"`[^`]+`"), re.compile(r"!?\[([^\[\]]*)\]\([^()\s]*(?:\s\"[^\"]*\")?\)")
END = re.compile(r"(?<!e\.g)(?<!i\.e)(?<! al)(?<! cf)[.!?][\"')*_]*\s+(?=[\"'(\[*_]*[A-Z0-9`])")


def long_sentences(text):
    """Yield the sentences of Markdown, or of a docstring, with too many words; code is a word, a link is its text."""
    text = APART.sub("", FENCED.sub("", text))
    blocks = [[]]
    for line in text.splitlines():
        if not line.strip() or ITEM.match(line) or re.match(r"\s*\S+\s{2,}\S", line):
            blocks.append([])
        blocks[-1].append(line)
    for block in blocks:
        prose = CODE.sub("Code", " ".join(block))
        for _ in range(2):  # a picture may be the text of a link
            prose = LINK.sub(r"\1", prose)
        for sentence in END.split(prose):
            if sum(any(map(str.isalnum, word)) for word in sentence.split()) > SENTENCE:
                yield " ".join(sentence.split())


def long_lines(text):
    """Yield the lines of prose that are too long; addresses, code and tables do not count."""
    for line in APART.sub("", FENCED.sub("", text)).splitlines():
        read = re.sub(r"\]\([^)]*\)|https?://\S+", "", CODE.sub("", line))
        if len(read.rstrip()) > LINE:
            yield line


def public_docstrings(node):
    """Yield the docstrings of a module's public classes and functions, and of itself, without indented examples."""
    yield re.sub(r"\n\n(?: +.*(?:\n|$))+", "\n\n", ast.get_docstring(node) or "")
    for child in node.body:
        if isinstance(child, ast.ClassDef | ast.FunctionDef) and not child.name.startswith("_"):
            yield from public_docstrings(child)


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_lines_and_sentences_of_a_page_are_short(page):
    text = page.read_text(encoding="utf-8")
    if page.name == "CHANGELOG.md":  # its newest section that has entries
        text = next(part for part in text.split("\n## ") if "\n- " in part)
    assert [*long_lines(text), *long_sentences(text)] == []


@pytest.mark.parametrize("package", PACKAGES, ids=lambda package: package.name)
def test_sentences_of_public_docstrings_are_short(package):
    found = {
        file.name: [*long_sentences("\n\n".join(public_docstrings(ast.parse(file.read_text(encoding="utf-8")))))]
        for file in sorted(package.rglob("*.py"))
    }
    assert {name: sentences for name, sentences in found.items() if sentences} == {}
