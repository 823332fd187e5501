"""Show every stage of one capture or photograph in a picture, and write its numbers to a file."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path

import cv2
import numpy as np

from brushloop.calibrate.board.lens import Gray
from brushloop.calibrate.errors import CalibrationError
from brushloop.calibrate.files import read_gray, write_whole
from brushloop.calibrate.session import calibration_of
from brushloop.calibrate.stages import Trace, contact_sheet, trace_capture, trace_scaled
from brushloop.calibrate.stroke.difference import new_stroke
from brushloop.calibrate.stroke.params import Params
from brushloop.sessions.recording import Recording
from brushloop.sessions.terminal import Progress, counted, unseen

PAPER = 255


def show_stroke(session: Path, stroke: str, out: Path, progress: Progress = unseen) -> Trace:
    """Show a stroke of a session by its name, or the first one if the name is empty, as a validation sees it.

    Raises `CalibrationError` where the session was not calibrated.
    """
    recording = Recording(session)
    for capture in counted(recording.captures(), "strokes read", recording.strokes(), progress):
        if stroke in ("", capture.stroke.stroke_id):
            break
    else:
        raise CalibrationError(str(recording.path), f"holds no stroke {stroke!r}")
    calibration = calibration_of(recording, capture.stroke, recording.sha256, None)
    return _written(trace_capture(capture, calibration, f"{recording.path.name} {capture.stroke.stroke_id}"), out)


def show_photograph(path: Path, px_per_mm: float | None, before: Path | None, out: Path) -> Trace:
    """Show a flat photograph of known scale. Raises `CalibrationError`."""
    if px_per_mm is None:
        raise CalibrationError(str(path), "is a photograph: give --px-per-mm")
    image = read_gray(path)
    if before is not None:
        image = only_new(read_gray(before), image, px_per_mm, str(path))
    trace = trace_scaled(image, (px_per_mm, px_per_mm), None, str(path), Params())
    return _written(trace, out)


def only_new(before: Gray, after: Gray, px_per_mm: float, where: str) -> Gray:
    """A page with only the ink that is new since `before`, black on white. Raises `CaptureRefused`."""
    new = new_stroke(before, after, px_per_mm, where)
    return np.rint(PAPER * (1.0 - new.soft)).astype(np.uint8)


def _written(trace: Trace, out: Path) -> Trace:
    _, data = cv2.imencode(".png", contact_sheet(trace))
    out.write_bytes(data.tobytes())
    numbers = {"where": trace.where, "params": asdict(trace.params), "fitted": trace.log, "flags": list(trace.flags)}
    write_whole(out.with_suffix(".json"), json.dumps(numbers, indent=2) + "\n")
    return trace
