"""Every block of the documents is run, read by what reads such files, or says above it why it is not."""

from __future__ import annotations

import os
import re
import shutil
import signal
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from pathlib import Path

import pytest

from brushloop.collect.protocols.config import load_protocol
from brushloop.drivers.sim.brush.spec import load_brush
from tests.blocks import DOCUMENTS, ROOT, Block, blocks_of

TUTORIAL = ROOT / "docs" / "tutorial.md"
ALL = [block for document in DOCUMENTS for block in blocks_of(document)]
NOT_RUN = re.compile(r"needs (?:an arm|a person|a network)|takes many minutes|tested by (tests/\S+\.py)")
COMMAND = re.compile(r"^(\$ )?(brushloop|make|python3?|pip) [a-z-]", re.M)
STOPPED = 4
"""Exit code of a run that the same command continues."""
PAGES = [
    page for page in DOCUMENTS if page != TUTORIAL and any(b.kind == "sh" and not b.remark for b in blocks_of(page))
]


@pytest.mark.parametrize("block", ALL, ids=str)
def test_a_block_is_run_or_says_why_not(block: Block) -> None:
    assert block.kind in {"sh", "python", "toml", "js", "ini", "text"}, "a block says what it is"
    if block.kind == "text":
        assert not COMMAND.search(block.text), "commands are sh"
    elif block.remark:
        said = NOT_RUN.fullmatch(block.remark)
        assert said, f"not a reason: {block.remark}"
        assert said[1] is None or (ROOT / said[1]).is_file()
    else:
        assert block.kind in {"sh", "python", "toml"}, "nothing runs it: name the test that does"


def test_every_fence_is_one_of_these_blocks() -> None:
    fences = sum(len(re.findall(r"^\s*```", page.read_text(encoding="utf-8"), re.M)) for page in DOCUMENTS)
    assert fences == 2 * len(ALL)


@pytest.mark.parametrize("block", [b for b in ALL if b.kind == "toml"], ids=str)
def test_a_block_of_toml_is_what_its_reader_accepts(block: Block, tmp_path: Path) -> None:
    shutil.copytree(ROOT / "examples", tmp_path, dirs_exist_ok=True)
    path = tmp_path / "block.toml"
    path.write_text(block.text, encoding="utf-8")
    match tomllib.loads(block.text):
        case {"kind": _}:
            load_protocol(path)
        case {"brush": _}:
            load_brush(path)


class Reader:
    """A person who types what a page shows, in one folder; the rig of `brushloop sim` runs in another terminal."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        path = f"{Path(sys.executable).parent}:{os.environ['PATH']}"
        self.environment = os.environ | {"PATH": path, "PYTHONPATH": str(ROOT)}
        self.rig: subprocess.Popen[str] | None = None

    def follow(self, page: Path) -> None:
        """Run every command of the page that a test can run."""
        for block in blocks_of(page):
            if block.kind != "sh" or block.remark:
                continue
            for line in block.commands:
                if line.startswith("brushloop sim"):
                    self.serve(line)
                    continue
                ran = self.type(line)
                for _ in range(3):
                    if ran.returncode != STOPPED:
                        break
                    ran = self.type(line)  # on a busy machine the camera may be late; the same command continues
                assert ran.returncode == 0, f"{block}: {line}\n{ran.stdout[-3000:]}{ran.stderr[-3000:]}"

    def type(self, line: str) -> subprocess.CompletedProcess[str]:
        """Run one command in a shell; without a terminal, collect shows a progress bar instead of the screen."""
        where = {"cwd": self.folder, "env": self.environment}
        return subprocess.run(["bash", "-c", line], **where, capture_output=True, text=True, check=False)

    def serve(self, line: str) -> None:
        """Start a rig in place of the one before, and wait until it says where it listens."""
        self.leave()
        self.rig = subprocess.Popen(
            line.split(), cwd=self.folder, env=self.environment, stdout=subprocess.PIPE, text=True
        )
        assert self.rig.stdout is not None
        assert self.rig.stdout.readline(), line

    def leave(self) -> None:
        """Press Ctrl-C in the rig's terminal."""
        if self.rig is None:
            return
        self.rig.send_signal(signal.SIGINT)
        self.rig.communicate(timeout=60)
        self.rig = None


def new_lab(folder: Path) -> Reader:
    """A clone as a reader has it, with a protocol."""
    shutil.copytree(ROOT / "examples", folder / "examples")
    (folder / ".venv").symlink_to(sys.prefix)
    shutil.copy(ROOT / "examples" / "protocol-quick.toml", folder / "protocol.toml")
    return Reader(folder)


@pytest.fixture(scope="module")
def lab(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Reader]:
    """A reader who has done the tutorial; its recording and its rig are there for the other pages."""
    reader = new_lab(tmp_path_factory.mktemp("lab"))
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
    reader = new_lab(tmp_path) if collects else request.getfixturevalue("lab")
    try:
        if reader.rig is None or "--write-rig" not in reader.rig.args:
            reader.serve("brushloop sim --write-rig rig.toml --rate 20")
        reader.follow(page)
    finally:
        if collects:
            reader.leave()


@pytest.mark.soak
@pytest.mark.parametrize("block", [b for b in ALL if b.kind == "python" and not b.remark], ids=str)
def test_what_a_program_prints_stands_on_its_page(block: Block) -> None:
    ran = subprocess.run([sys.executable, "-c", block.text], cwd=ROOT, capture_output=True, text=True, check=True)
    assert ran.stdout
    page = block.document.read_text(encoding="utf-8")
    assert [line for line in ran.stdout.splitlines() if line not in page] == []
