"""Compare a session with the one that pressed its strokes again: paired by name, on the same fields, and scored."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from brushloop.calibrate.artefact import load_artefact, made_by
from brushloop.calibrate.calibration import Calibration
from brushloop.calibrate.compare.place import Field, brush_of, captured_images, prepare_press, simulated
from brushloop.calibrate.errors import CalibrationError, CaptureRefused
from brushloop.calibrate.fit.artefact import BrushFit
from brushloop.calibrate.loop.scores import (
    CapturedPress,
    Pair,
    PairScore,
    Table1Row,
    Verdict,
    score_pairs,
    table_1,
    verdicts,
)
from brushloop.calibrate.session import calibration_of
from brushloop.calibrate.stroke.measure import measure
from brushloop.model.brush import DomainError
from brushloop.sessions.errors import SessionDamaged
from brushloop.sessions.recording import Capture, Recording
from brushloop.sessions.records import Condition, Header, Source
from brushloop.sessions.terminal import Progress, counted, unseen

if TYPE_CHECKING:
    from brushloop.model.protocol import StrokeModel


NOT_AGAIN = "was not pressed again"


@dataclass(frozen=True, slots=True)
class Pairs:
    """Every pair, every original, and what could not be used."""

    pairs: list[Pair] = field(default_factory=list[Pair])
    originals: dict[str, CapturedPress] = field(default_factory=dict[str, CapturedPress])
    refused: list[tuple[str, str]] = field(default_factory=list[tuple[str, str]])
    """(stroke, reason), never dropped silently."""


@dataclass(frozen=True, slots=True)
class ComparedSession:
    """One of the two sessions."""

    header: Header
    recording: Path
    sha256: str
    calibration: Calibration | None


@dataclass(frozen=True, slots=True)
class LoopComparison:
    """The result of pressing a session's strokes again."""

    original: ComparedSession
    again: ComparedSession
    model: str
    """The model that recovered, or is assumed to have recovered, depth and tilt, and drew the generated images."""
    in_sample: bool
    """Whether that model was fitted to the original presses themselves."""
    field: Field
    paired: Pairs
    scores: list[PairScore]
    table: list[Table1Row]
    verdicts: list[Verdict]
    software: str


def compare_sessions(
    original: Path, again: Path, fit: Path | None, view: Field, progress: Progress = unseen
) -> LoopComparison:
    """Compare pair by pair. Raises `CalibrationError` where the two do not belong together."""
    first, second = Recording(original), Recording(again)
    loopback = [one.header.source == Source.LOOPBACK for one in (first, second)]
    if loopback[0] != loopback[1]:
        raise CalibrationError(str(second.path), f"is {second.header.source}, the original {first.header.source}")
    repeated = _replayed(second.header)
    if repeated != first.header.session_id:
        what = "is not a replay" if repeated is None else f"repeats {repeated}"
        raise CalibrationError(str(second.path), f"{what}, not {first.header.session_id}")
    model, fitted_to = _model(first.header, fit)
    one, other = _opened(first), _opened(second)
    captures, repeats = (
        counted(recording.captures(), f"{recording.header.session_id}: found", recording.strokes(), progress)
        for recording in (first, second)
    )
    paired = pair_up(captures, one.calibration, repeats, other.calibration, model, view)
    if not paired.pairs:
        why = f": {paired.refused[0][0]}: {paired.refused[0][1]}" if paired.refused else ""
        raise CalibrationError(str(second.path), f"not one pair can be compared{why}")
    progress("compared", 0, 1)
    scores = score_pairs(paired.pairs, paired.originals.values())
    progress("compared", 1, 1)
    table = table_1(
        scores,
        source=other.header.source,
        original=one.header.session_id,
        again=other.header.session_id,
        model=model.label,
    )
    return LoopComparison(
        one,
        other,
        model.label,
        fitted_to == one.sha256,
        view,
        paired,
        scores,
        table,
        verdicts(scores),
        made_by(),
    )


def pair_up(
    original: Iterator[Capture],
    original_calibration: Calibration | None,
    again: Iterator[Capture],
    again_calibration: Calibration | None,
    model: StrokeModel,
    view: Field,
) -> Pairs:
    """Pair captures by `again_of`. Originals that were not pressed again are listed as refused."""
    found = Pairs()
    for press, _ in _presses(original, original_calibration, view, found.refused):
        if press.stroke_id in found.originals:
            found.refused.append((press.stroke_id, "two strokes have this name: the first is used"))
        else:
            found.originals[press.stroke_id] = press
    repeated: set[str] = set()
    for press, of in _presses(again, again_calibration, view, found.refused):
        if of is None or of not in found.originals:
            why = "repeats no stroke" if of is None else f"repeats {of}, which does not exist or cannot be used"
            found.refused.append((press.stroke_id, why))
            continue
        try:
            images = simulated(model, press.condition.depth_mm, press.condition.tilt_deg, view)
        except DomainError as error:
            found.refused.append((press.stroke_id, f"the model does not predict it: {error}"))
            continue
        repeated.add(of)
        found.pairs.append(Pair(found.originals[of], press, images))
    found.refused.extend((name, NOT_AGAIN) for name in found.originals if name not in repeated)
    return found


def _presses(
    captures: Iterator[Capture], calibration: Calibration | None, view: Field, refused: list[tuple[str, str]]
) -> Iterator[tuple[CapturedPress, str | None]]:
    """(press, the stroke it repeats) of every capture that can be used; the others go to `refused`."""
    for capture in captures:
        stroke = capture.stroke
        if stroke.depth_mm is None or stroke.tilt_deg is None:
            refused.append((stroke.stroke_id, "has no depth or tilt"))
            continue
        try:
            prepared = prepare_press(capture, calibration, view)
            images = captured_images(stroke.stroke_id, prepared)
        except (CaptureRefused, SessionDamaged) as error:
            refused.append((stroke.stroke_id, error.what))
            continue
        condition = Condition(stroke.depth_mm, stroke.tilt_deg)
        yield CapturedPress(stroke.stroke_id, condition, measure(prepared.mask), images), stroke.again_of


def _opened(recording: Recording) -> ComparedSession:
    strokes = list(recording.stroke_records())
    if not strokes or any(stroke.kind != "press" for stroke in strokes):
        raise CalibrationError(str(recording.path), "holds no presses, or drags too: only presses are compared")
    calibration = calibration_of(recording, strokes[0], recording.sha256, None)
    return ComparedSession(recording.header, recording.path, recording.sha256, calibration)


def _replayed(header: Header) -> str | None:
    """The session that a replay protocol repeats; None for any other."""
    try:
        protocol: Any = json.loads(header.protocol)
        return str(protocol["of"]) if protocol["kind"] == "replay" else None
    except (ValueError, KeyError, TypeError, RecursionError):
        return None


def _model(header: Header, fit: Path | None) -> tuple[StrokeModel, str]:
    """The model and the digest of the recording that it was fitted to, empty for none."""
    if fit is None:
        from brushloop.model.strokes import stroke_model  # torch, which takes seconds to load

        return stroke_model("ccd-bsm", brush_of(header)), ""
    artefact = load_artefact(fit, BrushFit)
    from brushloop.model.fitted_shape import fitted_model

    return fitted_model(artefact.press(), f"CCD-BSM fitted on {artefact.session_id}"), artefact.recording_sha256
