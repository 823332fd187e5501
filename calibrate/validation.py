"""Validate a recording and write its report: presses against the models, drags by what can be measured."""

from __future__ import annotations

import csv
import io
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path

from calibrate import artefact
from calibrate.artefact import Calibration
from calibrate.brushfit import artefact as fits
from calibrate.drags import DragResults, validate_drags
from calibrate.errors import CalibrationError
from calibrate.field import Field
from calibrate.preprocess import Params
from calibrate.presses import PressResults, Score, validate_presses
from model.ccdbsm import Brush
from model.fitted_shape import NAME, fitted_model
from model.registry import StrokeModel, stroke_models
from sessions.reader import Recording
from sessions.schemas import Header, Stroke


@dataclass(frozen=True, slots=True)
class Validation:
    """A recording and what came out of it."""

    header: Header
    recording: Path
    recording_sha256: str
    calibration: Calibration | None
    models: dict[str, StrokeModel]
    field: Field
    results: PressResults | DragResults
    software: str


def validate_recording(
    session: Path, names: list[str], view: Field, calibration_path: Path | None, fit_path: Path | None = None
) -> Validation:
    """Validate one session. Raises `CalibrationError` where it was not calibrated or a model is unknown.

    The fitted brush at `fit_path`, or the session's newest, is one more model.
    """
    recording = Recording(session)
    digest = recording.sha256
    strokes = list(recording.stroke_records())
    kinds = {stroke.kind for stroke in strokes}
    if not kinds:
        raise CalibrationError(str(recording.path), "holds no strokes")
    if len(kinds) > 1:
        raise CalibrationError(str(recording.path), "mixes presses and drags; validate them as two sessions")
    calibration = calibration_of(recording, strokes[0], digest, calibration_path)
    models = _models(recording, digest, names, fit_path)
    params = Params(**calibration.preprocess) if calibration else Params()
    results = (
        validate_presses(recording.captures(), models, calibration, params, view)
        if kinds == {"press"}
        else validate_drags(recording.captures(), params)
    )
    return Validation(
        recording.header,
        recording.path,
        digest,
        calibration,
        models,
        view,
        results,
        f"brushloop {version('brushloop')}",
    )


def scores_csv(scores: list[Score], source: str) -> str:
    """Every score, one row each, with the kind of ink it is of."""
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow(["stroke_id", "height_mm", "tilt_deg", "model", "alignment", "tone", "csim", "ssim", "source"])
    for s in scores:
        writer.writerow(
            [
                s.stroke_id,
                s.height_mm,
                s.tilt_deg,
                s.model,
                s.alignment,
                s.tone,
                f"{s.csim:.6f}",
                f"{s.ssim:.6f}",
                source,
            ]
        )
    return out.getvalue()


def drags_csv(results: DragResults, source: str) -> str:
    """Commanded beside measured, one row a stroke."""
    names = sorted({name for drag in results.strokes for name in drag.commanded})
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    columns = ["measured_length_mm", "measured_width_mm", "measured_mid_width_mm", "measured_area_mm2", "cut", "source"]
    writer.writerow(["stroke_id", *(f"commanded_{name}" for name in names), *columns])
    for drag in results.strokes:
        m = drag.measured
        sizes = [f"{v:.3f}" for v in (m.length_mm, m.width_mm, m.mid_width_mm, m.area_mm2)]
        writer.writerow(
            [drag.stroke_id, *(drag.commanded.get(name, "") for name in names), *sizes, int(drag.cut), source]
        )
    return out.getvalue()


def calibration_of(recording: Recording, first: Stroke, digest: str, given: Path | None) -> Calibration | None:
    """The artefact given, or the session's newest; None for an import, which brings its own scale.

    Raises `CalibrationError` where there is none, or it belongs to another recording.
    """
    if first.px_per_mm is not None:
        return None
    path = given or artefact.newest(recording.path.parent)
    if path is None:
        raise CalibrationError(
            str(recording.path), f"is not calibrated: run `brushloop calibrate {recording.path.parent}`"
        )
    calibration = artefact.load(path)
    if calibration.recording_sha256 != digest:
        raise CalibrationError(str(path), f"belongs to another recording ({calibration.session_id})")
    return calibration


def brush_of(header: Header) -> Brush:
    """The brush that a recording names; the nominal bundle of the paper stands in where it tells none."""
    nominal = Brush()
    return Brush(
        radius_mm=header.brush_radius_mm or nominal.radius_mm, length_mm=header.brush_length_mm or nominal.length_mm
    )


def _models(recording: Recording, digest: str, names: list[str], fit_path: Path | None) -> dict[str, StrokeModel]:
    known = stroke_models(brush_of(recording.header))
    path = fit_path or fits.newest(recording.path.parent)
    if path is not None:
        fit = fits.load(path)
        # A score on the very strokes that were fitted says nothing about others: the label tells.
        seen = "in sample" if fit.recording_sha256 == digest else f"on {fit.session_id}"
        known[NAME] = fitted_model(fit.press(), f"CCD-BSM fitted ({seen})")
    for name in names:
        if name not in known:
            raise CalibrationError("--model", f"{name!r} is not one of: {', '.join(known)}")
    return {name: known[name] for name in names} if names else known
