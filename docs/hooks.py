"""For the site: links to files outside of it become their names; links to files that are not there are warned of."""

from __future__ import annotations

import logging
import posixpath
import re
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
LINK = re.compile(r"(?<!!)\[([^\]]*)\]\((?!https?:|#)([^)#\s]+)(#[^)\s]*)?\)")
log = logging.getLogger("mkdocs.hooks.docs")


def on_page_markdown(markdown: str, page: Any, config: Any, files: Any) -> str:
    """A page with links that the site can follow."""
    folder = posixpath.dirname(page.file.src_uri)

    def replaced(link: re.Match[str]) -> str:
        text, target = link[1], posixpath.normpath(posixpath.join("docs", folder, link[2]))
        if files.get_file_from_path(posixpath.relpath(target, "docs")):
            return link[0]
        if not (ROOT / target).exists():
            log.warning("%s links to %s, which is not there", page.file.src_uri, target)
        return f"{text} (`{target}`)" if text.strip("`") not in (target, posixpath.basename(target)) else f"`{target}`"

    return LINK.sub(replaced, markdown)
