"""`brushloop validate` killed and run again, twice at a time, and on a damaged session."""

from __future__ import annotations

import shutil
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from filelock import FileLock
from typer.testing import CliRunner

from brushloop.__main__ import app
from brushloop.calibrate import presses
from brushloop.calibrate.fit import heldout
from brushloop.calibrate.validate import run
from brushloop.calibrate.validate.command import open_session
from brushloop.sessions.errors import SessionDamaged
from brushloop.sessions.events import Closed, Open
from brushloop.sessions.journal import Journal
from brushloop.sessions.recording import Recording
from tests.command import brushloop
from tests.waiting import wait_until

FILES = ("report.json", "report.html", "scores.csv", "summary.csv", "failures.csv", "scores.parquet")
COMMAND = ("validate", "presses", "--out", "out", "--workers", "1", "--model", "ccd-bsm", "--model", "bezier-refitted")


def finished(place: Path) -> dict[str, int]:
    """Name and time of every entry of the store."""
    return {path.name: path.stat().st_mtime_ns for path in (place / "presses" / "work").glob("*.npz.gz")}


def test_after_kill_9_the_same_command_gives_the_same_bytes_and_repeats_nothing(session: Path, tmp_path: Path) -> None:
    whole, killed = tmp_path / "whole", tmp_path / "killed"
    for place in (whole, killed):
        shutil.copytree(session, place / "presses", ignore=shutil.ignore_patterns("work"))
    ran = brushloop(*COMMAND, cwd=whole)
    assert ran.returncode == 0, ran.stderr

    quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
    first = subprocess.Popen([sys.executable, "-m", "brushloop", *COMMAND], cwd=killed, **quiet)
    wait_until(lambda: len(finished(killed)) > 2, "the first results", process=first)
    first.send_signal(signal.SIGKILL)
    first.wait()
    assert not (killed / "out" / "report.json").exists()
    before = finished(killed)

    ran = brushloop(*COMMAND, cwd=killed)
    assert ran.returncode == 0, ran.stderr
    for name in FILES:
        assert (whole / "out" / name).read_bytes() == (killed / "out" / name).read_bytes(), name
    after = finished(killed)
    assert before.items() <= after.items()
    assert after.keys() == finished(whole).keys()


def test_a_second_run_does_no_work_again(session: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    arguments = ["validate", str(session), "--out", str(tmp_path)]
    assert CliRunner().invoke(app, arguments).exit_code == 0
    first = (tmp_path / "scores.csv").read_bytes()

    def never(_job: object) -> None:
        raise AssertionError("finished work was done again")

    for module, name in ((presses, "prepare_job"), (heldout, "refit"), (run, "score_job")):
        monkeypatch.setattr(module, name, never)
    ran = CliRunner().invoke(app, arguments)
    assert ran.exit_code == 0, ran.exception
    assert (tmp_path / "scores.csv").read_bytes() == first


def test_two_at_a_time_in_one_folder_are_refused(session: Path, tmp_path: Path) -> None:
    with FileLock(tmp_path / ".lock"):
        ran = CliRunner().invoke(app, ["validate", str(session), "--out", str(tmp_path)])
    assert "another validation is writing there" in str(ran.exception)


def test_a_recording_that_is_not_the_one_its_journal_closed_is_damaged(session: Path, tmp_path: Path) -> None:
    folder = tmp_path / "presses"
    folder.mkdir()
    (folder / "presses.mcap").write_bytes((session / "presses.mcap").read_bytes())
    header = Recording(session).header.model_copy(update={"session_id": "presses"})
    closed = Closed(t_ns=1, file="presses.mcap", sha256="0" * 64, counts={})
    journal = Journal(folder / "journal.jsonl", "presses")
    for event in (Open(t_ns=1, header=header), closed):
        journal.append(event)
    journal.close()
    with pytest.raises(SessionDamaged, match="SHA-256 differs"):
        open_session(str(folder))
