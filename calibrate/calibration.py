"""Calibrate a session: find the board in its stills, fit the plane, write the artefact."""

from __future__ import annotations

import dataclasses
import json
from importlib.metadata import version
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from calibrate.artefact import FOLDER, Calibration
from calibrate.errors import CalibrationError
from calibrate.preprocess import Params
from calibrate.scale import BoardSpec, see_board
from sessions.messages import decode_gray
from sessions.reader import Recording
from sessions.schemas import Source

EFFECTIVE = "rig.effective.json"


def calibrate_session(session: Path) -> Path:
    """Calibrate and save beside the recording; returns the artefact's path. Raises `CalibrationError`."""
    recording = Recording(session)
    if recording.header.source == Source.IMPORT:
        raise CalibrationError(str(recording.path), "is an import and brings its own scale: go on with `validate`")
    where = str(recording.path)
    spec = _board_of(recording)
    stills = list(recording.stills_of("board"))
    if not stills:
        raise CalibrationError(where, "holds no view of the board (a `board` step)")
    plane = see_board(decode_gray(stills[-1], where), spec, where)
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
        corners_dropped=plane.dropped,
        preprocess=dataclasses.asdict(Params()),
    )
    return calibration.save(recording.path.parent / FOLDER)


def _board_of(recording: Recording) -> BoardSpec:
    # The effective one: what the environment changed on top of rig.toml is in it.
    where = f"{recording.path} {EFFECTIVE}"
    try:
        rig: Any = json.loads(recording.attachment(EFFECTIVE))
        return BoardSpec.model_validate(rig["board"])
    except (ValueError, KeyError, TypeError, RecursionError) as error:
        if isinstance(error, ValidationError):
            first = error.errors()[0]
            raise CalibrationError(where, f"board.{'.'.join(map(str, first['loc']))}: {first['msg']}") from None
        raise CalibrationError(where, "holds no board") from None
