"""What the documents name is there, their commands exist and run, and the site is built without a warning."""

from __future__ import annotations

import os
import re
import shlex
import shutil
import signal
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import typer

import brushloop.__main__
from bench import pictures
from brushloop.calibrate.commands import PathOrCommand
from brushloop.collect.protocols.config import load_protocol
from brushloop.drivers.sim.brush.brush_file import load_brush
from tests.blocks import DOCUMENTS, ROOT, Block, blocks_of

TUTORIAL = ROOT / "docs" / "tutorial.md"
BLOCKS = [block for document in DOCUMENTS for block in blocks_of(document)]
NOT_RUN = re.compile(r"needs (?:an arm|a person|a network)|takes many minutes|tested by (tests/\S+\.py)")
COMMAND = re.compile(r"^(\$ )?(brushloop|make|python3?|pip) [a-z-]", re.M)
LINK = re.compile(r"\]\(([^)#:\s]+)(?:#[^)]*)?\)")
OURS = re.compile(r"`((?:collect|calibrate|drivers|sessions|model|twin|bench|tests|examples)/[\w/.-]*)`")
STOPPED = 4
"""Exit code of a run that the same command continues."""
PAGES = [
    page for page in DOCUMENTS if page != TUTORIAL and any(b.kind == "sh" and not b.remark for b in blocks_of(page))
]
every_document = pytest.mark.parametrize("document", DOCUMENTS, ids=lambda path: str(path.relative_to(ROOT)))


@every_document
def test_files_and_tests_that_a_document_names_are_there(document: Path) -> None:
    text = document.read_text()
    assert [link for link in LINK.findall(text) if not (document.parent / link).exists()] == []
    assert [name for name in OURS.findall(text) if not (ROOT / name).exists()] == []
    if named := re.findall(r"`(test_[a-z0-9_]+)`", text):
        tests = "\n".join(path.read_text() for path in (ROOT / "tests").rglob("test_*.py"))
        assert [name for name in named if f"def {name}(" not in tests] == []


@every_document
def test_commands_that_a_document_shows_exist_with_their_options(document: Path) -> None:
    """`make soak` runs them as well, below."""
    shown = [line for block in blocks_of(document) if block.kind == "sh" for line in block.commands]
    for line in (line for line in shown if re.match(r"brushloop( |$)", line)):
        command: Any = typer.main.get_command(brushloop.__main__.app)
        words = shlex.split(line.split(" | ")[0])[1:]
        while words:
            word = words.pop(0)
            further = getattr(command, "commands", {})
            if isinstance(command, PathOrCommand) and word not in further:
                command, further = next(iter(further.values())), {}
            if word.startswith("--"):
                options = {name: option for option in command.params for name in (*option.opts, *option.secondary_opts)}
                assert word in options or word == "--help", line
                if word in options and options[word].type_descriptor.annotation is not bool:
                    words = words[options[word].nargs :]
            elif set(word.split("|")) <= further.keys():
                command = further[word.split("|")[0]]
            else:
                assert not further, line


@pytest.mark.parametrize("block", BLOCKS, ids=str)
def test_a_block_is_run_or_read_or_says_why_not(block: Block, tmp_path: Path) -> None:
    assert block.kind in {"sh", "python", "toml", "js", "ini", "text"}, "a block says what it is"
    if block.kind == "text":
        assert not COMMAND.search(block.text), "commands are sh"
    elif block.remark:
        reason = NOT_RUN.fullmatch(block.remark)
        assert reason, f"not a reason: {block.remark}"
        assert reason[1] is None or (ROOT / reason[1]).is_file()
    else:
        assert block.kind in {"sh", "python", "toml"}, "nothing runs it: name the test that does"
    if block.kind == "toml":
        shutil.copytree(ROOT / "examples", tmp_path, dirs_exist_ok=True)
        path = tmp_path / "block.toml"
        path.write_text(block.text, encoding="utf-8")
        match tomllib.loads(block.text):
            case {"kind": _}:
                load_protocol(path)
            case {"brush": _}:
                load_brush(path)


def test_the_moving_picture_is_made_of_the_pictures_of_the_screens() -> None:
    picture = pictures.session_picture()
    assert pictures.MOVING.read_text(encoding="utf-8") == picture, "run `python -m bench.pictures screens`"


def test_the_site_is_built_without_a_warning(tmp_path: Path) -> None:
    pytest.importorskip("mkdocs")
    # Not --quiet: with it mkdocs counts no warnings, and being strict means nothing.
    command = [sys.executable, "-m", "mkdocs", "build", "--site-dir", str(tmp_path / "site")]
    ran = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert ran.returncode == 0, ran.stderr
    page = (tmp_path / "site" / "reference" / "commands.html").read_text(encoding="utf-8")
    assert "brushloop sessions export" in page
    pages = "".join(path.read_text(encoding="utf-8") for path in (tmp_path / "site").rglob("*.html"))
    fetched = re.findall(r"<(?:script|link|img)[^>]*(?:src|href)=\"(?:https?:)?//[^>]*>", pages)
    assert fetched == [], "nothing is fetched"


class Reader:
    """A person who types what a page shows, in one folder; the rig of `brushloop sim` runs in another terminal."""

    def __init__(self, folder: Path) -> None:
        """Lay out a clone as a reader has it, with a protocol."""
        self.folder = folder
        path = f"{Path(sys.executable).parent}:{os.environ['PATH']}"
        self.environment = os.environ | {"PATH": path, "PYTHONPATH": str(ROOT)}
        self.rig: subprocess.Popen[str] | None = None
        shutil.copytree(ROOT / "examples", folder / "examples")
        (folder / ".venv").symlink_to(sys.prefix)
        shutil.copy(ROOT / "examples" / "protocol-quick.toml", folder / "protocol.toml")

    def follow(self, page: Path) -> None:
        """Run every command of the page that a test can run."""
        for block in blocks_of(page):
            if block.kind != "sh" or block.remark:
                continue
            for line in block.commands:
                if line.startswith("brushloop sim --"):
                    self.serve(line)
                    continue
                for _ in range(4):  # on a busy machine the camera may be late; the same command continues
                    ran = self.type(line)
                    if ran.returncode != STOPPED:
                        break
                assert ran.returncode == 0, f"{block}: {line}\n{ran.stdout[-3000:]}{ran.stderr[-3000:]}"

    def type(self, line: str) -> subprocess.CompletedProcess[str]:
        """Run one command in a shell; without a terminal, collect shows a progress bar instead of the screen."""
        where = {"cwd": self.folder, "env": self.environment}
        return subprocess.run(["bash", "-c", line], **where, capture_output=True, text=True, check=False)

    def serve(self, line: str) -> None:
        """Start a rig in place of the one before, and wait until it says where it listens."""
        self.leave()
        where = {"cwd": self.folder, "env": self.environment}
        self.rig = subprocess.Popen(line.split(), **where, stdout=subprocess.PIPE, text=True)
        assert self.rig.stdout is not None
        assert self.rig.stdout.readline(), line

    def leave(self) -> None:
        """Press Ctrl-C in the rig's terminal."""
        if self.rig is not None:
            self.rig.send_signal(signal.SIGINT)
            self.rig.communicate(timeout=60)
            self.rig = None


@pytest.fixture(scope="module")
def lab(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Reader]:
    """A reader who has done the tutorial; its recording and its rig are there for the other pages."""
    reader = Reader(tmp_path_factory.mktemp("lab"))
    try:
        reader.follow(TUTORIAL)
        yield reader
    finally:
        reader.leave()


@pytest.mark.soak  # minutes: each page collects or calibrates
@pytest.mark.timeout(3000)
def test_every_command_of_the_tutorial_does_what_it_says(lab: Reader) -> None:
    [session] = (lab.folder / "sessions").glob("*-grid-01")
    assert (session / "validation" / "report.html").is_file()
    assert (lab.folder / "plan.png").is_file()
    assert len(list((lab.folder / "exported" / "images").iterdir())) >= 12


@pytest.mark.soak
@pytest.mark.timeout(3000)
@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_every_command_of_a_page_runs(request: pytest.FixtureRequest, tmp_path: Path, page: Path) -> None:
    shown = [line for block in blocks_of(page) if block.kind == "sh" and not block.remark for line in block.commands]
    collects = any(line.startswith("brushloop collect --") for line in shown)
    # Beside earlier sessions, a new one would ask for a fresh sheet.
    reader = Reader(tmp_path) if collects else request.getfixturevalue("lab")
    try:
        if reader.rig is None or "--write-rig" not in reader.rig.args:
            reader.serve("brushloop sim --write-rig rig.toml --rate 20")
        reader.follow(page)
    finally:
        if collects:
            reader.leave()
