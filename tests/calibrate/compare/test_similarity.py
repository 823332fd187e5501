"""CSIM against numpy on hand-made pairs; SSIM against scikit-image's own defaults made explicit."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from skimage.metrics import structural_similarity

from brushloop.calibrate.compare.similarity import binary_scores, csim, ssim

images = hnp.arrays(np.float64, (16, 16), elements=st.floats(0, 1))


def image(*ink: tuple[int, int]) -> np.ndarray:
    made = np.zeros((16, 16))
    for place in ink:
        made[place] = 1.0
    return made


def test_the_same_ink_is_1_and_disjoint_ink_is_0() -> None:
    assert csim(image((1, 1), (2, 2)), image((1, 1), (2, 2))) == pytest.approx(1.0)
    assert csim(image((1, 1)), image((2, 2))) == 0.0


def test_many_pairs_at_once_are_scored_as_one_by_one() -> None:
    seen, truth = np.stack([image((1, 1), (2, 2)), image()]) > 0, np.stack([image((1, 1), (3, 3), (4, 4))] * 2) > 0
    [[cosine, share], blank] = binary_scores(seen, truth).tolist()
    assert cosine == pytest.approx(csim(seen[0], truth[0]))
    assert share == pytest.approx(1 / 4)
    assert blank == [0.0, 0.0]


def test_half_the_ink_in_common_is_one_half() -> None:
    assert csim(image((1, 1), (2, 2)), image((1, 1), (3, 3))) == pytest.approx(0.5)


def test_one_of_four_pixels_is_one_half_by_the_norms() -> None:
    assert csim(image((1, 1)), image((1, 1), (2, 2), (3, 3), (4, 4))) == pytest.approx(1 / math.sqrt(4))


def test_gray_ink_counts_by_its_amount() -> None:
    a, b = 0.5 * image((1, 1)) + image((2, 2)), image((1, 1)) + image((2, 2))
    assert csim(a, b) == pytest.approx(1.5 / math.sqrt(1.25 * 2.0))


@given(images, images)
def test_csim_is_numpys_cosine(a: np.ndarray, b: np.ndarray) -> None:
    norm = np.linalg.norm(a) * np.linalg.norm(b)
    if norm == 0.0:
        with pytest.raises(ValueError, match="blank"):
            csim(a, b)
    else:
        assert csim(a, b) == pytest.approx(float(np.sum(a * b) / norm), abs=1e-12)


def test_paper_as_1_would_praise_a_blank_page_which_is_why_ink_is_1() -> None:
    stroke = np.zeros((128, 128))
    stroke[60:75, 20:100] = 1.0
    assert csim(1.0 - stroke, np.ones_like(stroke)) > 0.94
    with pytest.raises(ValueError, match="blank"):
        csim(stroke, np.zeros_like(stroke))


@given(images, images)
def test_ssim_is_scikit_images(a: np.ndarray, b: np.ndarray) -> None:
    expected = structural_similarity(
        a, b, data_range=1.0, gaussian_weights=True, sigma=1.5, use_sample_covariance=False
    )
    assert ssim(a, b) == pytest.approx(expected, abs=1e-12)


def test_ssim_matches_its_formula_written_out() -> None:
    # Wang et al. 2004, eq. 13, with gaussian windows and population covariance, edges cropped as scikit-image does.
    from scipy.ndimage import gaussian_filter

    rng = np.random.default_rng(3)
    x, y = rng.random((40, 40)), rng.random((40, 40))

    def mean(z: np.ndarray) -> np.ndarray:
        return gaussian_filter(z, 1.5, truncate=3.5)

    mx, my = mean(x), mean(y)
    vx, vy, vxy = mean(x * x) - mx * mx, mean(y * y) - my * my, mean(x * y) - mx * my
    c1, c2 = 0.01**2, 0.03**2
    by_hand = (2 * mx * my + c1) * (2 * vxy + c2) / ((mx**2 + my**2 + c1) * (vx + vy + c2))
    assert ssim(x, y) == pytest.approx(by_hand[5:-5, 5:-5].mean(), abs=1e-12)


def test_images_of_different_shape_are_refused() -> None:
    with pytest.raises(ValueError, match="of one shape"):
        csim(np.ones((4, 4)), np.ones((4, 5)))
