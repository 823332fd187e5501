"""The camera's noise from stills of one view."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from brushloop.twin.camera import noise_of


def still(sd: float, seed: int) -> np.ndarray:
    """A page under uneven light with one more mark than the still before, as the simulated camera compresses it."""
    page = np.full((240, 320), 200.0) + np.linspace(0.0, 30.0, 320)
    page[20 : 60 + 10 * seed, 40 * seed : 40 * seed + 20] = 30.0
    noisy = np.clip(page + np.random.default_rng(seed).normal(0.0, sd, page.shape), 0, 255).astype(np.uint8)
    coded = cv2.imencode(".jpg", noisy, [cv2.IMWRITE_JPEG_QUALITY, 95])[1]
    return np.asarray(cv2.imdecode(coded, cv2.IMREAD_GRAYSCALE), np.uint8)


@pytest.mark.parametrize("sd", [1.0, 2.0, 5.0])
def test_the_noise_that_was_added_is_found(sd: float) -> None:
    assert noise_of([still(sd, seed) for seed in range(4)]) == pytest.approx(sd, rel=0.15)


def test_stills_of_different_sizes_tell_nothing() -> None:
    assert noise_of([still(2.0, 1), still(2.0, 2)[:100]]) is None
    assert noise_of([]) is None
