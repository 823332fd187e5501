"""Presses of a session come back as a CSV and a protocol that the rig can press again."""

from __future__ import annotations

import csv
import math
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from brushloop.calibrate.compare.place import Field
from brushloop.calibrate.errors import CalibrationError
from brushloop.calibrate.invert import PROTOCOL, Recovered, RecoverRequest, Row, off_command, recover
from brushloop.calibrate.presses import PrepareJob, prepare_job
from brushloop.collect.protocols.config import load_protocol
from brushloop.collect.protocols.presses import ReplayConfig
from brushloop.model.ccdbsm import Brush, ccdbsm
from brushloop.model.raster.exact import coverage_at
from brushloop.sessions.imports import ImportOptions, import_photographs
from brushloop.sessions.messages import encode_png
from brushloop.sessions.recording import Capture
from brushloop.sessions.records import Stroke
from tests.command import brushloop

PRESSES = [(12.0, 3.0), (15.0, 6.0), (18.5, 9.0)]
PX = 12.0  # of the pretended scan, per mm
START = (34.0, 20.0)  # mm from the left and top edge


def photograph(depth_mm: float, tilt_deg: float) -> np.ndarray:
    """A 50 x 40 mm photograph at 12 px/mm of CCD-BSM's own mark, touched at START, ferrule to the right."""
    origin = (START[0] + depth_mm * math.tan(math.radians(tilt_deg)), START[1])
    ink = coverage_at(ccdbsm(Brush(), depth_mm, tilt_deg).outline(), origin, size_px=600, px_mm=1 / PX)[0].numpy()[:480]
    return np.rint(230.0 * (1.0 - 0.92 * ink)).astype(np.uint8)


def session(folder: Path, *, kind: str = "press") -> Path:
    photos = folder / "photos"
    photos.mkdir()
    rows = ["file,depth_mm,tilt_deg,px_per_mm,start_x_px,start_y_px"]
    for k, (height, tilt) in enumerate(PRESSES):
        cv2.imwrite(str(photos / f"p{k}.png"), photograph(height, tilt))
        rows.append(f"p{k}.png,{height},{tilt},{PX},{START[0] * PX},{START[1] * PX}")
    (photos / "strokes.csv").write_text("\n".join(rows) + "\n")
    out = folder / "sessions" / "shots"
    import_photographs(photos, photos / "strokes.csv", out, ImportOptions(kind=kind), "test", lambda: 1)
    return out


def recovered(session: Path, out: Path, **options: Any) -> Recovered:
    return recover(RecoverRequest(session, out / "recovered.csv", **{"anchor_sd_mm": 0.05} | options))


def test_a_session_is_inverted_and_can_be_replayed(tmp_path: Path) -> None:
    made = recovered(session(tmp_path), tmp_path / "out")
    assert made.refused == []
    for row, (height, tilt) in zip(made.rows, PRESSES, strict=True):
        # The preprocessing's own threshold is what is left: .03 mm of depth.
        assert row.depth_mm == pytest.approx(height, abs=0.08)
        assert row.tilt_deg == pytest.approx(tilt, abs=0.6)
        assert 0 < row.depth_sd_mm < 0.2
    protocol = load_protocol(made.protocol)
    assert isinstance(protocol, ReplayConfig)
    assert protocol.of == "shots"
    assert [press.stroke_id for press in protocol.presses] == ["p0", "p1", "p2"]
    assert protocol.presses[1].depth_mm == pytest.approx(made.rows[1].depth_mm, abs=1e-3)
    assert "depth_sd_mm" in protocol.ignored_columns
    with (tmp_path / "out" / "recovered.csv").open() as file:
        first = next(csv.DictReader(file))
    assert first["commanded_depth_mm"] == "12"
    assert first["source"] == "imported photographs"


def test_some_presses_are_chosen_evenly_and_the_others_left_alone(tmp_path: Path) -> None:
    made = recovered(session(tmp_path), tmp_path, presses=2)
    assert [row.stroke_id for row in made.rows] == ["p0", "p1"]
    assert made.refused == []


@pytest.mark.filterwarnings("ignore:.torch.jit.script. is deprecated:DeprecationWarning")
def test_another_model_inverts_the_same_session(tmp_path: Path) -> None:
    with pytest.raises(CalibrationError, match="unknown stroke model 'x'"):
        recovered(session(tmp_path), tmp_path, model="x")
    made = recovered(tmp_path / "sessions" / "shots", tmp_path, model="ellipse")
    # The ellipse is regressed on CCD-BSM's marks: it has their length, so their depth, nearly.
    for row, (height, _) in zip(made.rows, PRESSES, strict=True):
        assert row.depth_mm == pytest.approx(height, abs=3.0)
        assert row.rms > 0.05


def test_drags_are_refused(tmp_path: Path) -> None:
    with pytest.raises(CalibrationError, match="holds drags"):
        recovered(session(tmp_path, kind="drag"), tmp_path)


def test_a_session_of_which_nothing_can_be_recovered_writes_nothing(tmp_path: Path) -> None:
    with pytest.raises(CalibrationError, match="no stroke could be recovered: p0: is cut by the edge of its photo"):
        recovered(session(tmp_path), tmp_path, mm_per_px=0.12)
    assert not (tmp_path / "recovered.csv").exists()


def test_a_capture_without_any_scale_is_refused() -> None:
    stroke = Stroke(stroke_id="s", kind="press", still=0, anchor_mm=(3.0, 4.0))
    capture = Capture(stroke, encode_png(photograph(12.0, 3.0)), "s")
    [(name, why)] = prepare_job(PrepareJob(capture, None, Field())).items()
    assert (name, str(why)) == ("refused", "has neither a calibration nor a scale of its own")


def test_a_name_that_no_protocol_can_hold_is_not_written(tmp_path: Path) -> None:
    with pytest.raises(CalibrationError, match="give a plain name"):
        recover(RecoverRequest(tmp_path, tmp_path / PROTOCOL))


def test_the_summary_compares_with_what_was_commanded() -> None:
    rows = [Row("a", 10.1, 4.0, 0.1, 0.5, 0.1, (), 10.0, 5.0), Row("b", 12.5, 4.0, 0.1, None, 0.1, (), 12.0, None)]
    summary = {name: values for name, *values in off_command(rows)}
    assert summary["H"][0] == pytest.approx(0.3)
    assert summary["H"][1] == pytest.approx(0.4 / 2**0.5)
    assert summary["H"][2:] == [0.5, 2]
    assert summary["alpha"][0] == pytest.approx(-1.0)
    assert summary["alpha"][1] is None
    assert summary["alpha"][3] == 1


def test_the_command_says_what_came_out(tmp_path: Path) -> None:
    session(tmp_path)
    command = ["invert", "sessions/shots", "--out", "again/recovered.csv"]
    ran = brushloop(*command, cwd=tmp_path)
    assert ran.returncode == 0, ran.stderr
    words = " ".join(ran.stdout.split())
    assert "3 presses recovered by ccd-bsm (imported photographs)" in words
    assert "H: recovered - commanded" in words
    assert load_protocol(tmp_path / "again" / PROTOCOL).kind == "replay"
    bad = brushloop(*command, "--tilt-range", "0", "50", cwd=tmp_path)
    assert bad.returncode == 2
    assert bad.stderr.count("\n") == 1
