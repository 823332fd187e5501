"""The command line: light, one line per error, right exit codes, and no traceback whatever the output does."""

from __future__ import annotations

import os
import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest

from bench import pages
from brushloop.__main__ import EXIT_CODES
from tests.command import brushloop
from tests.sessions.conftest import Make

ROOT = Path(__file__).parent.parent
PROCESS = [sys.executable, "-m", "brushloop"]
HEAVY = ("torch", "cv2", "textual", "numpy", "pydantic", "mcap", "scipy", "brushloop.drivers.sim")
"""Packages that `--help` does without."""
COMMANDS = (
    "collect --config no.toml --protocol no.toml --no-tui",
    "collect plan --config no.toml --protocol no.toml",
    "doctor --config no.toml",
    "calibrate nowhere",
    "fit nowhere",
    "validate nowhere",
    "validate diff nowhere nowhere",
    "recover nowhere",
    "repress nowhere --config no.toml",
    "repress compare nowhere nowhere",
    "write 字 --config no.toml",
    "sim --write-rig no/rig.toml",
    "sessions verify nowhere",
    "sessions export nowhere out",
    "sessions import nowhere --csv no.csv",
)
SLOW = ("torch", "scipy", "numba", "matplotlib", "skimage", "textual", "jinja2", "can", "rich.progress")
"""Packages that take from a tenth of a second to seconds to import, which no command needs to begin."""


def test_help_loads_nothing_heavy_and_a_command_begins_to_work_before_anything_slow_is_imported(tmp_path: Path) -> None:
    program = f"""
import json, os, sys
from brushloop.__main__ import main
os.chdir({str(tmp_path)!r})
found, before = {{}}, set()
for command in {("--help", *COMMANDS)!r}:
    sys.argv = ["brushloop", *command.split()]
    try:
        main()
    except SystemExit as end:
        assert end.code == (0 if command == "--help" else 2), (command, end.code)
    imported = set(sys.modules) - before
    slow = sorted(imported & set({HEAVY!r} if command == "--help" else {SLOW!r}))
    if slow:
        found[command] = slow
    before |= imported
sys.stderr.write(json.dumps(found))
"""
    ran = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert ran.stderr.splitlines()[-1] == "{}"


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("validate", "nowhere"), "nowhere: no such session"),
        (("collect", "--config", "no.toml", "--protocol", "no.toml", "--no-tui"), "no.toml: no such file"),
        (("sessions", "import", "nowhere", "--csv", "no.csv"), "nowhere: is not a folder"),
        (("sim", "--write-rig", "no/rig.toml"), "brushloop: no/rig.toml: there is no folder no\n"),
        (("sim", "--rate", "nan"), "brushloop: --rate is 'nan', allowed: a number from 0.01 to 1000\n"),
        (("sim", "--idle-exit=-1"), "brushloop: --idle-exit is '-1', allowed: a number from 0\n"),
        (("sim", "--unknown", "3", "--trap", "loud"), "brushloop: --trap is 'loud', allowed: swapped-corner, "),
        (("sim", "--unknown", "3", "--write-rig", "rig.toml"), "--unknown: can only be combined with --trap"),
        (("sim", "--trap", "force-sign"), "brushloop: --trap: needs --unknown SEED\n"),
    ],
)
def test_bad_input_is_one_line_and_exit_code_2(tmp_path: Path, arguments: tuple[str, ...], words: str) -> None:
    ran = brushloop(*arguments, cwd=tmp_path)
    assert (ran.returncode, ran.stderr.count("\n")) == (2, 1)
    assert words in ran.stderr
    assert list(tmp_path.iterdir()) == []


def test_a_group_of_commands_says_how_it_is_typed_and_what_else_there_is() -> None:
    assert brushloop("collect", "--bogus").stderr.startswith("Usage: brushloop collect [plan] [OPTIONS]\n")


def test_the_page_about_exit_codes_is_that_of_the_code() -> None:
    assert pages.PAGE.read_text(encoding="utf-8") == pages.exit_codes(), "run `python -m bench.pages`"
    packages = ("calibrate", "collect", "drivers", "model", "sessions", "twin")
    source = "".join(path.read_text(encoding="utf-8") for name in packages for path in (ROOT / name).rglob("*.py"))
    raised = {int(code) for code in re.findall(r"^    exit_code(?:: ClassVar\[int\])? = (\d+)$", source, re.M)}
    assert {2, 4, 5, 6} <= raised <= EXIT_CODES.keys()


# Outputs


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a closed session that was written with a brush of Chinese name."""
    make, folder = Make(), tmp_path_factory.mktemp("output")
    make.session(folder / "s", closed=True, session_id="s", brush="羊毫 é")
    return folder


@pytest.mark.parametrize(("encoding", "shown"), [("ascii", "\\u7f8a\\u6beb \\xe9"), ("latin-1", "\\u7f8a\\u6beb é")])
def test_what_a_terminal_cannot_show_is_escaped(folder: Path, encoding: str, shown: str) -> None:
    ran = brushloop("sessions", "show", "s", cwd=folder, encoding=encoding)
    assert (ran.returncode, ran.stderr) == (0, "")
    assert shown in ran.stdout


def test_a_reader_that_has_ended_ends_the_command_quietly(folder: Path) -> None:
    read_end, write_end = os.pipe()
    os.close(read_end)
    ran = subprocess.run(
        [*PROCESS, "sessions", "show", "s"], cwd=folder, stdout=write_end, stderr=subprocess.PIPE, check=False
    )
    os.close(write_end)
    assert (ran.returncode, ran.stderr) == (4, b"")


NO_ROOM = 4, b"brushloop: the output: No space left on device\n"


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no device that is always full")
@pytest.mark.parametrize(
    ("words", "ended"),
    [("sessions show s >/dev/full", NO_ROOM), ("--help >/dev/full", NO_ROOM), ("sessions show s >&-", (0, b""))],
)
def test_an_output_without_room_is_one_line_and_a_closed_one_nobodys_loss(
    folder: Path, words: str, ended: tuple[int, bytes]
) -> None:
    command = f"exec {shlex.join(PROCESS)} {words}"
    ran = subprocess.run(["/bin/sh", "-c", command], cwd=folder, stderr=subprocess.PIPE, check=False)
    assert (ran.returncode, ran.stderr) == ended


@pytest.mark.parametrize("words", ["sessions verify {}", "validate {}", "sessions import {} --csv {}", "calibrate {}"])
def test_a_name_that_is_no_text_is_refused_in_one_line(tmp_path: Path, words: str) -> None:
    name = os.fsdecode(b"caf\xe9")
    ran = brushloop(*words.format(name, name).split(), cwd=tmp_path)
    assert ran.returncode == 2
    assert ran.stderr == "brushloop: caf\\udce9: is not UTF-8; give the file or folder another name\n"


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
