"""The same work on a Dask cluster of two workers: equal results, one worker lost on the way, clear refusals.

Scheduler and workers are processes of their own, as on a real cluster; so is the command.
"""

from __future__ import annotations

import json
import os
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
from tests.waiting import PATIENCE_S, wait_until

pytestmark = [
    # Looked for and not imported: every worker collects this file, and one of them runs it.
    pytest.mark.skipif(find_spec("distributed") is None, reason="needs the extra [cluster]"),
    pytest.mark.xdist_group("cluster"),
]
FILES = ("scores.csv", "summary.csv", "failures.csv")


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


def test_no_scheduler_there_is_one_clear_line(session: Path, tmp_path: Path) -> None:
    environment = os.environ | {"DASK_DISTRIBUTED__COMM__TIMEOUTS__CONNECT": "1s"}
    program = (
        "import sys, brushloop.__main__, brushloop.calibrate.work as work; work.CONNECT_S = 1.0; "
        f"sys.argv = ['brushloop', 'validate', {str(session)!r}, '--out', {str(tmp_path / 'out')!r}, "
        "'--scheduler', 'tcp://127.0.0.1:9']; brushloop.__main__.main()"
    )
    ran = subprocess.run(
        [sys.executable, "-c", program],
        capture_output=True,
        text=True,
        check=False,
        env=environment,
        timeout=PATIENCE_S,
    )
    assert ran.returncode == 2, ran.stderr
    assert ran.stderr.count("\n") == 1, ran.stderr
    assert "tcp://127.0.0.1:9: no Dask scheduler there" in ran.stderr


def test_a_worker_with_other_software_is_refused(cluster: Cluster) -> None:
    program = (
        "import brushloop.calibrate.work as work; work.VERSION = 'of tomorrow'\n"
        "from brushloop.calibrate.errors import CalibrationError\n"
        "from brushloop.calibrate.work import cluster\n"
        f"try:\n    with cluster({cluster.address!r}):\n        pass\n"
        "except CalibrationError as error:\n    print(error)\n"
    )
    ran = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=True, timeout=PATIENCE_S
    )
    assert "has brushloop" in ran.stdout
    assert "(work of tomorrow) is needed there" in ran.stdout


def test_jobs_come_back_whole_and_alike_though_a_worker_dies(cluster: Cluster, session: Path) -> None:
    program = f"""
import os, signal
from pathlib import Path
from brushloop.calibrate.compare.place import Field
from brushloop.calibrate.presses import PrepareJob, prepare_job
from brushloop.calibrate.work import cluster, threads
from brushloop.sessions.recording import Recording
captures = list(Recording(Path({str(session)!r})).captures()) * 3
jobs = [(str(k), PrepareJob(one, None, Field())) for k, one in enumerate(captures)]
def plain(results):
    return {{name: {{part: array.tolist() for part, array in arrays.items()}} for name, arrays in results}}
there = {{}}
with cluster({cluster.address!r}) as pool:
    for name, press in pool.finished(prepare_job, iter(jobs)):
        there[name] = press
        if len(there) == 5:
            os.kill({cluster.workers[0].pid}, signal.SIGKILL)
with threads(1) as pool:
    here = dict(pool.finished(prepare_job, iter(jobs)))
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
