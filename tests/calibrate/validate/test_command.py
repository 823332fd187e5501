"""`brushloop validate` killed and run again, twice at a time, on a damaged session, and on a Dask cluster."""

from __future__ import annotations

import shutil
import signal
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path

import pytest
from filelock import FileLock

from brushloop.calibrate import work
from brushloop.calibrate.errors import CalibrationError
from brushloop.calibrate.validate.command import open_session
from brushloop.sessions.errors import SessionDamaged
from tests.calibrate.given import CALIBRATION, photographed
from tests.command import brushloop, refused
from tests.waiting import PATIENCE_S, wait_until

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
    assert ran.returncode == 3, ran.stderr  # one photograph is blank

    quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
    first = subprocess.Popen([sys.executable, "-m", "brushloop", *COMMAND], cwd=killed, **quiet)
    wait_until(lambda: len(finished(killed)) > 2, "the first results", process=first)
    first.send_signal(signal.SIGKILL)
    first.wait()
    assert not (killed / "out" / "report.json").exists()
    before = finished(killed)

    ran = brushloop(*COMMAND, cwd=killed)
    assert ran.returncode == 3, ran.stderr
    for name in FILES:
        assert (whole / "out" / name).read_bytes() == (killed / "out" / name).read_bytes(), name
    after = finished(killed)
    assert before.items() <= after.items()
    assert after.keys() == finished(whole).keys()


def test_two_at_a_time_in_one_folder_are_refused(session: Path, tmp_path: Path) -> None:
    with FileLock(tmp_path / ".lock"):
        assert "another validation is writing in this folder" in refused("validate", session, "--out", tmp_path)


def test_a_recording_that_is_not_the_one_its_journal_closed_is_damaged(session: Path, tmp_path: Path) -> None:
    closed = photographed(tmp_path / "presses", CALIBRATION.board, [])
    shutil.copy(session / "presses.mcap", closed)
    with pytest.raises(SessionDamaged, match="SHA-256 differs"):
        open_session(closed)


CLUSTER = """
import os, signal, sys
from pathlib import Path
import dask
from distributed import LocalCluster
from brushloop.calibrate import work
from brushloop.calibrate.errors import CalibrationError
from brushloop.calibrate.presses import prepare_job
from brushloop.sessions.recording import Recording

def refused(address):
    try:
        with work.cluster(address):
            pass
    except CalibrationError as error:
        return str(error)

def done(pool, folder, by=None):
    results = {}
    for name, arrays in pool.finished(prepare_job, iter(jobs), work.Store(Path(folder))):
        results[name] = {part: array.tolist() for part, array in arrays.items()}
        if len(results) == 5 and by is not None:
            os.kill(by, signal.SIGKILL)
    return results

session, here, there = sys.argv[1:]
dask.config.set({"distributed.worker.multiprocessing-method": "forkserver"})
jobs = [(str(k), (one, None)) for k, one in enumerate(list(Recording(Path(session)).captures()) * 2)]
with LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=None) as cluster:
    address, worker = cluster.scheduler_address, cluster.workers[0].pid
    with work.cluster(address) as pool, work.threads(1) as alone:
        results = done(pool, there, by=worker)
        print(len(results), results == done(alone, here))
    work.VERSION, work.CONNECT_S = "of tomorrow", 2.0
    print(refused(address))
    print(refused("tcp://127.0.0.1:9"))
"""


@pytest.mark.skipif(find_spec("distributed") is None, reason="needs the extra [cluster]")
def test_a_cluster_does_the_same_though_a_worker_dies_and_what_cannot_be_used_is_one_line(
    session: Path, tmp_path: Path
) -> None:
    command = [sys.executable, "-c", CLUSTER, session, tmp_path / "here", tmp_path / "there"]
    ran = subprocess.run(command, capture_output=True, text=True, check=False, timeout=PATIENCE_S)
    jobs, other_software, nobody = ran.stdout.splitlines()
    assert jobs == "22 True", ran.stderr
    assert "has brushloop" in other_software
    assert "(work of tomorrow) is needed there" in other_software
    assert "tcp://127.0.0.1:9: no Dask scheduler answers" in nobody


def test_without_dask_the_extra_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(CalibrationError, match=r"brushloop\[cluster\]"), work.cluster("tcp://127.0.0.1:9"):
        pass
