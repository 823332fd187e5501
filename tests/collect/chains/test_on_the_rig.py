"""`brushloop repress`, also after kill -9, and `brushloop write` on the loopback rig."""

from __future__ import annotations

import csv
import json
import os
import signal
import subprocess
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from brushloop.calibrate.loop import read_loop
from brushloop.calibrate.writing.compare import ANOTHER, PLANNED, REFERENCE, SIMULATED, Table3Row, read_written
from brushloop.drivers.loopback import LoopbackRig, simulate
from brushloop.sessions.journal import JOURNAL_NAME
from brushloop.sessions.recording import Recording
from tests.waiting import wait_until


def brushloop(*words: str | Path) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "brushloop", *map(str, words)]
    return subprocess.run(command, capture_output=True, text=True, check=False)


@dataclass
class Bench:
    """A rig that serves, and a folder for everything."""

    folder: Path
    simulated: LoopbackRig

    def run(self, *words: str | Path) -> subprocess.CompletedProcess[str]:
        return brushloop(*words)

    @property
    def rig(self) -> Path:
        return self.simulated.config

    @property
    def sessions(self) -> Path:
        return self.folder / "sessions"

    def fresh_sheet(self) -> None:
        self.simulated.fresh_sheet()

    def collect(self, protocol: str) -> Path:
        """One session of a protocol; returns its folder."""
        path = self.folder / "protocol.toml"
        path.write_text(protocol, encoding="utf-8")
        before = set(self.sessions.iterdir()) if self.sessions.is_dir() else set[Path]()
        ran = brushloop("collect", "--config", self.rig, "--protocol", path, "--out", self.sessions, "--no-tui")
        assert ran.returncode == 0, ran.stderr
        [session] = set(self.sessions.iterdir()) - before
        return session


@pytest.fixture
def bench(tmp_path: Path) -> Iterator[Bench]:
    """`brushloop sim`, seed 1, its camera as sharp and as slow as it comes."""
    with simulate(tmp_path) as rig:
        yield Bench(tmp_path, rig)


GRID = 'kind = "grid"\ndepths_mm = [11.0, 15.0, 20.0]\ntilts_deg = [0.0, 8.0]\nrepeats = 1\n'
"""Six presses: as few as tell depth and tilt to the fit."""


def words(bench: Bench, session: Path, *more: str) -> list[str]:
    return ["repress", str(session), "--config", str(bench.rig), "--no-tui", *more]


def replay_journal(bench: Bench) -> bytes:
    found = list(bench.sessions.glob(f"*replay*/{JOURNAL_NAME}"))
    return found[0].read_bytes() if found else b""


@pytest.mark.soak
@pytest.mark.timeout(600)
def test_the_loop_is_closed_and_goes_on_after_kill_nine(bench: Bench) -> None:
    session = bench.collect(GRID)
    refused = bench.run(*words(bench, session))
    assert refused.returncode == 2
    assert "would press on whatever sheet is in" in refused.stderr
    assert not (session / "brushfit").exists()  # asked before anything is computed

    bench.fresh_sheet()
    again = words(bench, session, "--sheet", "1")
    first = subprocess.Popen(
        [sys.executable, "-m", "brushloop", *again],
        start_new_session=True,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    wait_until(lambda: replay_journal(bench).count(b'"event":"done"') >= 6, "six steps", process=first)
    os.killpg(first.pid, signal.SIGKILL)
    first.wait()
    protocol = session / "loop" / "protocol-replay.toml"
    recovered_at = protocol.stat().st_mtime_ns

    ran = bench.run(*again)
    assert ran.returncode == 0, ran.stderr
    assert protocol.stat().st_mtime_ns == recovered_at
    [replay] = [folder for folder in bench.sessions.iterdir() if "replay" in folder.name]
    originals = sorted(stroke.stroke_id for stroke in Recording(session).stroke_records())
    repeated = [stroke.again_of for stroke in Recording(replay).stroke_records()]
    assert sorted(map(str, repeated)) == originals

    report: dict[str, Any] = json.loads((session / "loop" / "loop.json").read_text(encoding="utf-8"))
    assert report["source"] == "loopback rig"
    assert report["pairs"] == 6
    assert report["refused"] == []
    assert report["in_sample"]
    rows = read_loop(session / "loop").stats
    assert {row.model for row in rows} == {"re-pressed", "recovered, simulated"}
    assert all(row.csim.n == 6 for row in rows)
    # No patch was pressed twice: the brush's repeatability is not known, and nothing is claimed.
    assert report["verdicts"] == []
    with (session / "loop" / "loop.csv").open(encoding="utf-8") as file:
        single = [row for row in csv.DictReader(file) if row["model"] == "re-pressed" and row["tone"] == "binary"]
    assert len(single) == 12
    assert all(float(row["csim"]) > 0.88 for row in single)
    page = (session / "loop" / "loop.html").read_text(encoding="utf-8")
    assert '<span class="source">loopback rig</span>' in page
    assert 'src="http' not in page

    # Done is done: nothing is pressed again, and another loop does not go on in this one's folder.
    ran = bench.run(*again)
    assert ran.returncode == 0, ran.stderr
    assert "brushloop collect" not in ran.stdout
    other = bench.run(*again, "--repeats", "2")
    assert other.returncode == 2
    assert "repeats: this loop was begun with 1, not 2: use another --out" in other.stderr

    # Another brush makes other marks: said before anything moves.
    name = Recording(session).header.brush
    bench.rig.write_text(bench.rig.read_text(encoding="utf-8").replace(name, "goat hair"), encoding="utf-8")
    strange = bench.run(*again)
    assert strange.returncode == 2
    assert f"brush.name: 'goat hair': the original was pressed with {name!r}" in strange.stderr


CROSS = "stroke,x_mm,y_mm,width_mm\n1,12,24,5\n1,36,24,5\n2,24,37,5\n2,24,11,5\n"


def write(bench: Bench, what: Path, *more: str) -> subprocess.CompletedProcess[str]:
    words = ["write", what, "--config", bench.rig, "--out", bench.folder / "written", "--sessions", bench.sessions]
    return bench.run(*words, "--no-tui", "--cell-mm", "48", *more)


def strict(rows: Sequence[Table3Row], pair: str, alignment: str = "mm") -> Table3Row:
    [row] = [r for r in rows if (r.pair, r.alignment, r.tone, r.polarity) == (pair, alignment, "binary", "ink = 1")]
    return row


@pytest.mark.soak
@pytest.mark.timeout(600)
def test_a_character_is_written_twice_and_compared(bench: Bench) -> None:
    what = bench.folder / "cross.csv"
    what.write_text(CROSS, encoding="utf-8")
    ran = write(bench, what, "--repeats", "2")
    assert ran.returncode == 0, ran.stderr
    [session] = bench.sessions.iterdir()
    assert [stroke.stroke_id for stroke in Recording(session).stroke_records()] == ["cross-r01", "cross-r02"]

    record = read_written(bench.folder / "written")
    assert record.source == "loopback rig"
    rows = record.table_3
    assert strict(rows, REFERENCE).csim.n == 2
    assert strict(rows, REFERENCE).reference == "cross.csv"
    assert strict(rows, PLANNED).csim.avg > 95.0
    # The brush writes nearly the same twice; that it does not write what the uncalibrated model thinks is a finding.
    assert strict(rows, ANOTHER).csim.avg > 93.0
    assert 55.0 < strict(rows, SIMULATED, "size-normalised").csim.avg < 99.9
    page = (bench.folder / "written" / "written.html").read_text(encoding="utf-8")
    assert '<span class="source">loopback rig</span>' in page
    assert "cross.csv" in page
    assert 'src="http' not in page
    assert (bench.folder / "written" / "figure-13.png").stat().st_size > 10_000

    # Done is done, and what was planned stays: another count is another plan.
    again = write(bench, what, "--repeats", "2")
    assert again.returncode == 0, again.stderr
    assert "brushloop collect" not in again.stdout
    other = write(bench, what, "--repeats", "3")
    assert other.returncode == 2
    assert "repeats: plans 2 writings, not 3: use another --out" in other.stderr
    report: dict[str, Any] = json.loads((bench.folder / "written" / "written.json").read_text(encoding="utf-8"))
    assert report["refused"] == []

    # A session is compared with the plan that it was drawn from, and with no other.
    plan = bench.folder / "plan"
    bench.run("write", "plan", "--out", str(plan), "--steps", "1", "--cell-mm", "48", str(what))
    strange = bench.run("write", "compare", str(session), "--plan", str(plan))
    assert strange.returncode == 2
    assert "'cross' was not drawn from this plan" in strange.stderr
