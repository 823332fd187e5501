"""A lens from photographs of a board: real ones where they are, and every way in which a photograph is of no use."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from calibrate.artefact import load_artefact
from calibrate.camera.artefact import LensFile, lens_file
from calibrate.camera.boards import Checkerboard, View, see
from calibrate.camera.intrinsics import fit_lens
from calibrate.camera.lens import Lens
from calibrate.errors import CalibrationError
from calibrate.scale import BoardSpec, charuco_board

DATA = Path(__file__).parents[4] / "shared" / "data" / "opencv_calib"
real = pytest.mark.skipif(not DATA.is_dir(), reason="OpenCV's real photographs of boards are not here")
CHECKERS = Checkerboard(inner_corners=(9, 6), square_mm=25.0)
CHARUCO = BoardSpec(squares=(5, 7), square_mm=40.0, marker_mm=20.0, dictionary="DICT_6X6_250", origin_mm=(0.0, 0.0))
TRUE = Lens(
    np.array([[800.0, 0.0, 322.0], [0.0, 805.0, 236.0], [0.0, 0.0, 1.0]]),
    np.array([-0.21, 0.06, 0.001, -0.0005, 0.0]),
    (640, 480),
)


def checkers(square_px: int = 40, inner: tuple[int, int] = (9, 6)) -> np.ndarray:
    columns, rows = inner[0] + 1, inner[1] + 1
    board = (np.indices((rows, columns)).sum(axis=0) % 2 * 215 + 20).astype(np.uint8)
    picture = np.kron(board, np.ones((square_px, square_px), np.uint8))
    return cv2.copyMakeBorder(picture, 60, 60, 60, 60, cv2.BORDER_CONSTANT, value=235)


def charuco() -> np.ndarray:
    picture = charuco_board(CHARUCO, "test").generateImage((500, 700))
    return cv2.copyMakeBorder(picture, 50, 50, 50, 50, cv2.BORDER_CONSTANT, value=255)


def views(count: int, noise_px: float = 0.1, seed: int = 0) -> list[View]:
    """Corners as `TRUE` sees them, each by `noise_px` off."""
    rng = np.random.default_rng(seed)
    ids = np.arange(54)
    board = np.column_stack([ids % 9 + 1.0, ids // 9 + 1.0]) * 25.0
    made: list[View] = []
    while len(made) < count:
        turn = np.array([rng.uniform(-0.6, 0.6), rng.uniform(-0.6, 0.6), rng.uniform(-3, 3)])
        place = np.array([rng.uniform(-220, 40), rng.uniform(-180, 40), rng.uniform(420, 700)])
        flat = np.column_stack([board, np.zeros(54)])
        pixels, _ = cv2.projectPoints(flat, turn, place, TRUE.matrix, TRUE.distortion)
        pixels = pixels.reshape(-1, 2)
        if pixels.min() > 0 and (pixels < TRUE.size_px).all():
            noisy = pixels + rng.normal(0, noise_px, pixels.shape)
            made.append(View(f"{len(made)}.png", TRUE.size_px, noisy, board, ids))
    return made


@real
def test_opencvs_own_photographs_give_its_own_lens() -> None:
    seen = [see(cv2.imread(str(path), 0), CHECKERS, path.name) for path in sorted(DATA.glob("left[0-9]*.jpg"))]
    fitted = fit_lens(seen)
    assert len(fitted.residuals_px) == 13
    assert fitted.rms_px <= 0.20
    assert fitted.lens.matrix[0, 0] == pytest.approx(535.92, rel=0.01)
    assert (fitted.dropped, fitted.warnings) == ({}, ())


@real
def test_a_real_charuco_board_is_seen_whole() -> None:
    assert len(see(cv2.imread(str(DATA / "choriginal.jpg"), 0), CHARUCO, "photograph").ids) == 24


def test_a_known_lens_is_found_within_its_standard_errors() -> None:
    fitted = fit_lens(views(12))
    for k in (0, 1):
        assert abs(fitted.lens.matrix[k, k] - TRUE.matrix[k, k]) < 4 * fitted.focal_se_px[k]
    assert fitted.rms_px == pytest.approx(0.1 * 2**0.5, rel=0.1)
    corners = np.array([[10.0, 10.0], [630.0, 10.0], [320.0, 470.0]])
    assert fitted.lens.straight(corners) == pytest.approx(TRUE.straight(corners), abs=1.5)
    assert TRUE.bent(TRUE.straight(corners)) == pytest.approx(corners, abs=1e-6)


def test_a_view_that_does_not_fit_is_dropped_by_name() -> None:
    seen = views(10)
    bent = seen[4].pixels + np.random.default_rng(1).normal(0, 2.0, seen[4].pixels.shape)
    seen[4] = View("bent.png", TRUE.size_px, bent, seen[4].board_mm, seen[4].ids)
    fitted = fit_lens(seen)
    assert list(fitted.dropped) == ["bent.png"]
    assert "bent.png" not in fitted.residuals_px
    assert fitted.lens.matrix[0, 0] == pytest.approx(800.0, rel=0.005)


def test_bad_residuals_warn_before_a_session_begins() -> None:
    assert fit_lens(views(12)).warnings == ()
    [warning] = fit_lens(views(12, noise_px=0.8)).warnings
    assert "exceeds 0.5 px" in warning


def test_it_says_what_to_photograph_besides() -> None:
    one_corner = [view for view in views(60) if view.pixels.max(axis=0)[0] < 420][:5]
    told = " / ".join(fit_lens(one_corner).guidance)
    assert "take 5 more photographs" in told
    assert "right" in told
    assert fit_lens(views(40)).guidance == ()


def test_too_few_photographs_or_mixed_sizes_are_refused() -> None:
    with pytest.raises(CalibrationError, match="3 usable views of the board, at least 4 needed"):
        fit_lens(views(3))
    mixed = views(5)
    mixed[0] = View("big.png", (1280, 960), mixed[0].pixels, mixed[0].board_mm, mixed[0].ids)
    with pytest.raises(CalibrationError, match="640 x 480, 1280 x 960"):
        fit_lens(mixed)


@pytest.mark.parametrize(
    ("image", "board", "told"),
    [
        (np.full((480, 640), 235, np.uint8), CHECKERS, "is blank"),
        (np.full((480, 640), 255, np.uint8), CHARUCO, "is blank"),
        (
            checkers(),
            Checkerboard(inner_corners=(8, 6), square_mm=25.0),
            "9 x 6 inner corners, not 8 x 6|more than 8 x 6 inner corners",
        ),
        (checkers(), Checkerboard(inner_corners=(9, 7), square_mm=25.0), "shows .*9 x 6 inner corners, not 9 x 7"),
        (np.hstack([checkers(30), checkers(30)]), CHECKERS, "two boards"),
        (np.hstack([charuco(), charuco()]), CHARUCO, "two boards"),
        (np.ascontiguousarray(charuco()[:, ::-1]), CHARUCO, "mirrored"),
        (charuco(), CHARUCO.model_copy(update={"squares": (4, 5)}), "another board"),
        (charuco(), CHARUCO.model_copy(update={"squares": (6, 7)}), "do not lie as this board has them"),
        (np.where(np.arange(520) > 240, 128, checkers()), CHECKERS, "no whole board"),
    ],
    ids=["blank", "blank charuco", "smaller", "larger", "two", "two charuco", "mirrored", "few", "many", "hidden"],
)
def test_a_photograph_of_no_use_is_refused_with_the_reason(image: np.ndarray, board: object, told: str) -> None:
    with pytest.raises(CalibrationError, match=told):
        see(image.astype(np.uint8), board, "photograph")


def test_what_is_seen_but_not_as_it_should_be_is_flagged() -> None:
    half = charuco()
    half[:, :240] = 128
    assert "partly hidden" in see(half, CHARUCO, "half").flags[0]
    bright = np.where(charuco() > 100, 255, 40).astype(np.uint8)
    assert "saturated" in see(bright, CHARUCO, "bright").flags[0]


def test_a_lens_file_cannot_be_edited(tmp_path: Path) -> None:
    path = lens_file(fit_lens(views(8)), "a board", {"0.png": "ab"}, {}, 0.5, "test").save(tmp_path)
    assert load_artefact(path, LensFile).lens().matrix[0, 0] == pytest.approx(800.0, rel=0.01)
    path.write_text(path.read_text().replace('"a board"', '"another"'))
    with pytest.raises(CalibrationError, match="was edited"):
        load_artefact(path, LensFile)
