"""Calibrate a session: undo its lens, find the board in its stills, fit the plane, write the artefact."""

from __future__ import annotations

import dataclasses
import hashlib
from importlib.metadata import version
from pathlib import Path

from calibrate.artefact import Calibration, LensUsed
from calibrate.board.session import NO_BOARD, board_of, known_lens, sheet_of
from calibrate.board.view import see_straight
from calibrate.current import put_to_use
from calibrate.errors import CalibrationError
from calibrate.stroke.preprocess import Params
from sessions.reader import Recording
from sessions.recording.messages import decode_gray
from sessions.recording.schemas import Source

FITTED = "k1 fitted on the board"


def calibrate_session(session: Path, lens: Path | None = None) -> Path:
    """Calibrate, save beside the recording and use it from now on; returns the artefact's path.

    The lens is the file that is given, else the one that the session was collected with. Raises `CalibrationError`,
    also for a lens that visibly bends and is not known.
    """
    recording = Recording(session)
    if recording.header.source == Source.IMPORT:
        raise CalibrationError(str(recording.path), "is an import and brings its own scale: go on with `validate`")
    where = str(recording.path)
    spec, known = board_of(recording), known_lens(recording, lens)
    stills = list(recording.stills_of("board"))
    if not stills:
        raise CalibrationError(where, NO_BOARD)
    image, straight = decode_gray(stills[-1], where), known.lens() if known else None
    plane, flags = see_straight(image, spec, straight, where, sheet_of(recording))
    low, high = plane.interval_mm_per_px
    calibration = Calibration(
        session_id=recording.header.session_id,
        source=recording.header.source,
        recording_sha256=recording.sha256,
        software=f"brushloop {version('brushloop')}",
        image_to_paper=tuple(plane.image_to_paper.ravel().tolist()),  # pyright: ignore[reportArgumentType]
        mm_per_px=plane.mm_per_px,
        mm_per_px_low=low,
        mm_per_px_high=high,
        rms_px=plane.rms_px,
        corners=plane.corners,
        corners_dropped=len(plane.dropped),
        preprocess=dataclasses.asdict(Params()),
        lens=LensUsed.of(plane.lens, known.source if known else FITTED),
        middle_px=plane.middle_px,
        board=spec,
        flags=flags,
        still_sha256=hashlib.sha256(stills[-1]).hexdigest(),
    )
    return put_to_use(calibration, recording.path.parent)
