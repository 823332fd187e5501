"""Show every stage of one capture or photograph in a picture, and write its numbers to a file."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path

import cv2
import numpy as np

from brushloop.calibrate.artefact import current
from brushloop.calibrate.board.lens import Gray
from brushloop.calibrate.board.pix2len import Plane
from brushloop.calibrate.board.session import NO_BOARD, board_of, known_lens
from brushloop.calibrate.board.view import calibration_plane
from brushloop.calibrate.compare.field import Field
from brushloop.calibrate.errors import CalibrationError
from brushloop.calibrate.files import read_gray, write_whole
from brushloop.calibrate.session import calibration_of
from brushloop.calibrate.stages import Trace, contact_sheet, trace_scaled, trace_seen
from brushloop.calibrate.stroke.difference import new_stroke
from brushloop.calibrate.stroke.params import Params
from brushloop.sessions.messages import decode_gray
from brushloop.sessions.recording import Recording
from brushloop.sessions.records import Stroke
from brushloop.sessions.terminal import Progress, counted, unseen

PAPER = 255
PARAMS = Params()


def show_stroke(session: Path, stroke: str, out: Path, lens: Path | None = None, progress: Progress = unseen) -> Trace:
    """Show a stroke of a session by its name, or the first one if the name is empty.

    It is rectified by the calibration that the session uses, as in a validation; with a lens file, or without a
    calibration, by the session's last photograph of the board. Raises `CalibrationError`.
    """
    recording = Recording(session)
    for capture in counted(recording.captures(), "strokes read", recording.strokes(), progress):
        if stroke in ("", capture.stroke.stroke_id):
            break
    else:
        raise CalibrationError(str(recording.path), f"holds no stroke {stroke!r}")
    one, image, where = capture.stroke, capture.image(), f"{recording.path.name} {capture.stroke.stroke_id}"
    if one.anchor_mm is not None:
        plane = _plane(recording, one, image, lens, where)
        window_mm = Field().window_mm(one.anchor_mm)
        trace = trace_seen(image, plane, window_mm, one.anchor_mm, where, PARAMS, one.cell_mm)
    elif one.px_per_mm is not None:
        trace = trace_scaled(image, one.px_per_mm, one.anchor_px, where, PARAMS)
    else:
        raise CalibrationError(where, "has neither an anchor on the sheet nor a scale of its own")
    return _written(trace, out)


def _plane(recording: Recording, one: Stroke, image: Gray, lens: Path | None, where: str) -> Plane:
    path = current(recording.path.parent) if lens is None else None
    used = None if path is None else calibration_of(recording, one, recording.sha256, path)
    if used is not None:
        through = used.lens.lens()
        through.check_size(image, where)
        reach, middle = (used.mm_per_px_low, used.mm_per_px_high), used.middle_px
        return Plane(through, used.homography(), used.mm_per_px, reach, used.rms_px, 0.0, middle, used.corners, ())
    boards = list(recording.stills_of("board"))
    if not boards:
        raise CalibrationError(str(recording.path), NO_BOARD)
    known = known_lens(recording, lens)
    photograph = decode_gray(boards[-1], where)
    return calibration_plane(photograph, board_of(recording), known.lens() if known else None, where)


def show_photograph(path: Path, px_per_mm: float | None, before: Path | None, out: Path) -> Trace:
    """Show a flat photograph of known scale. Raises `CalibrationError`."""
    if px_per_mm is None:
        raise CalibrationError(str(path), "is a photograph: give --px-per-mm")
    image = read_gray(path)
    if before is not None:
        image = only_new(read_gray(before), image, px_per_mm, str(path))
    trace = trace_scaled(image, (px_per_mm, px_per_mm), None, str(path), PARAMS)
    return _written(trace, out)


def only_new(before: Gray, after: Gray, px_per_mm: float, where: str) -> Gray:
    """A page with only the ink that is new since `before`, black on white. Raises `CaptureRefused`."""
    new = new_stroke(before, after, px_per_mm, where)
    return np.rint(PAPER * (1.0 - new.soft)).astype(np.uint8)


def _written(trace: Trace, out: Path) -> Trace:
    _, data = cv2.imencode(".png", contact_sheet(trace))
    out.write_bytes(data.tobytes())
    numbers = {"where": trace.where, "params": asdict(PARAMS), "fitted": trace.log, "flags": list(trace.flags)}
    write_whole(out.with_suffix(".json"), json.dumps(numbers, indent=2) + "\n")
    return trace
