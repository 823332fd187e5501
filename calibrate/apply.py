"""A calibration put to use for a session: its own again, or by force another session's, which is then labelled."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from calibrate.artefact import Calibration, Foreign, load_artefact
from calibrate.board.detect import see
from calibrate.board.session import board_of, board_stills
from calibrate.board.view import paper_mm
from calibrate.current import put_to_use
from calibrate.errors import CalibrationError
from sessions.reader import Recording
from sessions.recording.schemas import Source


def apply_calibration(path: Path, session: Path, *, force: bool = False) -> Path:
    """Put the calibration to use for the session; returns where it lies.

    Another recording's is refused unless forced; it then becomes an artefact of its own that names where it comes from
    and how far this session's board lies off under it. Raises `CalibrationError`.
    """
    recording, given = Recording(session), load_artefact(path, Calibration)
    folder = recording.path.parent
    if recording.header.source == Source.IMPORT:
        raise CalibrationError(str(recording.path), "is an import and brings its own scale: nothing is applied to it")
    if given.recording_sha256 == recording.sha256:
        return put_to_use(given, folder)
    if force:
        return put_to_use(_labelled(given, recording), folder)
    told = f"belongs to another recording ({given.session_id}); --force applies it, and labels every result"
    raise CalibrationError(str(path), told)


def _labelled(given: Calibration, recording: Recording) -> Calibration:
    origin = given.foreign or Foreign(
        digest=given.digest,
        session_id=given.session_id,
        source=given.source,
        recording_sha256=given.recording_sha256,
        board_off_mm=None,
    )
    return given.model_copy(
        update={
            "schema_version": type(given).model_fields["schema_version"].default,
            "session_id": recording.header.session_id,
            "source": recording.header.source,
            "recording_sha256": recording.sha256,
            "foreign": origin.model_copy(update={"board_off_mm": _board_off_mm(given, recording)}),
        }
    )


def _board_off_mm(given: Calibration, recording: Recording) -> float | None:
    """How far off (rms) this session's last board lies under the calibration; None where none is seen."""
    spec, where = board_of(recording), str(recording.path)
    off_mm: float | None = None
    for _, image in board_stills(recording):
        if given.lens is not None:
            given.lens.lens().check_size(image, where)
        try:
            view = see(image, spec, where)
        except CalibrationError:
            continue
        there = given.to_paper(view.pixels) - paper_mm(view, spec)
        off_mm = float(np.sqrt((there**2).sum(axis=1).mean()))
    return off_mm
