"""Find the sentences of a page in Markdown and of a Python module's docstrings, each with its line."""

from __future__ import annotations

import ast
import inspect
import re
from collections.abc import Iterator
from typing import NamedTuple

LINE, SENTENCE = 120, 40  # characters, words

ABBREVIATIONS = ("e.g.", "i.e.", "al.", "cf.", "vs.", "etc.", "Fig.", "Eq.", "Eqs.", "Sec.", "no.", "approx.")
FENCE = re.compile(r"^\s*(?:[-*] )?(`{3,}|~{3,})")
ITEM = re.compile(r"^\s*(?:[-*+]|\d+[.)])\s+")
TITLE = re.compile(r"^\s*(?:#{1,6}\s|(?:\?\?\?\+?|!!!|===\+?)\s)")
ENTRY = re.compile(r"^\s*[*\w][\w.*, |\[\]]*(?:\s\([^)]*\))?:(?:\s|$)")  # "name: text" and "Args:" of a docstring
ROW = re.compile(r"^\s*\S+\s{2,}\S")  # "name    text" of a docstring
CODE = re.compile(r"(`+)(?!`)(.+?)(?<!`)\1(?!`)", re.DOTALL)
LINK = re.compile(r"!?\[((?:[^\[\]]|\[[^\]]*\])*)\]\([^)\s]*(?:\s\"[^\"]*\")?\)", re.DOTALL)
ADDRESS = re.compile(r"https?://[^\s)>]+")
END = re.compile(r"[.!?][\"')\]*_]*\s+(?=[\"'(\[*_]*[A-Z0-9`~])")


class Sentence(NamedTuple):
    """A sentence, the line on which its paragraph begins, and its number of words."""

    line: int
    text: str
    words: int


def sentences(text: str) -> list[str]:
    """Split a paragraph of Markdown into sentences; code is a word, a link is its text."""
    kept: list[str] = []

    def hidden(code: re.Match[str]) -> str:
        kept.append(" ".join(code[0].split()))
        return f"`~{len(kept) - 1}~`"

    text = CODE.sub(hidden, text)
    for _ in range(2):  # a picture may be the text of a link
        text = LINK.sub(lambda link: "" if link[0].startswith("!") else link[1], text)
    text = re.sub(r"<[^>]+>", " ", text)
    found, start = [], 0
    for end in END.finditer(text):
        before = text[start : end.start() + 1].split()
        if before and (before[-1].lstrip("(") in ABBREVIATIONS or re.fullmatch(r"\(?[A-Z]\.", before[-1])):
            continue
        found.append(text[start : end.end()])
        start = end.end()
    found.append(text[start:])
    shown = (re.sub(r"`~(\d+)~`", lambda code: kept[int(code[1])], " ".join(each.split())) for each in found)
    return [each for each in shown if each]


def count_words(sentence: str) -> int:
    """Count the words of a sentence; a piece of code is one."""
    return sum(any(letter.isalnum() for letter in word) for word in CODE.sub("code", sentence).split())


def _paragraphs(lines: list[str], *, docstring: bool) -> Iterator[tuple[int, str]]:
    """Yield each paragraph, list item, title and fold of Markdown with its first line, counted from 1."""
    fence, options, start, block = "", -1, 0, []
    blank, example = False, False
    for number, line in enumerate([*lines, ""], 1):
        stripped, indent = line.strip(), len(line) - len(line.lstrip())
        opened = FENCE.match(line)
        if fence:
            fence = "" if stripped.startswith(fence) and not stripped.strip(fence[0]) else fence
            continue
        if options >= 0 and (indent > options or not stripped):  # of `::: name`, which the page takes from the code
            continue
        options = indent if stripped.startswith(":::") else -1
        example = (
            docstring and indent > 0 and not ITEM.match(line) and (blank or example)
        )  # indented after a blank line
        blank = not stripped
        header = docstring and stripped.endswith(":") and not block
        entry = header or (docstring and (ROW.match(line) or (indent > 0 and ENTRY.match(line))))
        shown = example or stripped.startswith(("|", ">>>", "<!--", ":::", "$$")) or bool(opened)
        begins = bool(not stripped or shown or ITEM.match(line) or TITLE.match(line) or entry)
        if begins and block:
            yield start, "\n".join(block)
            block = []
        fence = opened[1] if opened else ""
        if stripped and not shown:
            start, block = (start if block else number), [*block, ITEM.sub("", TITLE.sub("", line)).strip()]
            if TITLE.match(line) or header:
                yield start, "\n".join(block)
                block = []


def in_markdown(text: str, *, docstring: bool = False, first_line: int = 1) -> list[Sentence]:
    """Return the sentences of Markdown, or of a docstring, outside code and tables."""
    return [
        Sentence(first_line - 1 + number, sentence, count_words(sentence))
        for number, paragraph in _paragraphs(text.splitlines(), docstring=docstring)
        for sentence in sentences(paragraph)
    ]


def long_lines(text: str) -> list[tuple[int, int]]:
    """Return number and length of the lines of prose that are too long; addresses and long code do not count."""
    found, fence = [], ""
    for number, line in enumerate(text.splitlines(), 1):
        opened = FENCE.match(line)
        if fence or opened:
            closes = fence and line.strip().startswith(fence) and not line.strip().strip(fence[0])
            fence = "" if closes else fence or (opened[1] if opened else "")
            continue
        if line.lstrip().startswith("|"):
            continue
        read = CODE.sub(lambda code: code[0] if len(code[0]) <= LINE // 2 else "", line)
        read = ADDRESS.sub("", re.sub(r"\]\([^)]*\)", "]", read))
        if len(read.rstrip()) > LINE:
            found.append((number, len(read.rstrip())))
    return found


def in_docstrings(source: str) -> Iterator[Sentence]:
    """Yield the sentences of a module's public docstrings, those of fields included."""
    yield from _in_docstrings(ast.parse(source))


def _in_docstrings(node: ast.AST) -> Iterator[Sentence]:
    body = getattr(node, "body", [])
    for place, child in enumerate(body):
        if isinstance(child, ast.Expr) and isinstance(child.value, ast.Constant) and isinstance(child.value.value, str):
            field = isinstance(node, ast.ClassDef) and place and isinstance(body[place - 1], ast.AnnAssign)
            if place == 0 or field:
                text = inspect.cleandoc(child.value.value)
                yield from in_markdown(text, docstring=True, first_line=child.lineno)
        elif isinstance(child, ast.ClassDef | ast.FunctionDef) and not isinstance(node, ast.FunctionDef):
            yield from () if child.name.startswith("_") else _in_docstrings(child)
