"""Presses against models: a capture drawn by a model must score 1 with that model, in both alignments."""

from __future__ import annotations

import math
from collections.abc import Iterator

import cv2
import numpy as np
import pytest

from calibrate.artefact import Calibration
from calibrate.field import Alignment, Field, Tone, best_shift
from calibrate.preprocess import Params
from calibrate.presses import CEILING, validate_presses
from calibrate.simulate import simulated
from calibrate.tables import table
from model.ccdbsm import Brush
from model.coverage import coverage
from model.registry import stroke_models
from sessions.messages import encode_png
from sessions.reader import Capture
from sessions.schemas import Stroke

MODELS = stroke_models(Brush())
ANCHOR = (60.0, 40.0)
CELL = (30.0, 28.0, 40.0, 24.0)
PX = 10.0  # of the pretended camera, per mm


def drawn(height_mm: float, tilt_deg: float, model: str = "ccd-bsm") -> np.ndarray:
    """A 100 x 80 mm page, photographed straight from above at 10 px/mm, with a model's mark at the anchor."""
    axis_x = ANCHOR[0] + height_mm * math.tan(math.radians(tilt_deg))
    mark = coverage(MODELS[model].profile(height_mm, tilt_deg), (axis_x, 80.0 - ANCHOR[1]), size_px=1000, px_mm=0.1)
    return np.rint(230.0 * (1.0 - 0.92 * mark[0].numpy()[:800])).astype(np.uint8)


def capture(stroke_id: str, image: np.ndarray, height_mm: float, tilt_deg: float) -> Capture:
    stroke = Stroke(
        stroke_id=stroke_id,
        kind="press",
        still=0,
        height_mm=height_mm,
        tilt_deg=tilt_deg,
        cell_mm=CELL,
        anchor_mm=ANCHOR,
    )
    return Capture(stroke, encode_png(image), f"test {stroke_id}")


CALIBRATION = Calibration(
    session_id="test",
    source="loopback rig",
    recording_sha256="",
    software="",
    # Pixel centres on integers: pixel (0, 0) is the middle of the first 0.1 mm.
    image_to_paper=(0.1, 0.0, 0.05, 0.0, -0.1, 79.95, 0.0, 0.0, 1.0),
    mm_per_px=0.1,
    mm_per_px_low=0.1,
    mm_per_px_high=0.1,
    rms_px=0.0,
    corners=24,
    corners_dropped=0,
    preprocess={},
)


def validate(captures: Iterator[Capture] | list[Capture]):
    return validate_presses(iter(captures), MODELS, CALIBRATION, Params(), Field())


@pytest.mark.parametrize("model", ["ccd-bsm", "ellipse", "line"])
@pytest.mark.parametrize(("height_mm", "tilt_deg"), [(11.0, 0.0), (15.0, 5.0), (20.0, 10.0)])
def test_a_mark_drawn_by_a_model_is_recognised_by_it(model: str, height_mm: float, tilt_deg: float) -> None:
    results = validate([capture("one", drawn(height_mm, tilt_deg, model), height_mm, tilt_deg)])
    for score in results.scores:
        if score.model == model and score.tone is Tone.BINARY:
            assert score.csim > 0.985, score
        elif score.alignment is Alignment.MM and score.tone is Tone.BINARY:
            assert score.csim < 0.98, score


@pytest.mark.parametrize("height_mm", [11.0, 13.0, 15.0, 17.0, 20.0])
@pytest.mark.parametrize("tilt_deg", [0.0, 5.0, 10.0])
def test_nothing_is_lost_by_moving_a_stroke_to_the_middle(height_mm: float, tilt_deg: float) -> None:
    results = validate([capture("one", drawn(height_mm, tilt_deg), height_mm, tilt_deg)])
    [score] = [
        s
        for s in results.scores
        if s.model == "ccd-bsm" and s.alignment is Alignment.SIZE_NORMALISED and s.tone is Tone.BINARY
    ]
    assert score.csim > 0.993
    assert score.ssim > 0.96


def test_a_press_that_no_model_can_predict_is_listed_by_name() -> None:
    results = validate([capture("deep", drawn(20.0, 0.0), 60.0, 0.0)])
    assert [name for name, _ in results.refused] == ["deep"]
    assert results.scores == []


def test_a_capture_shifted_by_a_millimetre_is_punished_in_mm_and_forgiven_when_normalised() -> None:
    moved = np.roll(drawn(15.0, 0.0), 10, axis=0)
    results = validate([capture("moved", moved, 15.0, 0.0)])
    scores = {s.alignment: s.csim for s in results.scores if s.model == "ccd-bsm" and s.tone is Tone.BINARY}
    assert scores[Alignment.MM] < 0.95
    assert scores[Alignment.SIZE_NORMALISED] > 0.985


def test_a_press_twice_as_deep_scales_away_when_normalised_but_not_in_mm() -> None:
    results = validate([capture("deep", drawn(20.0, 0.0), 10.0, 0.0)])
    scores = {s.alignment: s.csim for s in results.scores if s.model == "ccd-bsm" and s.tone is Tone.BINARY}
    assert scores[Alignment.SIZE_NORMALISED] > 0.985
    assert scores[Alignment.MM] < 0.8


def test_repeats_of_a_cell_give_the_ceiling() -> None:
    image = drawn(13.0, 5.0)
    results = validate([capture("r1", image, 13.0, 5.0), capture("r2", image, 13.0, 5.0)])
    ceiling = [s for s in results.scores if s.model == CEILING]
    assert len(ceiling) == 2 * 4  # one a stroke, for each alignment and tone
    assert all(s.csim == pytest.approx(1.0) and s.ssim == pytest.approx(1.0) for s in ceiling)


def test_a_blank_capture_is_listed_by_name_and_the_others_go_on() -> None:
    blank = np.full((800, 1000), 230, np.uint8)
    results = validate([capture("blank", blank, 11.0, 0.0), capture("good", drawn(11.0, 0.0), 11.0, 0.0)])
    assert [s.stroke_id for s in results.strokes] == ["good"]
    [(name, why)] = results.refused
    assert name == "blank"
    assert "is blank" in why


def test_a_still_that_is_no_image_is_listed_by_name() -> None:
    stroke = capture("torn", drawn(11.0, 0.0), 11.0, 0.0).stroke
    results = validate([Capture(stroke, b"not an image", "test torn")])
    [(name, why)] = results.refused
    assert name == "torn"
    assert "image" in why


def test_the_table_is_max_min_and_average_in_percent() -> None:
    captures = [capture("a", drawn(11.0, 0.0), 11.0, 0.0), capture("b", drawn(20.0, 0.0, "circle"), 20.0, 0.0)]
    results = validate(captures)
    [row] = [r for r in table(results.scores, Alignment.MM, Tone.BINARY) if r.model == "ccd-bsm"]
    values = [
        100 * s.csim
        for s in results.scores
        if s.model == "ccd-bsm" and s.alignment is Alignment.MM and s.tone is Tone.BINARY
    ]
    assert row.n == 2
    assert row.csim == pytest.approx((max(values), min(values), sum(values) / 2))
    assert (row.paper_csim_avg, row.paper_ssim_avg) == (91.84, 87.71)


def test_best_shift_finds_a_shift_of_up_to_six_pixels_and_no_more() -> None:
    image = simulated(MODELS["ccd-bsm"], 15.0, 0.0, Alignment.SIZE_NORMALISED, Tone.BINARY, Field())
    moved = np.roll(image, (4, -5), axis=(0, 1))
    assert np.array_equal(best_shift(image, moved), moved)
    far = np.roll(image, 9, axis=0)
    assert not np.array_equal(best_shift(image, far), far)


def test_the_field_holds_every_cell_of_the_grid() -> None:
    for height_mm in (11.0, 13.0, 15.0, 17.0, 20.0):
        for tilt_deg in (0.0, 5.0, 10.0):
            image = simulated(MODELS["ccd-bsm"], height_mm, tilt_deg, Alignment.MM, Tone.GRAY, Field())
            edges = np.concatenate([image[0], image[-1], image[:, 0], image[:, -1]])
            assert edges.max() == 0.0
            area_mm2 = float(MODELS["ccd-bsm"].profile(height_mm, tilt_deg).area_mm2[0])
            assert image.sum() * 0.3**2 == pytest.approx(area_mm2, rel=1e-5)
    assert cv2.countNonZero(image) > 0


def test_a_press_outside_one_models_domain_is_scored_by_the_others() -> None:
    stubby = stroke_models(Brush(radius_mm=6.0, length_mm=18.0))["ccd-bsm"]  # H = 20 mm is deeper than its bundle
    models = {"stubby": stubby, "line": MODELS["line"]}
    shown = [capture("one", drawn(20.0, 0.0), 20.0, 0.0)]
    results = validate_presses(iter(shown), models, CALIBRATION, Params(), Field())
    [(stroke, why)] = results.refused
    assert stroke == "one"
    assert why.startswith("stubby does not predict it: height_mm = 20")
    assert {score.model for score in results.scores} == {"line"}
    assert len(results.strokes) == 1
