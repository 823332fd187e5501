"""`brushloop repress` and `brushloop write` on the loopback rig, each from its beginning to its report."""

from __future__ import annotations

import csv
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest

from brushloop.calibrate.loop import LoopRecord
from brushloop.calibrate.writing.compare import ANOTHER, PLANNED, REFERENCE, SIMULATED, WrittenRecord
from brushloop.drivers.loopback import LoopbackRig, simulate
from brushloop.sessions.recording import Recording


@dataclass
class Bench:
    """A rig that serves, and a folder for everything."""

    folder: Path
    rig: LoopbackRig

    def run(self, *words: str | Path) -> subprocess.CompletedProcess[str]:
        command = [sys.executable, "-m", "brushloop", *map(str, words)]
        return subprocess.run(command, capture_output=True, text=True, check=False)

    def refused(self, *words: str | Path) -> str:
        """Why the command is refused before anything moves."""
        ran = self.run(*words)
        assert ran.returncode == 2, ran.stderr
        return ran.stderr

    def done(self, *words: str | Path) -> str:
        """What the command prints."""
        ran = self.run(*words)
        assert ran.returncode == 0, ran.stderr
        return ran.stdout

    @property
    def sessions(self) -> Path:
        return self.folder / "sessions"


@pytest.fixture
def bench(tmp_path: Path) -> Iterator[Bench]:
    """`brushloop sim`, seed 1, its camera as sharp and as slow as it comes."""
    with simulate(tmp_path) as rig:
        yield Bench(tmp_path, rig)


GRID = 'kind = "grid"\ndepths_mm = [11.0, 15.0, 20.0]\ntilts_deg = [0.0, 8.0]\nrepeats = 1\n'
"""Six presses: as few as tell depth and tilt to the fit."""


@pytest.mark.soak
@pytest.mark.timeout(600)
def test_the_loop_is_closed(bench: Bench) -> None:
    protocol, config = bench.folder / "protocol.toml", bench.rig.config
    protocol.write_text(GRID, encoding="utf-8")
    bench.done("collect", "--config", config, "--protocol", protocol, "--out", bench.sessions, "--no-tui")
    [session] = bench.sessions.iterdir()
    bench.rig.fresh_sheet()
    repress = ("repress", session, "--config", config, "--no-tui", "--sheet", "1")
    bench.done(*repress)
    [replay] = [folder for folder in bench.sessions.iterdir() if "replay" in folder.name]
    originals = sorted(stroke.stroke_id for stroke in Recording(session).stroke_records())
    assert sorted(str(stroke.again_of) for stroke in Recording(replay).stroke_records()) == originals

    record = LoopRecord.read(session / "loop")
    assert (record.source, record.pairs, record.refused) == ("loopback rig", 6, ())
    # No patch was pressed twice: the brush's repeatability is not known, and nothing is claimed.
    assert record.lost == []
    assert {row.model for row in record.stats} == {"re-pressed", "recovered, simulated"}
    with (session / "loop" / "loop.csv").open(encoding="utf-8") as file:
        single = [row for row in csv.DictReader(file) if row["model"] == "re-pressed" and row["tone"] == "binary"]
    assert len(single) == 12
    assert all(float(row["csim"]) > 0.88 for row in single)
    page = (session / "loop" / "loop.html").read_text(encoding="utf-8")
    assert '<span class="source">loopback rig</span>' in page
    assert "brushloop collect" not in bench.done(*repress), "nothing is pressed again"


CROSS = "stroke,x_mm,y_mm,width_mm\n1,12,24,5\n1,36,24,5\n2,24,37,5\n2,24,11,5\n"


@pytest.mark.soak
@pytest.mark.timeout(600)
def test_a_character_is_written_twice_and_compared(bench: Bench) -> None:
    what, out = bench.folder / "cross.csv", bench.folder / "written"
    what.write_text(CROSS, encoding="utf-8")
    write = ("write", what, "--config", bench.rig.config, "--out", out, "--sessions", bench.sessions)
    write = (*write, "--no-tui", "--cell-mm", "48", "--repeats")
    bench.done(*write, "2")
    [session] = bench.sessions.iterdir()
    assert [stroke.stroke_id for stroke in Recording(session).stroke_records()] == ["cross-r01", "cross-r02"]

    record = WrittenRecord.read(out)
    assert record.source == "loopback rig"
    binary = [row for row in record.table_3 if (row.tone, row.polarity) == ("binary", "ink = 1")]
    rows = {(row.pair, row.alignment): row for row in binary}
    assert rows[REFERENCE, "mm"].csim.n == 2
    assert rows[REFERENCE, "mm"].reference == "cross.csv"
    assert rows[PLANNED, "mm"].csim.avg > 95.0
    # The brush writes nearly the same twice; that it does not write what the uncalibrated model thinks is a finding.
    assert rows[ANOTHER, "mm"].csim.avg > 93.0
    assert 55.0 < rows[SIMULATED, "size-normalised"].csim.avg < 99.9
    page = (out / "written.html").read_text(encoding="utf-8")
    assert '<span class="source">loopback rig</span>' in page
    assert (out / "figure-13.png").stat().st_size > 10_000

    # Done is done, and what was planned stays: another count is another plan.
    assert "brushloop collect" not in bench.done(*write, "2")
    assert "repeats: plans 2 writings, not 3: use another --out" in bench.refused(*write, "3")

    # A session is compared with the plan that it was drawn from, and with no other.
    plan = bench.folder / "plan"
    bench.done("write", "plan", "--out", plan, "--steps", "1", "--cell-mm", "48", what)
    assert "'cross' was not drawn from this plan" in bench.refused("write", "compare", session, "--plan", plan)
