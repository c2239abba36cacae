"""Hooks of the site: turn links out of the site into names, check every link, and build the tables of the viewer page.

A link `tables.md?file=PATH.csv` shows a CSV file of docs/ on the viewer page. The browser cannot read a CSV file of a
page that was opened from the disk, so each linked table is also written as a script, `tables/PATH.csv.js`.
"""

from __future__ import annotations

import json
import logging
import posixpath
import re
import shutil
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
LINK = re.compile(r"(?<!!)\[([^\]]*)\]\((?!https?:|#)([^)#\s]+)(#[^)\s]*)?\)")
VIEWER = "docs/tables.md"
log = logging.getLogger("mkdocs.hooks.docs")
linked: dict[str, Any] = {}  # CSV file, as seen from docs/ -> the first page that links to it


def on_pre_build(config: Any) -> None:
    """Forget the tables of an earlier build."""
    linked.clear()


def on_page_markdown(markdown: str, page: Any, config: Any, files: Any) -> str:
    """Return the page with links that the site can follow; note the tables that it shows."""
    folder = posixpath.dirname(page.file.src_uri)

    def replaced(link: re.Match[str]) -> str:
        path, _, query = link[2].partition("?")
        text, target = link[1], posixpath.normpath(posixpath.join("docs", folder, path))
        if target == VIEWER and query.startswith("file="):
            note_table(query.removeprefix("file="), page)
        file = files.get_file_from_path(posixpath.relpath(target, "docs"))
        if file and not file.inclusion.is_excluded():
            return link[0]
        if not (ROOT / target).exists():
            log.warning("%s links to %s, which is not there", page.file.src_uri, target)
        return f"{text} (`{target}`)" if text.strip("`") not in (target, posixpath.basename(target)) else f"`{target}`"

    return LINK.sub(replaced, markdown)


def note_table(file: str, page: Any) -> None:
    """Remember a table to build; warn where docs/ has no such CSV file."""
    inside = (ROOT / "docs" / file).resolve().is_relative_to(ROOT / "docs")
    if not (inside and file.endswith(".csv") and (ROOT / "docs" / file).is_file()):
        log.warning("%s shows the table %s, which is no CSV file of docs/", page.file.src_uri, file)
        return
    linked.setdefault(file, page)


def on_post_build(config: Any) -> None:
    """Write every linked table as a script and as a CSV file, and the list of tables."""
    site = Path(config["site_dir"])
    for file in linked:
        source, script = ROOT / "docs" / file, site / "tables" / f"{file}.js"
        script.parent.mkdir(parents=True, exist_ok=True)
        script.write_text(f"showTable({json.dumps(source.read_text(encoding='utf-8'))});\n", encoding="utf-8")
        (site / file).parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(source, site / file)
    known = {file: {"title": page.title, "url": page.url} for file, page in sorted(linked.items())}
    (site / "tables").mkdir(parents=True, exist_ok=True)
    (site / "tables" / "list.js").write_text(f"const knownTables = {json.dumps(known, indent=1)};\n", encoding="utf-8")
