"""A lens from photographs of a board: real ones where they are, and every way in which a photograph is of no use."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
import pytest

from brushloop.calibrate.board.detect import BoardView, find_board
from brushloop.calibrate.board.intrinsics import LensFile, guidance
from brushloop.calibrate.board.intrinsics import fit_lens as fit
from brushloop.calibrate.board.lens import Lens
from brushloop.calibrate.board.spec import BoardSpec, Checkerboard, charuco_board
from brushloop.calibrate.errors import CalibrationError

DATA = Path(__file__).parents[4] / "shared" / "data" / "opencv_calib"
real = pytest.mark.skipif(not DATA.is_dir(), reason="OpenCV's real photographs of boards are not here")
CHECKERS = Checkerboard(inner_corners=(9, 6), square_mm=25.0)
CHARUCO = BoardSpec(squares=(5, 7), square_mm=40.0, marker_mm=20.0, dictionary="DICT_6X6_250", origin_mm=(0.0, 0.0))
TRUE = Lens(size_px=(640, 480), matrix=(800.0, 805.0, 322.0, 236.0), distortion=(-0.21, 0.06, 0.001, -0.0005, 0.0))


def checkers(square_px: int = 40, inner: tuple[int, int] = (9, 6)) -> np.ndarray:
    columns, rows = inner[0] + 1, inner[1] + 1
    board = (np.indices((rows, columns)).sum(axis=0) % 2 * 215 + 20).astype(np.uint8)
    picture = np.kron(board, np.ones((square_px, square_px), np.uint8))
    return cv2.copyMakeBorder(picture, 60, 60, 60, 60, cv2.BORDER_CONSTANT, value=235)


def charuco() -> np.ndarray:
    picture = charuco_board(CHARUCO, "test").generateImage((500, 700))
    return cv2.copyMakeBorder(picture, 50, 50, 50, 50, cv2.BORDER_CONSTANT, value=255)


def views(count: int, noise_px: float = 0.1, seed: int = 0, lens: Lens = TRUE) -> list[BoardView]:
    """Corners as a lens sees them, each by `noise_px` off."""
    rng = np.random.default_rng(seed)
    ids = np.arange(54)
    board = np.column_stack([ids % 9 + 1.0, ids // 9 + 1.0]) * 25.0
    made: list[BoardView] = []
    while len(made) < count:
        turn = np.array([rng.uniform(-0.6, 0.6), rng.uniform(-0.6, 0.6), rng.uniform(-3, 3)])
        place = np.array([rng.uniform(-220, 40), rng.uniform(-180, 40), rng.uniform(420, 700)])
        flat = np.column_stack([board, np.zeros(54)])
        pixels, _ = cv2.projectPoints(flat, turn, place, lens.camera, lens.coefficients)
        pixels = pixels.reshape(-1, 2)
        if pixels.min() > 0 and (pixels < TRUE.size_px).all():
            noisy = pixels + rng.normal(0, noise_px, pixels.shape)
            made.append(BoardView(f"{len(made)}.png", TRUE.size_px, noisy, board, ids))
    return made


def fit_lens(seen: Sequence[BoardView]) -> LensFile:
    return fit(seen, "a board", {"0.png": "ab"}, {})


def renamed(seen: Sequence[BoardView], stem: str) -> list[BoardView]:
    return [dataclasses.replace(view, name=f"{stem}{k:02d}.png") for k, view in enumerate(seen)]


def jogged(view: BoardView, name: str, noise_px: float = 0.1) -> BoardView:
    """Another photograph of a board that nobody moved."""
    noise = np.random.default_rng(9).normal(0, noise_px, view.pixels.shape)
    return dataclasses.replace(view, name=name, pixels=view.pixels + noise)


@pytest.fixture(scope="module")
def opencv() -> list[BoardView]:
    """OpenCV's 13 photographs by one camera."""
    return [find_board(cv2.imread(str(path), 0), CHECKERS, path.name) for path in sorted(DATA.glob("left[0-9]*.jpg"))]


@real
def test_opencvs_own_photographs_give_its_own_lens(opencv: list[BoardView]) -> None:
    fitted = fit_lens(opencv)
    assert fitted.focal_reach_px is not None
    assert fitted.focal_reach_px[0] < 3.0
    assert len(fitted.residuals_px) == 13
    assert fitted.rms_px <= 0.20
    assert fitted.lens.matrix[0] == pytest.approx(535.92, rel=0.01)
    assert (fitted.dropped, fitted.warnings) == ({}, ())


@real
def test_a_real_charuco_board_is_seen_whole() -> None:
    assert len(find_board(cv2.imread(str(DATA / "choriginal.jpg"), 0), CHARUCO, "photograph").ids) == 24


def test_views_given_again_do_not_make_a_lens_surer() -> None:
    seen = views(8)
    again = [*seen, *(jogged(view, f"again-{view.name}") for view in seen)]
    once, twice = fit_lens(seen), fit_lens(again)
    assert twice.focal_reach_px == pytest.approx(once.focal_reach_px, rel=1e-5)
    assert len(twice.residuals_px) == 8
    assert set(twice.unusable) == {f"again-{view.name}" for view in seen}


@pytest.mark.parametrize("slant", [0.0, 0.4], ids=["face on", "slanted alike"])
def test_a_board_that_is_always_held_alike_gives_no_lens(slant: float) -> None:
    rng, made = np.random.default_rng(3), list[BoardView]()
    for view in views(10):
        turn = np.array([slant, 0.0, 0.0]) + rng.normal(0, 0.01, 3)
        place = np.array([rng.uniform(-180, 0), rng.uniform(-150, 0), rng.uniform(450, 650)])
        flat = np.column_stack([view.board_mm, np.zeros(54)])
        pixels, _ = cv2.projectPoints(flat, turn, place, TRUE.camera, TRUE.coefficients)
        made.append(dataclasses.replace(view, pixels=pixels.reshape(-1, 2) + rng.normal(0, 0.1, (54, 2))))
    with pytest.raises(CalibrationError, match=r"10 usable views, but the board is held in \d ways, at least 4 needed"):
        fit_lens(made)


def test_an_interval_is_given_where_the_views_allow_it_and_then_holds_the_truth() -> None:
    few = fit_lens(views(5))
    assert few.focal_se_px is None
    assert few.focal_reach_px is None
    assert any("1 more way (5 so far): 6 are needed" in line for line in few.guidance)
    held = 0
    for seed in range(6):
        fitted = fit_lens(views(7, seed=seed))
        assert fitted.focal_reach_px is not None
        held += abs(fitted.lens.matrix[0] - TRUE.matrix[0]) <= fitted.focal_reach_px[0]
    assert held >= 5
    assert fitted.warnings == ()
    assert fitted.rms_px == pytest.approx(0.1 * 2**0.5, rel=0.1)
    corners = np.array([[10.0, 10.0], [630.0, 10.0], [320.0, 470.0]])
    assert fitted.lens.undistorted(corners) == pytest.approx(TRUE.undistorted(corners), abs=1.5)
    assert TRUE.distorted(TRUE.undistorted(corners)) == pytest.approx(corners, abs=1e-6)


def other_camera(f: float, x_px: float, y_px: float) -> Lens:
    """One like TRUE, its focal length f times as long, its axis this many px away."""
    fx, fy, cx, cy = TRUE.matrix
    return TRUE.model_copy(update={"matrix": (f * fx, f * fy, cx + x_px, cy + y_px)})


def test_photographs_of_two_cameras_that_differ_much_leave_a_residual_that_says_so() -> None:
    mixed = [*renamed(views(7), "left"), *renamed(views(7, seed=5, lens=other_camera(1.6, 0.0, 0.0)), "right")]
    [warning] = fit_lens(mixed).warnings
    assert "exceeds 0.5 px" in warning
    assert "of one camera" in warning


def test_a_view_that_does_not_fit_is_dropped_by_name() -> None:
    seen = views(10)
    bent = seen[4].pixels + np.random.default_rng(1).normal(0, 2.0, seen[4].pixels.shape)
    seen[4] = BoardView("bent.png", TRUE.size_px, bent, seen[4].board_mm, seen[4].ids)
    fitted = fit_lens(seen)
    assert list(fitted.dropped) == ["bent.png"]
    assert "bent.png" not in fitted.residuals_px
    assert fitted.lens.matrix[0] == pytest.approx(800.0, rel=0.005)


def test_it_says_what_else_to_photograph() -> None:
    one_corner = [view for view in views(60) if view.pixels.max(axis=0)[0] < 420][:5]
    message = " / ".join(fit_lens(one_corner).guidance)
    assert "take 5 more photographs" in message
    assert "right" in message
    assert guidance(views(40), [20.0] * 40) == ()


def test_too_few_photographs_or_mixed_sizes_are_refused() -> None:
    with pytest.raises(CalibrationError, match="3 usable views of the board, at least 4 needed"):
        fit_lens(views(3))
    mixed = views(5)
    mixed[0] = BoardView("big.png", (1280, 960), mixed[0].pixels, mixed[0].board_mm, mixed[0].ids)
    message = r"have several sizes, .*640 x 480 px: 1\.png, 2\.png, 3\.png, 4\.png; 1280 x 960 px: big\.png"
    with pytest.raises(CalibrationError, match=message):
        fit_lens(mixed)


@pytest.mark.parametrize(
    ("image", "board", "message"),
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
        (charuco(), CHARUCO.model_copy(update={"squares": (6, 7)}), "are not arranged as on this board"),
        (np.where(np.arange(520) > 240, 128, checkers()), CHECKERS, "no complete board"),
    ],
    ids=["blank", "blank charuco", "smaller", "larger", "two", "two charuco", "mirrored", "few", "many", "hidden"],
)
def test_a_photograph_of_no_use_is_refused_with_the_reason(image: np.ndarray, board: object, message: str) -> None:
    with pytest.raises(CalibrationError, match=message):
        find_board(image.astype(np.uint8), board, "photograph")


def test_what_is_seen_but_not_as_it_should_be_is_flagged() -> None:
    half = charuco()
    half[:, :240] = 128
    assert "partly hidden" in find_board(half, CHARUCO, "half").flags[0]
    bright = np.where(charuco() > 100, 255, 40).astype(np.uint8)
    assert "saturated" in find_board(bright, CHARUCO, "bright").flags[0]
