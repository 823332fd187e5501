"""Compare a session of written characters with its plan, from the recording to the scores."""

from __future__ import annotations

import json
import math
from dataclasses import dataclass, field
from importlib.metadata import version
from pathlib import Path
from typing import Any, cast

import cv2
import numpy as np

from brushloop.calibrate.calibration import Calibration
from brushloop.calibrate.compare.place import SIZE_PX, Image, Tone, prepare_cell
from brushloop.calibrate.errors import CalibrationError, CaptureRefused
from brushloop.calibrate.files import read_gray
from brushloop.calibrate.session import calibration_of
from brushloop.calibrate.writing.plan_record import FigureRecord, PlanRecord, points_digest
from brushloop.calibrate.writing.scores import Character, Ink, Table3Row, WrittenScore, score_character, table_3
from brushloop.sessions.errors import SessionDamaged
from brushloop.sessions.recording import Capture, Recording
from brushloop.sessions.records import Header
from brushloop.sessions.terminal import Progress, counted, unseen


@dataclass(frozen=True, slots=True)
class WritingComparison:
    """Written characters, compared with their plan."""

    header: Header
    recording: Path
    recording_sha256: str
    calibration: Calibration
    plan: PlanRecord
    characters: list[Character]
    scores: list[WrittenScore]
    table: list[Table3Row]
    refused: list[tuple[str, str]] = field(default_factory=list[tuple[str, str]])
    """(stroke, why), never dropped in silence."""
    software: str = ""


def compare_written(
    session: Path, plan: PlanRecord, references: dict[str, tuple[str, Image]], progress: Progress = unseen
) -> WritingComparison:
    """Compare a session with its plan. `references` (character -> name, image) replace those of the plan.

    Raises `CalibrationError` if the two do not belong together or nothing can be compared.
    """
    recording = Recording(session)
    digest = recording.sha256
    first = next(recording.stroke_records(), None)
    calibration = None if first is None else calibration_of(recording, first, digest, None)
    if first is None or calibration is None:
        raise CalibrationError(str(recording.path), "holds no characters that the arm wrote")
    _check_points(recording, plan)
    if unknown := sorted(set(references) - {figure.name for figure in plan.figures}):
        raise CalibrationError("--reference", f"{unknown[0]!r} is not in the plan")
    found, cut, refused = _writings(recording, plan, calibration, progress)
    characters = [_character(figure, found, cut, references) for figure in plan.figures if figure.name in found]
    if not characters:
        why = f": {refused[0][0]}: {refused[0][1]}" if refused else ""
        raise CalibrationError(str(recording.path), f"no character can be compared{why}")
    counting = counted(characters, "characters compared", len(characters), progress)
    scores = [score for one in counting for score in score_character(one)]
    header = recording.header
    table = table_3(
        scores,
        source=header.source,
        session_id=header.session_id,
        model=plan.model,
        references={one.name: one.reference_name for one in characters},
    )
    software = f"brushloop {version('brushloop')}"
    return WritingComparison(
        header, recording.path, digest, calibration, plan, characters, scores, table, refused, software
    )


def _writings(
    recording: Recording, plan: PlanRecord, calibration: Calibration, progress: Progress
) -> tuple[dict[str, dict[str, Ink]], set[str], list[tuple[str, str]]]:
    """(character -> stroke -> ink, strokes that are cut, refused)."""
    found: dict[str, dict[str, Ink]] = {}
    cut: set[str] = set()
    refused: list[tuple[str, str]] = []
    what = f"{recording.header.session_id}: found"
    for capture in counted(recording.captures(), what, recording.strokes(), progress):
        stroke_id = capture.stroke.stroke_id
        name = stroke_id.rsplit("-r", 1)[0]
        if capture.stroke.kind != "drag" or plan.figure(name) is None:
            refused.append((stroke_id, "is not a character of this plan"))
            continue
        try:
            ink, is_cut = captured(capture, calibration)
        except (CaptureRefused, SessionDamaged) as error:
            refused.append((stroke_id, error.what))
            continue
        found.setdefault(name, {})[stroke_id] = ink
        cut |= {stroke_id} if is_cut else set()
    return found, cut, refused


def _character(
    figure: FigureRecord, found: dict[str, dict[str, Ink]], cut: set[str], references: dict[str, tuple[str, Image]]
) -> Character:
    name, image = references.get(figure.name) or (figure.source, figure.wanted())
    writings = found[figure.name]
    edge = tuple(stroke_id for stroke_id in writings if stroke_id in cut)
    return Character(figure.name, name, as_ink(image), as_ink(figure.simulated()), writings, edge)


def _check_points(recording: Recording, plan: PlanRecord) -> None:
    """Check that the session's protocol drew the plan. Raises `CalibrationError` otherwise."""
    try:
        protocol: Any = json.loads(recording.header.protocol)
        points = {f["name"]: points_digest([s["points"] for s in f["strokes"]]) for f in protocol["figures"]}
        cell_mm = [float(side) for side in protocol["cell_mm"]]
    except (ValueError, KeyError, TypeError, RecursionError):
        raise CalibrationError(str(recording.path), "was not collected by a `write` protocol") from None
    if cell_mm != [plan.cell_mm, plan.cell_mm]:
        raise CalibrationError(str(recording.path), f"has cells of {cell_mm} mm, the plan {plan.cell_mm:g} mm")
    for name, digest in points.items():
        figure = plan.figure(name)
        if figure is None or figure.points_sha256 != digest:
            raise CalibrationError(str(recording.path), f"{name!r} was not drawn from this plan")


def captured(capture: Capture, calibration: Calibration) -> tuple[Ink, bool]:
    """Return the ink on the character's paper cell, and whether it reaches the edge. Raises `CaptureRefused`."""
    _, _, size_x_mm, size_y_mm = capture.stroke.cell_mm or (0.0,) * 4
    if not math.isclose(size_x_mm, size_y_mm):
        what = f"its cell is {size_x_mm:g} x {size_y_mm:g} mm, but must be square"
        raise CaptureRefused(capture.stroke.stroke_id, what)
    prepared = prepare_cell(capture, calibration)
    return {Tone.BINARY: _small(prepared.mask.astype(np.float32)), Tone.GRAY: _small(prepared.soft)}, prepared.cut


def _small(image: Image) -> Image:
    return cast("Image", cv2.resize(image, (SIZE_PX, SIZE_PX), interpolation=cv2.INTER_AREA))


def read_reference(path: Path) -> Image:
    """Read (128, 128) ink from a picture of a dark character on light, padded to square. Raises `CalibrationError`."""
    gray = read_gray(path)
    ink = 1.0 - gray.astype(np.float32) / 255.0
    if float(ink.mean()) > 0.5:
        raise CalibrationError(str(path), "is mostly dark: a reference is dark ink on light paper")
    height, width = ink.shape
    side = max(height, width)
    top, left = (side - height) // 2, (side - width) // 2
    square = np.pad(ink, ((top, side - height - top), (left, side - width - left)))
    return _small(square)


def as_ink(image: Image) -> Ink:
    """Make ink from an image that was not photographed: its darkness is its coverage."""
    return dict.fromkeys(Tone, image)
