"""Validate presses: every model against every captured stroke, and the captures against each other."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np

from calibrate.artefact import Calibration
from calibrate.errors import CaptureRefused
from calibrate.field import Alignment, Field, Image, Tone, best_shift, captured_mm, captured_normalised
from calibrate.measure import Measured, measure
from calibrate.preprocess import PX_PER_MM, Params, Prepared, on_raster, prepare, rectify, rescale
from calibrate.similarity import csim, ssim
from calibrate.simulate import simulated
from model.ccdbsm import DomainError
from model.registry import StrokeModel
from sessions.errors import SessionDamaged
from sessions.reader import Capture
from sessions.schemas import Stroke

CEILING = "another press"
"""A capture predicted by each other capture of its cell, averaged: how well one press foretells another."""
Key = tuple[Alignment, Tone]
KEYS: tuple[Key, ...] = tuple(itertools.product(Alignment, Tone))


@dataclass(frozen=True, slots=True)
class Score:
    """One predicted image against one captured stroke."""

    stroke_id: str
    height_mm: float
    tilt_deg: float
    model: str
    alignment: Alignment
    tone: Tone
    csim: float
    ssim: float


@dataclass(frozen=True, slots=True)
class Compared:
    """A captured stroke on its way into the report."""

    stroke_id: str
    height_mm: float
    tilt_deg: float
    measured: Measured
    cut: bool
    images: dict[Key, Image]


@dataclass(slots=True)
class PressResults:
    """Everything that the report of a press session needs."""

    scores: list[Score] = field(default_factory=list[Score])
    strokes: list[Compared] = field(default_factory=list[Compared])
    predicted: dict[tuple[str, float, float], Image] = field(default_factory=dict[tuple[str, float, float], Image])
    """(model, H, alpha) -> gray image on the millimetre field."""
    refused: list[tuple[str, str]] = field(default_factory=list[tuple[str, str]])
    """(stroke, why), never dropped in silence; with the name of a model where only that one cannot predict it."""


def validate_presses(
    captures: Iterator[Capture],
    models: dict[str, StrokeModel],
    calibration: Calibration | None,
    params: Params,
    view: Field,
) -> PressResults:
    """Score every model on every stroke. Captures that cannot be used are listed, not raised."""
    results = PressResults()
    cache: dict[tuple[str, float, float, Key], Image] = {}
    for capture in captures:
        stroke = capture.stroke
        try:
            prepared = prepare_press(capture, calibration, params, view)
        except (CaptureRefused, SessionDamaged) as error:
            results.refused.append((stroke.stroke_id, error.what))
            continue
        if stroke.height_mm is None or stroke.tilt_deg is None:
            results.refused.append((stroke.stroke_id, "tells no depth or tilt"))
            continue
        try:
            compared = _compared(stroke.stroke_id, stroke.height_mm, stroke.tilt_deg, prepared)
            scores = _score_models(results, compared, models, view, cache)
        except CaptureRefused as error:
            results.refused.append((stroke.stroke_id, error.what))
            continue
        results.strokes.append(compared)
        results.scores += scores
    _score_ceiling(results)
    return results


def prepare_press(capture: Capture, calibration: Calibration | None, params: Params, view: Field) -> Prepared:
    """The stroke on the millimetre field, rectified by the calibration or by the import's own scale.

    Raises `CaptureRefused` for a capture that cannot be used, `SessionDamaged` for a picture that cannot be read.
    """
    stroke, image = capture.stroke, capture.image()
    left, top = (v * PX_PER_MM for v in view.anchor_mm)
    if stroke.anchor_mm is not None and calibration is not None:
        window = view.window_mm(stroke.anchor_mm)
        raster = rectify(image, calibration.homography(), window)
        return prepare(raster, (left, top), capture.where, params, _cell_px(stroke, window))
    if stroke.px_per_mm is None:
        raise CaptureRefused(stroke.stroke_id, "has neither a calibration nor a scale of its own")
    raster = rescale(image, stroke.px_per_mm, capture.where)
    if stroke.anchor_px is None:
        raise CaptureRefused(stroke.stroke_id, "has no anchor (start_x_px, start_y_px): it cannot be laid on a model")
    anchor = on_raster(stroke.anchor_px, stroke.px_per_mm)
    return _crop(prepare(raster, anchor, capture.where, params), view)


def _crop(prepared: Prepared, view: Field) -> Prepared:
    assert prepared.anchor_px is not None
    side = round(view.side_mm * PX_PER_MM)
    left = round(prepared.anchor_px[0] - view.anchor_mm[0] * PX_PER_MM)
    top = round(prepared.anchor_px[1] - view.anchor_mm[1] * PX_PER_MM)
    mask, soft = np.pad(prepared.mask, side), np.pad(prepared.soft, side)
    rows, columns = slice(top + side, top + 2 * side), slice(left + side, left + 2 * side)
    anchor = (prepared.anchor_px[0] - left, prepared.anchor_px[1] - top)
    kept = mask[rows, columns]
    if not kept.any():
        raise CaptureRefused("anchor", "lies so far from the stroke that none of it is in the field")
    cut = prepared.cut or bool(np.count_nonzero(kept) < np.count_nonzero(prepared.mask))
    return Prepared(kept, soft[rows, columns], anchor, prepared.threshold, cut)


def _cell_px(stroke: Stroke, window: tuple[float, float, float, float]) -> tuple[int, int, int, int] | None:
    if stroke.cell_mm is None:
        return None
    x, y, width, height = stroke.cell_mm
    top = window[1] + window[3] - (y + height)
    scaled = ((x - window[0]) * PX_PER_MM, top * PX_PER_MM, width * PX_PER_MM, height * PX_PER_MM)
    return round(scaled[0]), round(scaled[1]), round(scaled[2]), round(scaled[3])


def _compared(stroke_id: str, height_mm: float, tilt_deg: float, prepared: Prepared) -> Compared:
    images = {
        (alignment, tone): (captured_mm if alignment is Alignment.MM else captured_normalised)(prepared, tone)
        for alignment, tone in KEYS
    }
    for (alignment, tone), image in images.items():
        if not image.any():
            raise CaptureRefused(stroke_id, f"is too thin to be seen at the scale of {alignment} ({tone})")
    return Compared(stroke_id, height_mm, tilt_deg, measure(prepared.mask), prepared.cut, images)


def _score_models(
    results: PressResults,
    stroke: Compared,
    models: dict[str, StrokeModel],
    view: Field,
    cache: dict[tuple[str, float, float, Key], Image],
) -> list[Score]:
    scores: list[Score] = []
    outside: list[tuple[str, str]] = []
    for name, model in models.items():
        try:
            for key in KEYS:
                ident = (name, stroke.height_mm, stroke.tilt_deg, key)
                if ident not in cache:
                    cache[ident] = simulated(model, stroke.height_mm, stroke.tilt_deg, *key, view)
        except DomainError as error:
            outside.append((name, str(error)))
            continue
        scores += [_score(stroke, name, key, cache[(name, stroke.height_mm, stroke.tilt_deg, key)]) for key in KEYS]
        results.predicted[(name, stroke.height_mm, stroke.tilt_deg)] = cache[
            (name, stroke.height_mm, stroke.tilt_deg, (Alignment.MM, Tone.GRAY))
        ]
    if outside and not scores:
        raise CaptureRefused(stroke.stroke_id, f"no model predicts it: {outside[0][1]}")
    results.refused += [(stroke.stroke_id, f"{name} does not predict it: {why}") for name, why in outside]
    return scores


def _score_ceiling(results: PressResults) -> None:
    def cell(stroke: Compared) -> tuple[float, float]:
        return stroke.height_mm, stroke.tilt_deg

    for _, group in itertools.groupby(sorted(results.strokes, key=cell), key=cell):
        presses = list(group)
        for one in presses:
            others = [other for other in presses if other is not one]
            if others:
                results.scores += [_mean([_score(one, CEILING, key, o.images[key]) for o in others]) for key in KEYS]


def _mean(scores: list[Score]) -> Score:
    csims, ssims = [s.csim for s in scores], [s.ssim for s in scores]
    return dataclasses.replace(scores[0], csim=sum(csims) / len(csims), ssim=sum(ssims) / len(ssims))


def _score(stroke: Compared, model: str, key: Key, predicted: Image) -> Score:
    alignment, tone = key
    captured = stroke.images[key]
    if alignment is Alignment.SIZE_NORMALISED:
        predicted = best_shift(predicted, captured)
    return Score(
        stroke.stroke_id,
        stroke.height_mm,
        stroke.tilt_deg,
        model,
        alignment,
        tone,
        csim(captured, predicted),
        ssim(captured, predicted),
    )
