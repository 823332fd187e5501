"""The compiled scores are scikit-image's SSIM and the plain cosine, for any two images."""

from __future__ import annotations

import numba
import numpy as np
import pytest

from brushloop.calibrate.compare import compiled
from brushloop.calibrate.compare.compiled import compare
from brushloop.calibrate.compare.field import BEST_SHIFT_PX, Alignment
from brushloop.calibrate.compare.images import pack, unpack
from brushloop.calibrate.compare.similarity import csim, similarity, ssim


def marks(rng: np.random.Generator, count: int, tones: int) -> np.ndarray:
    """Ellipses anywhere on the field, some across its edge, of `tones` levels."""
    y, x = np.mgrid[:128, :128]
    out = np.zeros((count, 128, 128), np.uint8)
    for image in out:
        cx, cy = rng.uniform(10, 118, 2)
        inside = ((x - cx) / rng.uniform(4, 50)) ** 2 + ((y - cy) / rng.uniform(3, 25)) ** 2 < 1.0
        image[inside] = np.round(rng.integers(1, tones + 1, inside.sum()) * 255 / tones).astype(np.uint8)
    return out


def plainly_shifted(moving: np.ndarray, fixed: np.ndarray) -> np.ndarray:
    """The image at its largest overlap, of equals at the least shift, by trying every one."""
    reach = range(-BEST_SHIFT_PX, BEST_SHIFT_PX + 1)
    padded = np.pad(moving, BEST_SHIFT_PX)
    at = [
        (row, column, padded[row + BEST_SHIFT_PX :, column + BEST_SHIFT_PX :][:128, :128])
        for row in reach
        for column in reach
    ]
    overlaps = [int((shown.astype(np.int64) * fixed).sum()) for _, _, shown in at]
    best = max(overlaps)
    ties = [one for one, overlap in zip(at, overlaps, strict=True) if overlap == best]
    return min(ties, key=lambda one: one[0] ** 2 + one[1] ** 2)[2]


@pytest.mark.parametrize("tones", [1, 255])
def test_scores_are_those_of_scikit_image_to_a_millionth(tones: int) -> None:
    rng = np.random.default_rng(tones)
    for captured in marks(rng, 6, tones):
        predicted = marks(rng, 4, tones)
        out = np.empty((4, 2))
        compare(captured, predicted, 0, out)
        for found, image in zip(out, predicted, strict=True):
            assert found[0] == pytest.approx(csim(captured / 255.0, image / 255.0), abs=1e-9)
            assert found[1] == pytest.approx(ssim(captured / 255.0, image / 255.0), abs=1e-9)


@pytest.mark.parametrize("tones", [1, 255])
def test_the_best_shift_is_taken_before_scoring(tones: int) -> None:
    rng = np.random.default_rng(10 + tones)
    [captured] = marks(rng, 1, tones)
    predicted = np.stack([np.roll(captured, by, axis=(0, 1)) for by in ((0, 0), (3, -5), (-6, 6), (9, 0))])
    predicted = np.concatenate([predicted, marks(rng, 3, tones)])
    out = np.empty((len(predicted), 2))
    compare(captured, predicted, BEST_SHIFT_PX, out)
    for found, image in zip(out, predicted, strict=True):
        shifted = plainly_shifted(image, captured) / 255.0
        assert found[0] == pytest.approx(csim(captured / 255.0, shifted), abs=1e-9)
        assert found[1] == pytest.approx(ssim(captured / 255.0, shifted), abs=1e-9)
    assert out[3, 0] < out[2, 0] + 1e-9


def test_a_mark_inside_another_is_left_where_it_is_by_every_comparison() -> None:
    captured, predicted = np.zeros((128, 128), np.uint8), np.zeros((128, 128), np.uint8)
    captured[40:90, 20:110] = 255
    predicted[50:80, 30:100] = 255  # every shift of up to 6 px has the same overlap
    out = np.empty((1, 2))
    compare(captured, predicted[None], BEST_SHIFT_PX, out)
    a, b = (image.astype(np.float32) / 255 for image in (captured, predicted))
    assert similarity(a, b, Alignment.SIZE_NORMALISED) == pytest.approx(out[0], abs=1e-9)
    assert out[0, 1] == pytest.approx(ssim(a, b), abs=1e-9)


def test_a_blank_image_has_no_score() -> None:
    captured, blank = marks(np.random.default_rng(0), 1, 1)[0], np.zeros((1, 128, 128), np.uint8)
    for reach in (0, BEST_SHIFT_PX):
        out = np.zeros((1, 2))
        compare(captured, blank, reach, out)
        assert np.isnan(out).all()
        compare(blank[0], captured[None], reach, out)
        assert np.isnan(out).all()


def test_packed_images_come_back_and_anything_else_is_refused() -> None:
    images = marks(np.random.default_rng(1), 3, 255)
    assert np.array_equal(unpack(pack(images)), images)
    for bad in (b"", b"nonsense", pack(images)[:-3]):
        with pytest.raises(ValueError, match="packed images"):
            unpack(bad)


def test_it_is_compiled_once_for_every_kind_of_image(monkeypatch: pytest.MonkeyPatch) -> None:
    kinds = []
    monkeypatch.setattr(compiled, "_compare", lambda *images: kinds.append(tuple(map(numba.typeof, images[:2]))))
    image = np.full((128, 128), 255, np.uint8)
    read_only = np.frombuffer(image.tobytes(), np.uint8).reshape(image.shape)
    for captured in (image, image.T, image[::-1], read_only):
        compare(captured, np.stack([captured]), 0, np.empty((1, 2)))
    assert len(set(kinds)) == 1
