"""What belongs to a recording that is validated: its calibration, and the brush that it names."""

from __future__ import annotations

from pathlib import Path

from calibrate.artefact import Calibration, load_artefact
from calibrate.current import current
from calibrate.errors import CalibrationError
from model.ccdbsm import Brush
from sessions.reader import Recording
from sessions.recording.schemas import Header, Stroke


def calibration_of(recording: Recording, first: Stroke, digest: str, given: Path | None) -> Calibration | None:
    """The artefact given, or the one that the session uses; None for an import, which brings its own scale.

    Raises `CalibrationError` where there is none, or it belongs to another recording.
    """
    if first.px_per_mm is not None:
        return None
    path = given or current(recording.path.parent)
    if path is None:
        raise CalibrationError(
            str(recording.path), f"is not calibrated: run `brushloop calibrate {recording.path.parent}`"
        )
    calibration = load_artefact(path, Calibration)
    if calibration.recording_sha256 != digest:
        told = f"belongs to another recording ({calibration.session_id}): `brushloop calibrate apply --force` labels it"
        raise CalibrationError(str(path), told)
    return calibration


def brush_of(header: Header) -> Brush:
    """The brush that a recording names; the nominal bundle of the paper stands in where it tells none."""
    nominal = Brush()
    return Brush(
        radius_mm=header.brush_radius_mm or nominal.radius_mm, length_mm=header.brush_length_mm or nominal.length_mm
    )
