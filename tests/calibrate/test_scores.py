"""CSIM is the plain cosine, SSIM is scikit-image's; presses are scored with models, and with their repetitions."""

from __future__ import annotations

import functools
import math
from collections.abc import Iterable, Sequence

import numpy as np
import pytest
from skimage.metrics import structural_similarity

from brushloop.calibrate.compare import (
    BEST_SHIFT_PX,
    KEYS,
    Alignment,
    Polarity,
    Tone,
    best_shift,
    similarity,
    simulated,
)
from brushloop.calibrate.loop import AGAIN, ANOTHER, SIMULATED, LoopRecord, Pair, pair_up, score_pairs, statistics_of
from brushloop.calibrate.presses import Press
from brushloop.calibrate.scores import Scores, similarities
from brushloop.calibrate.validate.run import score_job
from brushloop.model.ccdbsm import Brush
from brushloop.model.similarity import binary_scores, csim, ssim
from brushloop.model.strokes import stroke_models
from brushloop.sessions.records import Condition, Stroke
from tests.calibrate.given import blank_press, drawn_press, loop_record


def image(*ink: tuple[int, int]) -> np.ndarray:
    pixels = np.zeros((16, 16))
    for place in ink:
        pixels[place] = 1.0
    return pixels


def marks(rng: np.random.Generator, count: int, tones: int) -> np.ndarray:
    """Ellipses anywhere on the field, some across its edge, of `tones` levels of gray."""
    y, x = np.mgrid[:128, :128]
    out = np.zeros((count, 128, 128))
    for pixels in out:
        cx, cy = rng.uniform(10, 118, 2)
        inside = ((x - cx) / rng.uniform(4, 50)) ** 2 + ((y - cy) / rng.uniform(3, 25)) ** 2 < 1.0
        pixels[inside] = np.round(rng.integers(1, tones + 1, inside.sum()) * 255 / tones) / 255
    return out


def of_scikit_image(a: np.ndarray, b: np.ndarray) -> float:
    options = {"gaussian_weights": True, "sigma": 1.5, "use_sample_covariance": False}
    return structural_similarity(a, b, data_range=1.0, **options)


def shifted_by_trying_every_one(moving: np.ndarray, fixed: np.ndarray) -> np.ndarray:
    """The image at its largest overlap, of equals at the least shift."""
    reach = range(2 * BEST_SHIFT_PX + 1)
    padded = np.pad(moving, BEST_SHIFT_PX)
    places = sorted(((r, c) for r in reach for c in reach), key=lambda at: math.hypot(*np.subtract(at, BEST_SHIFT_PX)))
    levels = np.rint(255 * fixed).astype(np.int64)
    shown = [padded[row:, column:][:128, :128] for row, column in places]
    return max(shown, key=lambda at: int((np.rint(255 * at).astype(np.int64) * levels).sum()))


def test_csim_is_the_cosine_of_the_ink_in_common() -> None:
    seen, lighter = image((1, 1), (2, 2)), 0.5 * image((1, 1)) + image((2, 2), (3, 3))
    assert csim(seen, lighter) == pytest.approx(1.5 / math.sqrt(2.0 * 2.25))
    assert csim(seen, image((5, 5))) == 0.0


@pytest.mark.parametrize("tones", [1, 255])
def test_ssim_is_scikit_images_though_only_the_surroundings_of_marks_are_computed(tones: int) -> None:
    rng = np.random.default_rng(tones)
    for a, b in zip(marks(rng, 8, tones), marks(rng, 8, tones), strict=True):
        assert ssim(a, b) == pytest.approx(of_scikit_image(a, b), abs=1e-12)
        [paper] = similarity(a, b[None], Alignment.MM, Polarity.PAPER)
        assert paper[1] == pytest.approx(of_scikit_image(1.0 - a, 1.0 - b), abs=1e-12)


@pytest.mark.parametrize("tones", [1, 255])
def test_the_best_shift_is_taken_before_scoring(tones: int) -> None:
    rng = np.random.default_rng(10 + tones)
    [captured] = marks(rng, 1, tones)
    rolled = [np.roll(captured, by, axis=(0, 1)) for by in ((0, 0), (3, -5), (-6, 6), (9, 0))]
    others = np.stack([*rolled, *marks(rng, 4, tones)])
    shifted = np.stack([shifted_by_trying_every_one(other, captured) for other in others])
    assert np.array_equal(best_shift(others, captured), shifted)
    expected = [(csim(captured, each), ssim(captured, each)) for each in shifted]
    assert similarity(captured, others, Alignment.SIZE_NORMALISED) == pytest.approx(np.array(expected), abs=1e-12)


def test_a_mark_inside_another_is_left_where_it_is() -> None:
    captured, other = np.zeros((2, 128, 128))
    captured[40:90, 20:110] = 1.0
    other[50:80, 30:100] = 1.0  # every shift of up to 6 px has the same overlap
    assert np.array_equal(best_shift(other[None], captured)[0], other)


def test_paper_as_1_would_praise_a_blank_page_so_a_blank_image_has_no_score() -> None:
    stroke = np.zeros((128, 128))
    stroke[60:75, 20:100] = 1.0
    assert csim(1.0 - stroke, np.ones_like(stroke)) > 0.94
    blank = np.zeros_like(stroke)
    for alignment in Alignment:
        blank_and_not = similarity(stroke, np.stack([blank, stroke]), alignment, Polarity.PAPER)
        assert np.isnan(blank_and_not).all(axis=1).tolist() == [True, False]
        assert np.isnan(similarity(blank, stroke[None], alignment, Polarity.PAPER)).all()


def test_many_pairs_at_once_are_scored_as_one_by_one() -> None:
    seen, truth = np.stack([image((1, 1), (2, 2)), image()]) > 0, np.stack([image((1, 1), (3, 3), (4, 4))] * 2) > 0
    [[cosine, share], blank] = binary_scores(seen, truth).tolist()
    assert (cosine, share, blank) == (pytest.approx(csim(seen[0], truth[0])), pytest.approx(1 / 4), [0.0, 0.0])


MODELS = stroke_models(Brush())
MM, NORMAL = (Alignment.MM, Tone.BINARY), (Alignment.SIZE_NORMALISED, Tone.BINARY)


def images_of(depth_mm: float, tilt_deg: float, model: str = "ccd-bsm") -> np.ndarray:
    """(KEYS, 128, 128): a press that left a model's mark, as it is compared."""
    return drawn_press(Stroke(stroke_id="a", kind="press", still=0), MODELS[model], depth_mm, tilt_deg).images


def scores_of(images: np.ndarray, depth_mm: float, tilt_deg: float) -> dict[str, np.ndarray]:
    """(KEYS, 2) scores of every model's press of that command."""
    drawn = tuple([simulated(model, depth_mm, tilt_deg)] for model in MODELS.values())
    return dict(zip(MODELS, score_job((images, drawn))["values"], strict=True))


@pytest.mark.parametrize("model", ["ccd-bsm", "ellipse", "line"])
@pytest.mark.parametrize(("depth_mm", "tilt_deg"), [(11.0, 0.0), (15.0, 5.0), (20.0, 10.0)])
def test_a_mark_drawn_by_a_model_is_recognised_by_it(model: str, depth_mm: float, tilt_deg: float) -> None:
    for name, values in scores_of(images_of(depth_mm, tilt_deg, model), depth_mm, tilt_deg).items():
        if name == model:
            assert min(values[KEYS.index(MM), 0], values[KEYS.index(NORMAL), 0]) > 0.985
            assert values[KEYS.index(NORMAL), 1] > 0.94
        else:
            assert values[KEYS.index(MM), 0] < 0.98


@pytest.mark.parametrize(
    ("depth_mm", "off_px", "commanded_mm", "strict"),
    [
        (15.0, 3, 15.0, 0.95),  # a millimetre off
        (20.0, 0, 10.0, 0.8),  # twice as deep as commanded
    ],
)
def test_a_wrong_place_or_size_is_forgiven_when_normalised_but_not_in_mm(
    depth_mm: float, off_px: int, commanded_mm: float, strict: float
) -> None:
    images = np.roll(images_of(depth_mm, 0.0), off_px, axis=1)
    values = scores_of(images, commanded_mm, 0.0)["ccd-bsm"][:, 0]
    assert values[KEYS.index(NORMAL)] > 0.985
    assert values[KEYS.index(MM)] < strict


def test_scores_of_several_images_are_averaged_and_of_none_are_missing() -> None:
    near, far = images_of(13.0, 5.0), images_of(15.0, 5.0)
    one, other, both, none = similarities(near, ([near], [far], [near, far], []))
    assert one == pytest.approx(1.0)
    assert both == pytest.approx((one + other) / 2)
    assert np.isnan(none).all()
    assert np.isnan(similarities(near, [[np.zeros_like(near)]])).all()
    assert np.isnan(similarities(near, [[]])).all()


def test_the_field_holds_every_condition_of_the_grid() -> None:
    for depth_mm, tilt_deg in ((11.0, 0.0), (11.0, 10.0), (20.0, 0.0), (20.0, 10.0)):
        image = simulated(MODELS["ccd-bsm"], depth_mm, tilt_deg)[KEYS.index((Alignment.MM, Tone.GRAY))] / 255
        assert np.concatenate([image[0], image[-1], image[:, 0], image[:, -1]]).max() == 0.0


def test_the_table_is_in_order_of_capture_and_its_groups_in_order_of_session_and_condition() -> None:
    shallow, upright, tilted = Condition(20.0, 0.0), Condition(11.0, 0.0), Condition(11.0, 10.0)
    order = [("b", shallow), ("b", upright), ("b", tilted), ("b", shallow), ("a", shallow), ("a", upright)]
    presses = [blank_press(str(k), at.depth_mm, at.tilt_deg, name) for k, (name, at) in enumerate(order)]
    scores = Scores(presses, ["line", "circle"])
    assert scores.groups == [[1], [2], [0, 3], [5], [4]]
    assert scores.group_of.tolist() == [2, 0, 1, 2, 4, 3]
    assert scores.conditions() == {upright: [1, 5], tilted: [2], shallow: [0, 3, 4]}
    scores.values[4, 1] = 0.5
    assert [(s.session_id, s.stroke_id, s.model, s.csim) for s in scores] == [("a", "4", "circle", 0.5)] * len(KEYS)


# Presses made again: pairs by name, scored against the brush's own repeatability

MODEL = MODELS["ccd-bsm"]


def press(name: str, shown: tuple[float, float], asked: tuple[float, float], of: str | None = None) -> Press:
    stroke = Stroke(stroke_id=name, kind="press", still=0, depth_mm=asked[0], tilt_deg=asked[1], again_of=of)
    return drawn_press(stroke, MODEL, *shown)


def paired(of: Iterable[Press], again: Iterable[Press]) -> tuple[list[Pair], dict[str, str]]:
    """Pairs, and why presses are in none."""
    refused: list[tuple[str, str]] = []
    return pair_up(list(of), list(again), MODEL, refused), dict(refused)


@functools.cache
def originals() -> list[Press]:
    return [
        press("a-r01", (14.6, 5.0), (15.0, 5.0)),
        press("a-r02", (15.4, 5.0), (15.0, 5.0)),
        press("b-r01", (19.0, 0.0), (19.0, 0.0)),
    ]


def record_of(again: Iterable[Press], first: Sequence[Press] = ()) -> LoopRecord:
    scores = score_pairs(paired(first or originals(), again)[0], first or originals())
    return loop_record("grid", "ab", stats=tuple(statistics_of(scores)))


def test_a_press_made_again_beats_the_other_press_of_its_condition_and_what_repeats_nothing_is_named() -> None:
    again = [
        press("a-r01~1", (14.6, 5.0), (14.6, 5.0), "a-r01"),
        press("a-r02~1", (15.4, 5.0), (15.4, 5.0), "a-r02"),
        press("x~1", (15.0, 5.0), (15.0, 5.0), "x"),
        press("y", (15.0, 5.0), (15.0, 5.0)),
    ]
    pairs, refused = paired(originals(), again)
    names = [(pair.original.stroke.stroke_id, pair.again.stroke.stroke_id) for pair in pairs]
    assert names == [("a-r01", "a-r01~1"), ("a-r02", "a-r02~1")]
    assert refused == {
        "x~1": "repeats x, whose original is missing or cannot be used",
        "y": "repeats an unnamed stroke, whose original is missing or cannot be used",
        "b-r01": "was not pressed again",
    }
    scores = score_pairs(pairs, originals())
    csim = {what: scores.of_key(what, MM)[:, 0] for what in scores.models}
    assert csim[AGAIN].min() == pytest.approx(1.0)
    assert csim[ANOTHER].max() < 0.98
    assert csim[SIMULATED].mean() > 0.99
    record = record_of(again)
    assert len(record.lost) == 8
    assert all(points < 0.0 and row.csim.n == 2 for points, *_, row in record.lost)
    assert (record.answer.good, "is not certain yet" in record.answer.text) == (None, True), (
        "two presses of one condition"
    )


def test_presses_made_again_too_deep_fail_once_there_are_enough_to_be_certain() -> None:
    at = [(depth, tilt) for tilt in (0.0, 5.0, 10.0) for depth in (14.9, 15.1)]
    first = [press(f"{depth}-{tilt}", (depth, tilt), (15.0, tilt)) for depth, tilt in at]
    again = [press(f"{depth}-{tilt}~1", (18.0, tilt), (18.0, tilt), f"{depth}-{tilt}") for depth, tilt in at]
    assert record_of(again, first).answer.good is False
    assert record_of(again[:2], first).answer.good is None


def test_an_original_alone_in_its_condition_has_no_repeatability() -> None:
    record = record_of([press("b-r01~1", (19.0, 0.0), (19.0, 0.0), "b-r01")])
    assert ANOTHER not in {row.model for row in record.rows(MM)}
    assert (record.lost, record.answer.good) == ([], None)
