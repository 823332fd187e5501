"""An output that takes no more, a narrow character set, a full disk or an odd name never ends in a traceback."""

from __future__ import annotations

import os
import shlex
import subprocess
import sys
from pathlib import Path

import pytest

from tests.command import brushloop
from tests.sessions.conftest import Make

PROCESS = [sys.executable, "-m", "brushloop"]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a closed session that was written with a brush of Chinese name."""
    make, folder = Make(), tmp_path_factory.mktemp("output")
    make.session(folder / "s", closed=True, session_id="s", brush="羊毫 é")
    return folder


@pytest.mark.parametrize(("encoding", "shown"), [("ascii", "\\u7f8a\\u6beb \\xe9"), ("latin-1", "\\u7f8a\\u6beb é")])
def test_what_a_terminal_cannot_show_is_escaped(folder: Path, encoding: str, shown: str) -> None:
    environment = os.environ | {"PYTHONIOENCODING": encoding}
    ran = subprocess.run(
        [*PROCESS, "sessions", "show", "s"], cwd=folder, env=environment, capture_output=True, check=False
    )
    assert (ran.returncode, ran.stderr) == (0, b"")
    assert shown in ran.stdout.decode(encoding)


@pytest.mark.parametrize("words", [("sessions", "show", "s"), ("sessions", "show", "s", "--json")])
def test_a_reader_that_has_ended_ends_the_command_quietly(folder: Path, words: tuple[str, ...]) -> None:
    read_end, write_end = os.pipe()
    os.close(read_end)
    ran = subprocess.run([*PROCESS, *words], cwd=folder, stdout=write_end, stderr=subprocess.PIPE, check=False)
    os.close(write_end)
    assert (ran.returncode, ran.stderr) == (4, b"")


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no device that is always full")
@pytest.mark.parametrize("words", [("sessions", "show", "s"), ("sessions", "show", "s", "--json"), ("--help",)])
def test_an_output_without_room_is_one_line(folder: Path, words: tuple[str, ...]) -> None:
    with Path("/dev/full").open("wb") as full:
        ran = subprocess.run([*PROCESS, *words], cwd=folder, stdout=full, stderr=subprocess.PIPE, check=False)
    assert (ran.returncode, ran.stderr) == (4, b"brushloop: the output: No space left on device\n")


def test_a_closed_output_is_nobodys_loss(folder: Path) -> None:
    command = "exec " + shlex.join([*PROCESS, "sessions", "show", "s"]) + " >&-"
    ran = subprocess.run(["/bin/sh", "-c", command], cwd=folder, stderr=subprocess.PIPE, check=False)
    assert (ran.returncode, ran.stderr) == (0, b"")


@pytest.mark.parametrize("words", ["sessions verify {}", "validate {}", "sessions import {} --csv {}", "calibrate {}"])
def test_a_name_that_is_no_text_is_refused_in_one_line(tmp_path: Path, words: str) -> None:
    name = os.fsdecode(b"caf\xe9")
    ran = brushloop(*words.format(name, name).split(), cwd=tmp_path)
    assert ran.returncode == 2
    assert ran.stderr == "brushloop: caf\\udce9: is not UTF-8; give the file or folder another name\n"


def test_nothing_is_done_in_a_folder_whose_name_is_no_text(tmp_path: Path) -> None:
    here = tmp_path / os.fsdecode(b"caf\xe9")
    here.mkdir()
    ran = brushloop("sessions", "list", ".", cwd=here)
    assert ran.returncode == 2
    assert ran.stderr == f"brushloop: {tmp_path}/caf\\udce9: is not UTF-8; give the file or folder another name\n"


def test_names_that_are_no_text_may_lie_beside_a_session(folder: Path) -> None:
    odd = folder / os.fsdecode(b"caf\xe9")
    odd.mkdir()
    (odd / "journal.jsonl").write_bytes(b"{}\n")
    (folder / "s" / os.fsdecode(b"caf\xe9.mcap")).write_bytes(b"")
    ran = brushloop("sessions", "list", ".", cwd=folder)
    assert (ran.returncode, "caf\\udce9" in ran.stdout) == (0, True)
    for words in ("sessions verify s", "sessions show s", "sessions repair s"):
        assert brushloop(*words.split(), cwd=folder).returncode == 0


def test_too_little_memory_is_one_line(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def exhausted(*_: object) -> None:
        raise MemoryError

    monkeypatch.setattr("brushloop.sessions.show.details", exhausted)
    ran = brushloop("sessions", "show", "s", cwd=folder)
    assert (ran.returncode, ran.stderr) == (4, "brushloop: not enough memory\n")
