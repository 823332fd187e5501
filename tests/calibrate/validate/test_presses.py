"""Presses against models: a capture drawn by a model must score 1 with that model, in both alignments."""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np
import pytest

from brushloop.calibrate.compare.place import (
    KEYS,
    Alignment,
    Field,
    Tone,
    pack,
    simulated,
    simulated_pixels,
)
from brushloop.calibrate.compare.score import best_shift
from brushloop.calibrate.validate.jobs import ABSENT, PrepareJob, Press, ScoreJob, prepare_job, score_job
from brushloop.model.ccdbsm import Brush
from brushloop.model.raster.exact import coverage_at
from brushloop.model.strokes import stroke_models
from brushloop.sessions.messages import encode_png
from brushloop.sessions.recording import Capture
from brushloop.sessions.records import Stroke
from tests.calibrate.given import CALIBRATION

MODELS = stroke_models(Brush())
ANCHOR = (60.0, 40.0)
CELL = (30.0, 28.0, 40.0, 24.0)
PX = 10.0  # of the pretended camera, per mm


def drawn(depth_mm: float, tilt_deg: float, model: str = "ccd-bsm") -> np.ndarray:
    """A 100 x 80 mm page, photographed straight from above at 10 px/mm, with a model's mark at the anchor."""
    axis_x = ANCHOR[0] + depth_mm * math.tan(math.radians(tilt_deg))
    mark = coverage_at(MODELS[model].profile(depth_mm, tilt_deg), (axis_x, 80.0 - ANCHOR[1]), size_px=1000, px_mm=0.1)
    return np.rint(230.0 * (1.0 - 0.92 * mark[0].numpy()[:800])).astype(np.uint8)


def capture(stroke_id: str, image: np.ndarray, depth_mm: float, tilt_deg: float) -> Capture:
    stroke = Stroke(
        stroke_id=stroke_id,
        kind="press",
        still=0,
        depth_mm=depth_mm,
        tilt_deg=tilt_deg,
        cell_mm=CELL,
        anchor_mm=ANCHOR,
    )
    return Capture(stroke, encode_png(image), f"test {stroke_id}")


@dataclass(frozen=True)
class Score:
    model: str
    alignment: Alignment
    tone: Tone
    csim: float
    ssim: float


ANOTHER = "another press"


def validate(captures: list[Capture]) -> tuple[list[Press], list[Score]]:
    """What was refused, and every score of the rest; all of one cell."""
    presses = [prepare_job(PrepareJob(one, CALIBRATION, Field())) for one in captures]
    used = [press for press in presses if not press.refused]
    refused = [press for press in presses if press.refused]
    if not used:
        return refused, []
    cell = used[0].condition.depth_mm, used[0].condition.tilt_deg
    pixels = tuple(press.pixels for press in used)
    predicted_by = tuple(tuple(k for k in range(len(used)) if k != n) for n in range(len(used)))
    predictions = tuple(pack(simulated_pixels(model, *cell, Field())) for model in MODELS.values())
    found = score_job(ScoreJob(pixels, predictions, pixels, predicted_by, (ABSENT,) * len(used)))
    names = [*MODELS, ANOTHER]
    scores = [
        Score(name, alignment, tone, *(float(v) for v in found[n, m, k]))
        for n in range(len(used))
        for m, name in enumerate(names)
        for k, (alignment, tone) in enumerate(KEYS)
        if np.isfinite(found[n, m, k, 0])
    ]
    return refused, scores


@pytest.mark.parametrize("model", ["ccd-bsm", "ellipse", "line"])
@pytest.mark.parametrize(("depth_mm", "tilt_deg"), [(11.0, 0.0), (15.0, 5.0), (20.0, 10.0)])
def test_a_mark_drawn_by_a_model_is_recognised_by_it(model: str, depth_mm: float, tilt_deg: float) -> None:
    refused, scores = validate([capture("one", drawn(depth_mm, tilt_deg, model), depth_mm, tilt_deg)])
    assert refused == []
    for score in scores:
        if score.model == model and score.tone is Tone.BINARY:
            assert score.csim > 0.985, score
        elif score.alignment is Alignment.MM and score.tone is Tone.BINARY:
            assert score.csim < 0.98, score


@pytest.mark.parametrize("depth_mm", [11.0, 13.0, 15.0, 17.0, 20.0])
@pytest.mark.parametrize("tilt_deg", [0.0, 5.0, 10.0])
def test_nothing_is_lost_by_moving_a_stroke_to_the_middle(depth_mm: float, tilt_deg: float) -> None:
    refused, scores = validate([capture("one", drawn(depth_mm, tilt_deg), depth_mm, tilt_deg)])
    [score] = [
        s for s in scores if s.model == "ccd-bsm" and s.alignment is Alignment.SIZE_NORMALISED and s.tone is Tone.BINARY
    ]
    assert refused == []
    assert score.csim > 0.993
    assert score.ssim > 0.96


def test_a_capture_shifted_by_a_millimetre_is_punished_in_mm_and_forgiven_when_normalised() -> None:
    moved = np.roll(drawn(15.0, 0.0), 10, axis=0)
    refused, scores = validate([capture("moved", moved, 15.0, 0.0)])
    found = {s.alignment: s.csim for s in scores if s.model == "ccd-bsm" and s.tone is Tone.BINARY}
    assert refused == []
    assert found[Alignment.MM] < 0.95
    assert found[Alignment.SIZE_NORMALISED] > 0.985


def test_a_press_twice_as_deep_scales_away_when_normalised_but_not_in_mm() -> None:
    refused, scores = validate([capture("deep", drawn(20.0, 0.0), 10.0, 0.0)])
    found = {s.alignment: s.csim for s in scores if s.model == "ccd-bsm" and s.tone is Tone.BINARY}
    assert refused == []
    assert found[Alignment.SIZE_NORMALISED] > 0.985
    assert found[Alignment.MM] < 0.8


def test_repeats_of_a_cell_are_compared_with_each_other() -> None:
    image = drawn(13.0, 5.0)
    refused, scores = validate([capture("r1", image, 13.0, 5.0), capture("r2", image, 13.0, 5.0)])
    another = [s for s in scores if s.model == ANOTHER]
    assert refused == []
    assert len(another) == 2 * 4  # one a stroke, for each alignment and tone
    assert all(s.csim == pytest.approx(1.0) and s.ssim == pytest.approx(1.0) for s in another)


def test_a_blank_capture_is_listed_by_name_and_the_others_go_on() -> None:
    blank = np.full((800, 1000), 230, np.uint8)
    refused, scores = validate([capture("blank", blank, 11.0, 0.0), capture("good", drawn(11.0, 0.0), 11.0, 0.0)])
    [press] = refused
    assert press.stroke_id == "blank"
    assert "is blank" in press.refused
    assert scores


def test_a_still_that_is_no_image_is_listed_by_name() -> None:
    stroke = capture("torn", drawn(11.0, 0.0), 11.0, 0.0).stroke
    refused, _ = validate([Capture(stroke, b"not an image", "test torn")])
    [press] = refused
    assert press.stroke_id == "torn"
    assert "image" in press.refused


def test_a_press_without_a_depth_is_listed_by_name() -> None:
    stroke = capture("mute", drawn(11.0, 0.0), 11.0, 0.0)
    refused, _ = validate([Capture(stroke.stroke.model_copy(update={"tilt_deg": None}), stroke.still_png, "test")])
    assert [(press.stroke_id, press.refused) for press in refused] == [("mute", "has no depth or tilt")]


def test_best_shift_finds_a_shift_of_up_to_six_pixels_and_no_more() -> None:
    image = simulated(MODELS["ccd-bsm"], 15.0, 0.0, Field())[Alignment.SIZE_NORMALISED, Tone.BINARY]
    moved = np.roll(image, (4, -5), axis=(0, 1))
    assert np.array_equal(best_shift(image, moved), moved)
    far = np.roll(image, 9, axis=0)
    assert not np.array_equal(best_shift(image, far), far)


def test_the_field_holds_every_cell_of_the_grid() -> None:
    for depth_mm in (11.0, 13.0, 15.0, 17.0, 20.0):
        for tilt_deg in (0.0, 5.0, 10.0):
            image = simulated(MODELS["ccd-bsm"], depth_mm, tilt_deg, Field())[Alignment.MM, Tone.GRAY]
            edges = np.concatenate([image[0], image[-1], image[:, 0], image[:, -1]])
            assert edges.max() == 0.0
            area_mm2 = float(MODELS["ccd-bsm"].profile(depth_mm, tilt_deg).area_mm2[0])
            assert image.sum() * 0.3**2 == pytest.approx(area_mm2, rel=1e-5)
    assert cv2.countNonZero(image) > 0
