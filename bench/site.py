"""Hooks of mkdocs for `make docs`: reference pages from the code and pages from outside docs/."""

from __future__ import annotations

import posixpath
import re
from pathlib import Path
from typing import Any

from mkdocs.structure.files import File, Files

from bench import reference

ROOT = Path(__file__).resolve().parent.parent
OUTSIDE = {"CHANGELOG.md": "changelog.md", "CONTRIBUTING.md": "contributing.md", "SECURITY.md": "security.md"}
"""Pages of the repository's root, and their names on the site."""
LINK = re.compile(r"\[([^\]]*)\]\((?!\w+:|#)([^)#\s]*)(#[^)\s]*)?\)")


def on_files(files: Files, config: Any) -> Files:
    """Add the pages that are made here."""
    made = {
        "reference/commands.md": reference.commands(),
        "reference/rig.md": reference.rig(),
        "reference/protocol.md": reference.protocol(),
        **{name: (ROOT / origin).read_text(encoding="utf-8") for origin, name in OUTSIDE.items()},
    }
    for name, content in made.items():
        files.append(File.generated(config, name, content=content))
    return files


def on_page_markdown(markdown: str, *, page: Any, files: Files, **_: Any) -> str:
    """Point links to where pages lie on the site; what is only in the repository becomes its name."""
    source = page.file.src_uri
    origin = next((outside for outside, name in OUTSIDE.items() if name == source), f"docs/{source}")

    def moved(found: re.Match[str]) -> str:
        text, target, anchor = found[1], found[2], found[3] or ""
        path = posixpath.normpath(posixpath.join(posixpath.dirname(origin), target))
        if not (ROOT / path).exists():
            return found[0]  # mkdocs reports it
        name = OUTSIDE.get(path, path.removeprefix("docs/") if path.startswith("docs/") else "")
        if files.get_file_from_path(name) is None:
            return f"{text} (`{path}` in the repository)"
        return f"[{text}]({posixpath.relpath(name, posixpath.dirname(source) or '.')}{anchor})"

    return LINK.sub(moved, markdown)
