"""Calibrate a session: find the board in its stills, fit the plane, write the artefact."""

from __future__ import annotations

import dataclasses
import tomllib
from importlib.metadata import version
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from calibrate.artefact import FOLDER, Calibration
from calibrate.errors import CalibrationError
from calibrate.preprocess import Params
from calibrate.scale import BoardSpec, find_corners, fit_plane
from sessions.messages import decode_gray
from sessions.reader import Recording


def calibrate_session(session: Path) -> Path:
    """Calibrate and save beside the recording; returns the artefact's path. Raises `CalibrationError`."""
    recording = Recording(session)
    where = str(recording.path)
    spec = _board_of(recording)
    stills = list(recording.stills_of("board"))
    if not stills:
        raise CalibrationError(where, "holds no view of the board (a `board` step)")
    pixels, paper = find_corners(decode_gray(stills[-1], where), spec, where)
    plane = fit_plane(pixels, paper, where)
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
    where = f"{recording.path} rig.toml"
    try:
        rig: dict[str, Any] = tomllib.loads(recording.attachment("rig.toml").decode())
        return BoardSpec.model_validate(rig.get("board"))
    except (UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        raise CalibrationError(where, f"is not TOML: {error}") from None
    except ValidationError as error:
        first = error.errors()[0]
        raise CalibrationError(where, f"board.{'.'.join(map(str, first['loc']))}: {first['msg']}") from None
