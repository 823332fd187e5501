"""What the documents name is there, the commands that they show exist, and the site is built without a warning."""

from __future__ import annotations

import re
import shlex
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
import typer

import brushloop.__main__
from bench import pictures
from brushloop.calibrate.path_or_command import PathOrCommand
from tests.blocks import DOCUMENTS, ROOT, blocks_of

LINK = re.compile(r"\]\(([^)#:\s]+)(?:#[^)]*)?\)")


@pytest.fixture(scope="module")
def tests() -> str:
    return "\n".join(path.read_text() for path in sorted((ROOT / "tests").rglob("test_*.py")))


@pytest.mark.parametrize("document", DOCUMENTS, ids=lambda path: str(path.relative_to(ROOT)))
def test_files_that_a_document_links_to_are_there(document: Path) -> None:
    links = LINK.findall(document.read_text())
    assert [link for link in links if not (document.parent / link).exists()] == []


@pytest.mark.parametrize("document", DOCUMENTS, ids=lambda path: str(path.relative_to(ROOT)))
def test_tests_that_a_document_names_are_there(document: Path, tests: str) -> None:
    named = re.findall(r"`(test_[a-z0-9_]+)`", document.read_text())
    assert [name for name in named if f"def {name}(" not in tests] == []


@pytest.mark.parametrize("document", DOCUMENTS, ids=lambda path: str(path.relative_to(ROOT)))
def test_files_and_folders_of_ours_that_a_document_names_are_there(document: Path) -> None:
    named = re.findall(
        r"`((?:collect|calibrate|drivers|sessions|model|bench|tests|examples)/[\w/.-]*)`", document.read_text()
    )
    assert [name for name in named if not (ROOT / name).exists()] == []


def commands_in(document: Path) -> list[str]:
    """Lines of a document's blocks that begin with `brushloop`, without their comments."""
    shown = [block for block in blocks_of(document) if block.kind == "sh"]
    return [line for block in shown for line in block.commands if re.match(r"brushloop( |$)", line)]


@pytest.mark.parametrize("document", DOCUMENTS, ids=lambda path: str(path.relative_to(ROOT)))
def test_commands_that_a_document_shows_exist_with_their_options(document: Path) -> None:
    """`make soak` runs them as well, in tests/test_blocks.py."""
    for line in commands_in(document):
        command: Any = typer.main.get_command(brushloop.__main__.app)
        words = shlex.split(line.split(" | ")[0])[1:]
        while words:
            word = words.pop(0)
            further = getattr(command, "commands", {})
            if word.startswith("--"):
                options = {name: one for one in command.params for name in (*one.opts, *one.secondary_opts)}
                assert word in options or word == "--help", line
                if word in options and options[word].type_descriptor.annotation is not bool:
                    words = words[options[word].nargs :]
            elif set(word.split("|")) <= further.keys():
                command = further[word.split("|")[0]]
            elif isinstance(command, PathOrCommand):
                command = next(iter(further.values()))
            else:
                assert not further, line


def test_the_moving_picture_is_made_of_the_pictures_of_the_screens() -> None:
    made = pictures.session_picture()
    assert pictures.MOVING.read_text(encoding="utf-8") == made, "run `python -m bench.pictures screens`"
    assert made.count('<g class="frame"') == len(pictures.SCREENS)


def test_the_site_is_built_without_a_warning(tmp_path: Path) -> None:
    pytest.importorskip("mkdocs")
    # Not --quiet: with it mkdocs counts no warnings, and being strict means nothing.
    command = [sys.executable, "-m", "mkdocs", "build", "--site-dir", str(tmp_path / "site")]
    ran = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert ran.returncode == 0, ran.stderr
    page = (tmp_path / "site" / "reference" / "commands.html").read_text(encoding="utf-8")
    assert "brushloop sessions export" in page
    pages = "".join(path.read_text(encoding="utf-8") for path in (tmp_path / "site").rglob("*.html"))
    assert re.findall(r"<(?:script|link|img)[^>]*(?:src|href)=\"(?:https?:)?//[^>]*>", pages) == [], (
        "nothing is fetched"
    )
