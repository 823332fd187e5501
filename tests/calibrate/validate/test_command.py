"""`brushloop validate` killed and run again, twice at a time, on a damaged session, and on a Dask cluster."""

from __future__ import annotations

import json
import shutil
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path

import pytest

from brushloop.calibrate import work
from brushloop.calibrate.errors import CalibrationError
from brushloop.calibrate.validate.command import open_session
from brushloop.sessions.errors import SessionDamaged
from brushloop.sessions.events import Closed, Open
from brushloop.sessions.journal import Journal
from brushloop.sessions.recording import Recording
from tests.command import brushloop
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
        open_session(folder)


needs_dask = pytest.mark.skipif(find_spec("distributed") is None, reason="needs the extra [cluster]")
"""Looked for and not imported: every worker collects this file."""


@dataclass(frozen=True)
class Cluster:
    address: str
    workers: list[subprocess.Popen[bytes]]


@contextmanager
def cluster_of_two(folder: Path) -> Iterator[Cluster]:
    scheduler_file = folder / "scheduler.json"
    started: list[subprocess.Popen[bytes]] = []

    def start(*words: str) -> subprocess.Popen[bytes]:
        quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
        started.append(subprocess.Popen([sys.executable, "-m", *words], cwd=folder, **quiet))
        return started[-1]

    try:
        here = ("--host", "127.0.0.1", "--no-dashboard")
        start("distributed.cli.dask_scheduler", "--port", "0", "--scheduler-file", str(scheduler_file), *here)
        wait_until(lambda: scheduler_file.is_file() and scheduler_file.read_text(), "the scheduler to listen")
        address = json.loads(scheduler_file.read_text())["address"]
        words = ("distributed.cli.dask_worker", address, "--nthreads", "1", "--no-nanny", *here)
        workers = [start(*words), start(*words)]
        there = f"from distributed import Client; Client({address!r}).wait_for_workers(2)"
        subprocess.run([sys.executable, "-c", there], check=True, timeout=PATIENCE_S)
        yield Cluster(address, workers)
    finally:
        for process in reversed(started):
            process.kill()
            process.wait()


@pytest.fixture(scope="module")
def cluster(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Cluster]:
    """For all tests here, in their order: the last of them kills a worker."""
    with cluster_of_two(tmp_path_factory.mktemp("cluster")) as made:
        yield made


def refused_by(address: str, setting: str) -> str:
    """Why a cluster cannot be used, from a process of its own: the client leaves a thread behind."""
    program = (
        f"import brushloop.calibrate.work as work; work.{setting}\n"
        "from brushloop.calibrate.errors import CalibrationError\n"
        f"try:\n    with work.cluster({address!r}):\n        pass\n"
        "except CalibrationError as error:\n    print(error)\n"
    )
    command = [sys.executable, "-c", program]
    return subprocess.run(command, capture_output=True, text=True, check=True, timeout=PATIENCE_S).stdout


@needs_dask
@pytest.mark.xdist_group("cluster")
def test_no_scheduler_there_is_one_clear_line() -> None:
    said = refused_by("tcp://127.0.0.1:9", "CONNECT_S = 5.0")
    assert said.count("\n") == 1
    assert "tcp://127.0.0.1:9: no Dask scheduler there" in said


@needs_dask
@pytest.mark.xdist_group("cluster")
def test_a_worker_with_other_software_is_refused(cluster: Cluster) -> None:
    said = refused_by(cluster.address, "VERSION = 'of tomorrow'")
    assert "has brushloop" in said
    assert "(work of tomorrow) is needed there" in said


@needs_dask
@pytest.mark.xdist_group("cluster")
def test_jobs_come_back_whole_and_alike_though_a_worker_dies(cluster: Cluster, session: Path, tmp_path: Path) -> None:
    program = f"""
import os, signal
from pathlib import Path
from brushloop.calibrate.presses import prepare_job
from brushloop.calibrate.work import Store, cluster, threads
from brushloop.sessions.recording import Recording
captures = list(Recording(Path({str(session)!r})).captures()) * 3
jobs = [(str(k), (one, None)) for k, one in enumerate(captures)]
def plain(results):
    return {{name: {{part: array.tolist() for part, array in arrays.items()}} for name, arrays in results}}
there = {{}}
with cluster({cluster.address!r}) as pool:
    for name, press in pool.finished(prepare_job, iter(jobs), Store(Path({str(tmp_path)!r}, "there"))):
        there[name] = press
        if len(there) == 5:
            os.kill({cluster.workers[0].pid}, signal.SIGKILL)
with threads(1) as pool:
    here = dict(pool.finished(prepare_job, iter(jobs), Store(Path({str(tmp_path)!r}, "here"))))
print(len(there), plain(there.items()) == plain(here.items()))
"""
    ran = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=False, timeout=PATIENCE_S
    )
    assert ran.stdout == "33 True\n", ran.stderr
    assert cluster.workers[0].wait(10.0) != 0


def test_without_dask_the_extra_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(CalibrationError, match=r"brushloop\[cluster\]"), work.cluster("tcp://127.0.0.1:9"):
        pass
