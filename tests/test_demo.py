"""The demo with a kill -9 in its second collection: every stroke is there exactly once, and Table 1 is complete."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from brushloop.calibrate.validate.tables import Report, table_1
from brushloop.sessions.recording import Recording
from brushloop.sessions.verify import verify_session
from tests.journal_lines import read_lines
from tests.waiting import wait_until

SMALL = """
import sys
from pathlib import Path
from brushloop.collect.chains import DemoRequest
from brushloop.collect.chains.demo import Demo, Size

size = Size((11.0, 20.0), (0.0, 8.0), again=1, writings=0, repeats=1)
Demo(DemoRequest(Path(sys.argv[1])), size).run()
"""
"""`brushloop demo` with as few presses as tell depth and tilt to the fit."""


PRESSED = 4
"""Zero touch, board, dip, press: the photograph is still to come."""


def again_steps_done(out: Path) -> int:
    journals = list(out.glob("sessions/*-replay-*/journal.jsonl"))
    return journals[0].read_bytes().count(b'"event":"done"') if journals else 0


@pytest.mark.timeout(900)
def test_killed_in_mid_collection_the_same_command_ends_with_every_stroke_exactly_once(tmp_path: Path) -> None:
    out = tmp_path / "demo"
    command = [sys.executable, "-c", SMALL, str(out)]
    # however late a busy machine draws and takes pictures
    late = os.environ | {"BRUSHLOOP_CAMERA__MAX_DELAY_MS": "10000", "BRUSHLOOP_CAMERA__MAX_JITTER_MS": "10000"}
    quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL, "env": late}
    with subprocess.Popen(command, start_new_session=True, **quiet) as first:
        try:
            wait_until(lambda: again_steps_done(out) >= PRESSED, f"{PRESSED} steps", process=first, timeout_s=500.0)
        finally:
            os.killpg(first.pid, signal.SIGKILL)

    for _ in range(4):  # on a busy machine the camera may still be late; the same command continues
        ran = subprocess.run(command, capture_output=True, text=True, check=False, env=late)
        if ran.returncode == 0:
            break
    assert ran.returncode == 0, ran.stderr

    session, again = sorted((out / "sessions").iterdir())
    for folder in (session, again):
        begun = [line for line in read_lines(folder / "journal.jsonl") if line["event"] == "begin"]
        patches = [(line["sheet"], patch) for line in begun for patch in line.get("patches", [])]
        assert len(patches) == len(set(patches)), "no patch is ever pressed twice"
        assert verify_session(folder).sound
    strokes = [capture.stroke for capture in Recording(session).captures()]
    assert len(strokes) == 4
    assert len({(s.depth_mm, s.tilt_deg) for s in strokes}) == 4
    repeated = {stroke.again_of for stroke in Recording(again).stroke_records()}
    assert len(repeated) == 1
    assert repeated < {stroke.stroke_id for stroke in strokes}

    printed = re.search(r"Report: (\S+report\.html)\nMCAP:   (\S+\.mcap)", ran.stdout)
    assert printed is not None
    page = Path(printed[1]).read_text()
    assert '<span class="source">loopback rig, brush made to agree with the paper&#39;s Table 2: no evidence' in page
    assert "not a result on paper" in page
    assert Path(printed[2]).is_file()
    assert "pix2len" in (out / "demo.log").read_text()  # what the steps print does not drown the answer
    assert "pix2len" not in ran.stdout
    report = Report.read(Path(printed[1]).with_name("report.json"))
    rows = {row.label: row.scores for row in table_1(report)}
    assert rows.pop("another press") is rows.pop("ceiling") is None  # no condition was pressed twice
    assert set(rows) == {"CCD-BSM", "CCD-BSMG", "robot writing", "CCD-BSM calibrated"}
    assert None not in rows.values()
