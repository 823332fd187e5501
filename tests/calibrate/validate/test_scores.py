"""Presses against models: a capture drawn by a model must score 1 with that model, in both alignments."""

from __future__ import annotations

import math

import numpy as np
import pytest

from brushloop.calibrate.compare.place import KEYS, Alignment, Field, Tone, simulated
from brushloop.calibrate.presses import PrepareJob, Press, prepare_job
from brushloop.calibrate.scores import Scores, similarities
from brushloop.calibrate.stroke.preprocess import Measured
from brushloop.calibrate.validate.run import score_job
from brushloop.model.ccdbsm import Brush
from brushloop.model.raster import coverage
from brushloop.model.strokes import stroke_models
from brushloop.sessions.messages import encode_png
from brushloop.sessions.recording import Capture
from brushloop.sessions.records import Condition, Stroke
from tests.calibrate.given import CALIBRATION

MODELS = stroke_models(Brush())
ANCHOR, CELL = (60.0, 40.0), (30.0, 28.0, 40.0, 24.0)
MM, NORMAL = (Alignment.MM, Tone.BINARY), (Alignment.SIZE_NORMALISED, Tone.BINARY)


def page_of(depth_mm: float, tilt_deg: float, model: str = "ccd-bsm") -> np.ndarray:
    """A 100 x 80 mm page, photographed straight from above at 10 px/mm, with a model's mark at the anchor."""
    axis_x = ANCHOR[0] + depth_mm * math.tan(math.radians(tilt_deg))
    mark = coverage(MODELS[model].profile(depth_mm, tilt_deg), (axis_x, 80.0 - ANCHOR[1]), size_px=1000, px_mm=0.1)
    return np.rint(230.0 * (1.0 - 0.92 * mark[0][:800])).astype(np.uint8)


def images_of(page: np.ndarray) -> np.ndarray:
    """(KEYS, 128, 128): the press of a page, as it is compared."""
    stroke = Stroke(stroke_id="a", kind="press", still=0, cell_mm=CELL, anchor_mm=ANCHOR)
    return prepare_job(PrepareJob(Capture(stroke, encode_png(page), "test"), CALIBRATION, Field()))["images"]


def scores_of(page: np.ndarray, depth_mm: float, tilt_deg: float) -> dict[str, np.ndarray]:
    """(KEYS, 2) scores of every model's press of that command."""
    images = tuple([simulated(model, depth_mm, tilt_deg, Field())] for model in MODELS.values())
    return dict(zip(MODELS, score_job((images_of(page), images))["values"], strict=True))


@pytest.mark.parametrize("model", ["ccd-bsm", "ellipse", "line"])
@pytest.mark.parametrize(("depth_mm", "tilt_deg"), [(11.0, 0.0), (15.0, 5.0), (20.0, 10.0)])
def test_a_mark_drawn_by_a_model_is_recognised_by_it(model: str, depth_mm: float, tilt_deg: float) -> None:
    for name, values in scores_of(page_of(depth_mm, tilt_deg, model), depth_mm, tilt_deg).items():
        if name == model:
            assert min(values[KEYS.index(MM), 0], values[KEYS.index(NORMAL), 0]) > 0.985
            assert values[KEYS.index(NORMAL), 1] > 0.94
        else:
            assert values[KEYS.index(MM), 0] < 0.98


@pytest.mark.parametrize(
    ("page", "command", "strict"),
    [
        (np.roll(page_of(15.0, 0.0), 10, axis=0), (15.0, 0.0), 0.95),  # a millimetre off
        (page_of(20.0, 0.0), (10.0, 0.0), 0.8),  # twice as deep as commanded
    ],
)
def test_a_wrong_place_or_size_is_forgiven_when_normalised_but_not_in_mm(
    page: np.ndarray, command: tuple[float, float], strict: float
) -> None:
    values = scores_of(page, *command)["ccd-bsm"][:, 0]
    assert values[KEYS.index(NORMAL)] > 0.985
    assert values[KEYS.index(MM)] < strict


def test_scores_of_several_images_are_averaged_and_of_none_are_missing() -> None:
    near, far = images_of(page_of(13.0, 5.0)), images_of(page_of(15.0, 5.0))
    one, other, both, none = (similarities(near, images) for images in ([near], [far], [near, far], []))
    assert one == pytest.approx(1.0)
    assert both == pytest.approx((one + other) / 2)
    assert np.isnan(none).all()
    assert np.isnan(similarities(near, [np.zeros_like(near)])).all()


def test_the_field_holds_every_cell_of_the_grid() -> None:
    for depth_mm, tilt_deg in ((11.0, 0.0), (11.0, 10.0), (20.0, 0.0), (20.0, 10.0)):
        image = simulated(MODELS["ccd-bsm"], depth_mm, tilt_deg, Field())[KEYS.index((Alignment.MM, Tone.GRAY))] / 255
        assert np.concatenate([image[0], image[-1], image[:, 0], image[:, -1]]).max() == 0.0
        assert image.sum() * 0.3**2 == pytest.approx(
            MODELS["ccd-bsm"].profile(depth_mm, tilt_deg).area_mm2[0], rel=1e-3
        )


def test_the_table_is_in_order_of_capture_and_its_cells_in_order_of_session_and_condition() -> None:
    shallow, upright, tilted = Condition(20.0, 0.0), Condition(11.0, 0.0), Condition(11.0, 10.0)
    order = [("b", shallow), ("b", upright), ("b", tilted), ("b", shallow), ("a", shallow), ("a", upright)]
    sizes, blank = Measured(1.0, 1.0, 1.0, 1.0, 1.0), np.zeros((4, 128, 128), np.uint8)
    presses: list[Press] = []
    for k, (name, at) in enumerate(order):
        stroke = Stroke(stroke_id=str(k), kind="press", still=k, depth_mm=at.depth_mm, tilt_deg=at.tilt_deg)
        presses.append(Press(name, "", stroke, blank, np.zeros((128, 128), np.float32), (0.0, 0.0), sizes, False, ()))
    scores = Scores(presses, ["line", "circle"])
    assert scores.cells == [[1], [2], [0, 3], [5], [4]]
    assert scores.cell_of.tolist() == [2, 0, 1, 2, 4, 3]
    assert scores.conditions() == {upright: [1, 5], tilted: [2], shallow: [0, 3, 4]}
    scores.values[4, 1] = 0.5
    assert [(s.session_id, s.stroke_id, s.model, s.csim) for s in scores] == [("a", "4", "circle", 0.5)] * len(KEYS)
