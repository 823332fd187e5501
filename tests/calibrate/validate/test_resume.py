"""Killed in the middle and run again: finished work is not done again, and the result is that of an unbroken run."""

from __future__ import annotations

import shutil
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from brushloop.calibrate.validate.store import Store
from tests.command import brushloop
from tests.waiting import wait_until

FILES = ("report.json", "report.html", "scores.csv", "summary.csv", "failures.csv", "scores.parquet")


COMMAND = ("validate", "presses", "--out", "out", "--workers", "1", "--model", "ccd-bsm", "--model", "bezier-refitted")
"""One model as it is, and one that is fitted again for each cell."""


def records(work: Path) -> list[str]:
    """Keys in the order in which they were finished."""
    with Store(work) as store:
        return store.keys()


def test_after_kill_9_the_same_command_gives_the_same_bytes_and_repeats_nothing(session: Path, tmp_path: Path) -> None:
    for name in ("whole", "killed"):
        shutil.copytree(session, tmp_path / name / "presses")
    ran = brushloop(*COMMAND, cwd=tmp_path / "whole")
    assert ran.returncode == 0, ran.stderr

    work = tmp_path / "killed" / "out" / "work" / "work.sqlite"
    first = subprocess.Popen(
        [sys.executable, "-m", "brushloop", *COMMAND],
        cwd=tmp_path / "killed",
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    wait_until(lambda: work.is_file() and work.stat().st_size > 20_000, "the first results", process=first)
    first.send_signal(signal.SIGKILL)
    first.wait()
    assert not (work.parent.parent / "report.json").exists()
    before = records(work)
    assert before

    ran = brushloop(*COMMAND, cwd=tmp_path / "killed")
    assert ran.returncode == 0, ran.stderr
    for name in FILES:
        whole, resumed = (tmp_path / which / "out" / name for which in ("whole", "killed"))
        assert whole.read_bytes() == resumed.read_bytes(), name
    # What was finished stands where it stood: nothing was done twice.
    after = records(work)
    assert after[: len(before)] == before
    assert sorted(after) == sorted(records(tmp_path / "whole" / "out" / "work" / "work.sqlite"))


def test_a_second_run_does_no_work_again(session: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from typer.testing import CliRunner

    from brushloop.__main__ import app
    from brushloop.calibrate.validate import heldout, jobs, run

    arguments = ["validate", str(session), "--out", str(tmp_path)]
    assert CliRunner().invoke(app, arguments).exit_code == 0
    first = (tmp_path / "scores.csv").read_bytes()

    def never(_job: object) -> None:
        raise AssertionError("finished work was done again")

    for module, name in ((jobs, "prepare_job"), (heldout, "refit_job"), (run, "score_job")):
        monkeypatch.setattr(module, name, never)
    ran = CliRunner().invoke(app, arguments)
    assert ran.exit_code == 0, ran.exception
    assert (tmp_path / "scores.csv").read_bytes() == first


def test_two_at_a_time_in_one_folder_are_refused(session: Path, tmp_path: Path) -> None:
    from filelock import FileLock
    from typer.testing import CliRunner

    from brushloop.__main__ import app

    (tmp_path / "work").mkdir()
    with FileLock(tmp_path / "work" / "lock"):
        ran = CliRunner().invoke(app, ["validate", str(session), "--out", str(tmp_path)])
    assert "another validation is writing there" in str(ran.exception)
