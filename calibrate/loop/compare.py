"""A session and the session that pressed its strokes again, from their recordings to the verdict."""

from __future__ import annotations

import json
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

from calibrate.artefact import load_artefact
from calibrate.calibration import Calibration
from calibrate.compare.field import Field
from calibrate.compare.simulate import brush_of
from calibrate.errors import CalibrationError
from calibrate.fit.artefact import BrushFit
from calibrate.loop.pairs import Paired, Side, pair_up
from calibrate.loop.scores import PairScore, Verdict, score_pairs, verdicts
from calibrate.loop.table import Table1Row, table_1
from calibrate.session import calibration_of
from model.fitted_shape import fitted_model
from model.protocol import StrokeModel
from model.registry import stroke_model
from sessions.reader import Recording
from sessions.recording.schemas import Header, Source


@dataclass(frozen=True, slots=True)
class Half:
    """One of the two sessions."""

    header: Header
    recording: Path
    sha256: str
    calibration: Calibration | None


@dataclass(frozen=True, slots=True)
class Closed:
    """The loop, closed."""

    original: Half
    again: Half
    model: str
    """What recovered, or is taken to have recovered, depth and tilt, and drew the images between."""
    in_sample: bool
    """Whether that model was fitted to the original presses themselves."""
    field: Field
    paired: Paired
    scores: list[PairScore]
    table: list[Table1Row]
    verdicts: list[Verdict]
    software: str


def compare_sessions(original: Path, again: Path, fit: Path | None, view: Field) -> Closed:
    """Compare pair by pair. Raises `CalibrationError` where the two do not belong together."""
    first, second = Recording(original), Recording(again)
    loopback = [one.header.source == Source.LOOPBACK for one in (first, second)]
    if loopback[0] != loopback[1]:
        raise CalibrationError(str(second.path), f"is {second.header.source}, the original {first.header.source}")
    of = _replayed(second.header)
    if of != first.header.session_id:
        told = "is no replay" if of is None else f"repeats {of}"
        raise CalibrationError(str(second.path), f"{told}, not {first.header.session_id}")
    model, fitted_to = _model(first.header, fit)
    (one, captured), (other, repeated) = _half(first), _half(second)
    paired = pair_up(captured, repeated, model, view)
    if not paired.pairs:
        why = f": {paired.refused[0][0]}: {paired.refused[0][1]}" if paired.refused else ""
        raise CalibrationError(str(second.path), f"not one pair can be compared{why}")
    scores = score_pairs(paired)
    software = f"brushloop {version('brushloop')}"
    in_sample = fitted_to == one.sha256
    table = table_1(
        scores,
        source=other.header.source,
        original=one.header.session_id,
        again=other.header.session_id,
        model=model.label,
    )
    return Closed(one, other, model.label, in_sample, view, paired, scores, table, verdicts(scores), software)


def _half(recording: Recording) -> tuple[Half, Side]:
    digest = recording.sha256
    strokes = list(recording.stroke_records())
    if not strokes or any(stroke.kind != "press" for stroke in strokes):
        raise CalibrationError(str(recording.path), "holds no presses, or drags too: only presses are compared")
    calibration = calibration_of(recording, strokes[0], digest, None)
    return Half(recording.header, recording.path, digest, calibration), Side(recording.captures(), calibration)


def _replayed(header: Header) -> str | None:
    """The session that a replay protocol repeats; None for any other."""
    try:
        told: Any = json.loads(header.protocol)
        return str(told["of"]) if told["kind"] == "replay" else None
    except (ValueError, KeyError, TypeError, RecursionError):
        return None


def _model(header: Header, fit: Path | None) -> tuple[StrokeModel, str]:
    """The model and the digest of the recording that it was fitted to, empty for none."""
    if fit is None:
        return stroke_model("ccd-bsm", brush_of(header)), ""
    made = load_artefact(fit, BrushFit)
    return fitted_model(made.press(), f"CCD-BSM fitted on {made.session_id}"), made.recording_sha256
