"""The demo with a kill -9 in its second collection: every stroke is there exactly once, and Table 1 is complete.

Here its rig is small and needs neither wires nor time; `make soak` runs the demo as it is.
"""

from __future__ import annotations

import contextlib
import os
import re
import signal
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from unittest.mock import AsyncMock

import pytest

from brushloop.calibrate.artefact import FITS, current
from brushloop.calibrate.fit.command import BrushFit
from brushloop.calibrate.fit.heldout import FITTED
from brushloop.calibrate.validate.tables import Report, table_1
from brushloop.collect.chains import DemoRequest, demo
from brushloop.collect.tui.so_far import fit_so_far
from brushloop.drivers.sim import rig
from brushloop.drivers.sim.config import SimConfig
from brushloop.sessions.recording import Recording
from brushloop.sessions.store import SessionStore
from brushloop.sessions.verify import verify_session
from tests.blocks import ROOT
from tests.command import brushloop
from tests.journal_lines import read_lines
from tests.rigs import SHARP_VIEW, SMALL_TABLE, wireless_lab

SIZE = demo.Size((11.0, 20.0), (0.0, 8.0), again=1, writings=0, repeats=1)
"""As few presses as tell depth and tilt to the fit."""
PRESSED = 4
"""Steps of the second collection until its press: zero touch, board, dip, press. The photograph is still to come."""


def asked_for(config: Path, options: tuple[str, ...]) -> SimConfig:
    """The rig that `brushloop sim` serves with these options."""
    served: list[SimConfig] = []
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(rig.LoopbackRig, "__init__", lambda _, config: served.append(config))
        patch.setattr(rig, "serve", AsyncMock())
        ran = brushloop("sim", "--write-rig", config, *options)
    assert ran.returncode == 0, ran.stderr
    return served[0]


def run_demo(out: Path) -> None:
    """Run the demo with the rig in this process."""
    with contextlib.ExitStack() as stack:

        def start(config: Path, _log: Path, *options: str, detached: bool) -> SimpleNamespace:
            assert detached, "Ctrl-C is for the collection"
            small = replace(asked_for(config, options), view=SHARP_VIEW, table=SMALL_TABLE)
            lab = stack.enter_context(wireless_lab(out, small))
            config.write_text(lab.rig.toml(), encoding="utf-8")
            return SimpleNamespace(config=config, fresh_sheet=lab.rig.world.fresh_sheet, end=stack.close)

        stack.enter_context(pytest.MonkeyPatch.context()).setattr(demo, "start", start)
        demo.Demo(DemoRequest(out), SIZE).run()


def run_demo_and_die(out: Path) -> None:
    """The same, until this process kills itself in the second collection."""
    finish: Callable[..., None] = SessionStore.done

    def done(store: SessionStore, *step: object) -> None:
        finish(store, *step)
        if "-list-" in store.folder.name and len(store.state.files) == PRESSED:
            os.kill(os.getpid(), signal.SIGKILL)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(SessionStore, "done", done)
        run_demo(out)


def test_killed_in_mid_collection_the_same_command_ends_with_every_stroke_exactly_once(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "demo"
    program = "import sys, pathlib, tests.test_demo; tests.test_demo.run_demo_and_die(pathlib.Path(sys.argv[1]))"
    killed = subprocess.run([sys.executable, "-c", program, out], cwd=ROOT, capture_output=True, check=False)
    assert killed.returncode == -signal.SIGKILL, killed.stderr
    run_demo(out)
    printed = capsys.readouterr().out

    session, again = sorted((out / "sessions").iterdir())
    for folder in (session, again):
        begun = [line for line in read_lines(folder / "journal.jsonl") if line["event"] == "begin"]
        patches = [(line["sheet"], patch) for line in begun for patch in line.get("patches", [])]
        assert len(patches) == len(set(patches)), "no patch is ever pressed twice"
        assert verify_session(folder).sound
    strokes = [capture.stroke for capture in Recording(session).captures()]
    assert len(strokes) == len({(s.depth_mm, s.tilt_deg) for s in strokes}) == 4
    repeated = {stroke.again_of for stroke in Recording(again).stroke_records()}
    assert len(repeated) == 1
    assert repeated < {stroke.stroke_id for stroke in strokes}

    paths = re.search(r"Report: (\S+report\.html)\nMCAP:   (\S+\.mcap)", printed)
    assert paths is not None
    page = Path(paths[1]).read_text()
    assert '<span class="source">loopback rig, brush made to agree with the paper&#39;s Table 2: no evidence' in page
    assert "not a result on paper" in page
    assert Path(paths[2]).is_file()
    assert "pix2len" in (out / "demo.log").read_text()  # what the steps print does not drown the answer
    assert "pix2len" not in printed
    # What a screen says of the model while a session is open is what the fit says once it is closed.
    fit, so_far = BrushFit.read(current(session, FITS) or Path()), fit_so_far(session)
    assert so_far is not None
    assert so_far[0] == pytest.approx(fit.csim_percent[FITTED], abs=0.5)
    rows = {row.label: row.scores for row in table_1(Report.read(Path(paths[1]).with_name("report.json")))}
    assert rows.pop("another press") is rows.pop("ceiling") is None  # no condition was pressed twice
    assert set(rows) == {"CCD-BSM", "CCD-BSMG", "robot writing", "CCD-BSM calibrated"}
    assert None not in rows.values()
