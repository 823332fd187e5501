"""CSIM is the plain cosine, SSIM is scikit-image's, and a size-normalised image takes its best shift first."""

from __future__ import annotations

import math

import numpy as np
import pytest
from skimage.metrics import structural_similarity

from brushloop.calibrate.compare.place import BEST_SHIFT_PX, Alignment, Polarity, best_shift, similarity
from brushloop.model.similarity import binary_scores, csim, ssim

NORMAL = Alignment.SIZE_NORMALISED


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


@pytest.mark.parametrize(
    ("other", "cosine"),
    [
        (image((1, 1), (2, 2)), 1.0),
        (image((5, 5)), 0.0),
        (image((1, 1), (3, 3)), 0.5),
        (0.5 * image((1, 1)) + image((2, 2)), 1.5 / math.sqrt(1.25 * 2.0)),
    ],
)
def test_csim_counts_the_ink_in_common(other: np.ndarray, cosine: float) -> None:
    assert csim(image((1, 1), (2, 2)), other) == pytest.approx(cosine)


@pytest.mark.parametrize("tones", [1, 255])
def test_ssim_is_scikit_images_though_only_the_surroundings_of_marks_are_computed(tones: int) -> None:
    rng = np.random.default_rng(tones)
    for a, b in zip(marks(rng, 8, tones), marks(rng, 8, tones), strict=True):
        assert ssim(a, b) == pytest.approx(of_scikit_image(a, b), abs=1e-12)
        paper = similarity(a, b, Alignment.MM, Polarity.PAPER)
        assert paper[1] == pytest.approx(of_scikit_image(1.0 - a, 1.0 - b), abs=1e-12)


@pytest.mark.parametrize("tones", [1, 255])
def test_the_best_shift_is_taken_before_scoring(tones: int) -> None:
    rng = np.random.default_rng(10 + tones)
    [captured] = marks(rng, 1, tones)
    rolled = [np.roll(captured, by, axis=(0, 1)) for by in ((0, 0), (3, -5), (-6, 6), (9, 0))]
    for other in (*rolled, *marks(rng, 4, tones)):
        shifted = shifted_by_trying_every_one(other, captured)
        assert np.array_equal(best_shift(other, captured), shifted)
        assert similarity(captured, other, NORMAL) == (csim(captured, shifted), ssim(captured, shifted))


def test_a_mark_inside_another_is_left_where_it_is() -> None:
    captured, other = np.zeros((2, 128, 128))
    captured[40:90, 20:110] = 1.0
    other[50:80, 30:100] = 1.0  # every shift of up to 6 px has the same overlap
    assert np.array_equal(best_shift(other, captured), other)


def test_paper_as_1_would_praise_a_blank_page_so_a_blank_image_has_no_score() -> None:
    stroke = np.zeros((128, 128))
    stroke[60:75, 20:100] = 1.0
    assert csim(1.0 - stroke, np.ones_like(stroke)) > 0.94
    for pair in ((stroke, 0.0 * stroke), (0.0 * stroke, stroke)):
        for alignment in Alignment:
            with pytest.raises(ValueError, match="blank"):
                similarity(*pair, alignment, Polarity.PAPER)


def test_many_pairs_at_once_are_scored_as_one_by_one() -> None:
    seen, truth = np.stack([image((1, 1), (2, 2)), image()]) > 0, np.stack([image((1, 1), (3, 3), (4, 4))] * 2) > 0
    [[cosine, share], blank] = binary_scores(seen, truth).tolist()
    assert (cosine, share, blank) == (pytest.approx(csim(seen[0], truth[0])), pytest.approx(1 / 4), [0.0, 0.0])


def test_images_of_different_shape_are_refused() -> None:
    with pytest.raises(ValueError, match="of one shape"):
        csim(np.ones((4, 4)), np.ones((4, 5)))
