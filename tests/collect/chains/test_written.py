"""`brushloop write` on the loopback rig: a cross of two strokes, planned, written twice, captured, compared."""

from __future__ import annotations

import json
import subprocess
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest

from brushloop.calibrate.writing.compare import ANOTHER, PLANNED, REFERENCE, SIMULATED, Table3Row, read_written
from brushloop.sessions.recording import Recording

if TYPE_CHECKING:
    from tests.collect.chains.conftest import Bench

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
    ran = write(bench, what, "--count", "2")
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
    again = write(bench, what, "--count", "2")
    assert again.returncode == 0, again.stderr
    assert "brushloop collect" not in again.stdout
    other = write(bench, what, "--count", "3")
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
