"""`brushloop repress` and `brushloop write` on the loopback rig, each from its beginning to its report."""

from __future__ import annotations

import csv
from collections.abc import Iterator
from pathlib import Path

import pytest

from brushloop.calibrate.loop import LoopRecord
from brushloop.calibrate.writing.compare import ANOTHER, PLANNED, REFERENCE, SIMULATED, WrittenRecord
from brushloop.drivers.loopback import LoopbackRig, simulate
from brushloop.sessions.recording import Recording
from tests.command import brushloop


@pytest.fixture
def rig(tmp_path: Path) -> Iterator[LoopbackRig]:
    """`brushloop sim`, seed 1, its camera as sharp and as slow as it comes."""
    with simulate(tmp_path) as rig:
        yield rig


def printed(*words: str | Path, code: int = 0) -> str:
    """What the command prints, or why it is refused before anything moves (code 2)."""
    ran = brushloop(*words)
    assert ran.returncode == code, ran.stderr
    return ran.stderr if code else ran.stdout


GRID = 'kind = "grid"\ndepths_mm = [11.0, 15.0, 20.0]\ntilts_deg = [0.0, 8.0]\nrepeats = 1\n'
"""Six presses: as few as tell depth and tilt to the fit."""


@pytest.mark.soak
@pytest.mark.timeout(600)
def test_the_loop_is_closed(rig: LoopbackRig, tmp_path: Path) -> None:
    protocol, sessions = tmp_path / "protocol.toml", tmp_path / "sessions"
    protocol.write_text(GRID, encoding="utf-8")
    printed("collect", "--config", rig.config, "--protocol", protocol, "--out", sessions, "--no-tui")
    [session] = sessions.iterdir()
    rig.fresh_sheet()
    repress = ("repress", session, "--config", rig.config, "--no-tui", "--sheet", "1")
    printed(*repress)
    [replay] = [folder for folder in sessions.iterdir() if "replay" in folder.name]
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
    assert "brushloop collect" not in printed(*repress), "nothing is pressed again"


CROSS = "stroke,x_mm,y_mm,width_mm\n1,12,24,5\n1,36,24,5\n2,24,37,5\n2,24,11,5\n"


@pytest.mark.soak
@pytest.mark.timeout(600)
def test_a_character_is_written_twice_and_compared(rig: LoopbackRig, tmp_path: Path) -> None:
    what, out, sessions = tmp_path / "cross.csv", tmp_path / "written", tmp_path / "sessions"
    what.write_text(CROSS, encoding="utf-8")
    write = ("write", what, "--config", rig.config, "--out", out, "--sessions", sessions)
    write = (*write, "--no-tui", "--cell-mm", "48", "--repeats")
    printed(*write, "2")
    [session] = sessions.iterdir()
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
    assert "brushloop collect" not in printed(*write, "2")
    assert "repeats: plans 2 writings, not 3: use another --out" in printed(*write, "3", code=2)

    # A session is compared with the plan that it was drawn from, and with no other.
    plan = tmp_path / "plan"
    printed("write", "plan", "--out", plan, "--steps", "1", "--cell-mm", "48", what)
    assert "'cross' was not drawn from this plan" in printed("write", "compare", session, "--plan", plan, code=2)
