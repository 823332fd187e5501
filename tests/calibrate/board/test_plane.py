"""Scale and plane from a board whose truth is known."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from pydantic import ValidationError

from brushloop.calibrate.board.detect import find_board
from brushloop.calibrate.board.lens import unknown_lens
from brushloop.calibrate.board.pix2len import Plane, apply, distorted_share, fit_plane, local_scale
from brushloop.calibrate.board.spec import BoardSpec
from brushloop.calibrate.board.view import DISTORTED_SHARE, paper_mm, see_board
from brushloop.calibrate.errors import CalibrationError

SPEC = BoardSpec(squares=(7, 5), square_mm=20.0, marker_mm=15.0, dictionary="DICT_5X5_50", origin_mm=(-10.0, 5.0))


def photograph(spec: BoardSpec = SPEC, noise: float = 2.0) -> tuple[np.ndarray, np.ndarray]:
    """(image, image -> paper homography) of the board seen at a slant."""
    scale = 8.0
    size = (round(spec.squares[0] * spec.square_mm * scale), round(spec.squares[1] * spec.square_mm * scale))
    dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, spec.dictionary))
    board = cv2.aruco.CharucoBoard(spec.squares, spec.square_mm, spec.marker_mm, dictionary)
    picture = cv2.copyMakeBorder(board.generateImage(size), 40, 40, 40, 40, cv2.BORDER_CONSTANT, value=255)
    top_mm = spec.origin_mm[1] + spec.squares[1] * spec.square_mm
    picture_to_paper = np.array(
        [
            [1 / scale, 0, spec.origin_mm[0] + (0.5 - 40) / scale],
            [0, -1 / scale, top_mm - (0.5 - 40) / scale],
            [0, 0, 1],
        ]
    )
    slant = np.array([[0.62, 0.03, 30.0], [-0.02, 0.6, 40.0], [1e-5, 4e-5, 1.0]])
    image = cv2.warpPerspective(picture, slant, (900, 640), flags=cv2.INTER_AREA, borderValue=255)
    noisy = cv2.GaussianBlur(image, (0, 0), 0.8) + np.random.default_rng(0).normal(0, noise, image.shape)
    return np.clip(noisy, 0, 255).astype(np.uint8), picture_to_paper @ np.linalg.inv(slant)


def corners_of(image: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    view = find_board(image, SPEC, "photo")
    return view.pixels, paper_mm(view, SPEC)


def flat(pixels: np.ndarray, paper: np.ndarray) -> Plane:
    return fit_plane(pixels, paper, unknown_lens((900, 640)), "photo", radial_terms=0)


def test_the_plane_is_found_to_hundredths_of_a_millimetre() -> None:
    image, truth = photograph()
    plane = see_board(image, SPEC)
    assert plane.corners == 24
    points = np.array([[200.0, 150.0], [650.0, 150.0], [450.0, 300.0], [200.0, 420.0]])
    assert apply(plane.image_to_paper, points) == pytest.approx(apply(truth, points), abs=0.02)


def test_the_scale_is_within_its_interval_and_that_is_narrow() -> None:
    image, truth = photograph()
    pixels, paper = corners_of(image)
    plane = flat(pixels, paper)
    low, high = plane.interval_mm_per_px
    assert low < plane.mm_per_px < high
    assert high - low < 1e-3 * plane.mm_per_px
    assert plane.mm_per_px == pytest.approx(local_scale(lambda at: apply(truth, at), pixels.mean(axis=0)), rel=5e-4)


def test_a_misnamed_corner_is_dropped_and_counted() -> None:
    image, truth = photograph()
    pixels, paper = corners_of(image)
    pixels[3] += (7.0, -5.0)
    plane = flat(pixels, paper)
    assert (plane.corners, plane.dropped) == (23, (3,))
    points = np.array([[200.0, 150.0], [650.0, 420.0]])
    assert apply(plane.image_to_paper, points) == pytest.approx(apply(truth, points), abs=0.03)


def test_corners_that_do_not_fit_one_plane_are_refused() -> None:
    image, _ = photograph()
    pixels, paper = corners_of(image)
    with pytest.raises(CalibrationError, match="residual"):
        flat(pixels + np.random.default_rng(1).normal(0, 4, pixels.shape), paper)


@pytest.mark.parametrize(
    ("change", "words"),
    [({"dictionary": "DICT_NONE"}, "not one of OpenCV's"), ({"marker_mm": 20.0}, "must be less than")],
)
def test_a_board_that_cannot_be_is_refused(change: dict[str, object], words: str) -> None:
    with pytest.raises(ValidationError, match=words):
        BoardSpec.model_validate(SPEC.model_dump() | change)


def test_a_lens_is_distinguished_from_a_board_that_is_curled_misread_or_noisy() -> None:
    grid = np.array([(x, y) for x in range(0, 281, 20) for y in range(0, 201, 20)], np.float64)
    ring = (grid[:, 0] < 40) | (grid[:, 0] > 240) | (grid[:, 1] < 40) | (grid[:, 1] > 160)
    paper, middle = grid[ring], np.array([640.0, 480.0])
    pixels = middle + 4.0 * (paper - np.array([140.0, 100.0])) * np.array([1.0, -1.0])
    away = (pixels - middle) / 1280.0
    r2 = (away**2).sum(axis=1, keepdims=True)
    bent = middle + 1280.0 * away * (1.0 - 0.1 * r2)
    curled = middle + 1280.0 * away * (1.0 + 0.1 * away[:, :1] ** 2)
    noisy = pixels + np.random.default_rng(3).normal(0.0, 3.0, pixels.shape)
    lens = unknown_lens((1281, 961))
    assert distorted_share(bent, paper, lens, "lens") > 0.99 > DISTORTED_SHARE
    assert distorted_share(curled, paper, lens, "board") < DISTORTED_SHARE
    assert distorted_share(noisy, paper, lens, "noise") < 0.1
