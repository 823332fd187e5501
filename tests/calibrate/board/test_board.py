"""The board as it is printed, a lens from photographs of it, and the plane, held against what is really there."""

from __future__ import annotations

import dataclasses
import itertools
import re
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg
from pydantic import ValidationError

from brushloop.calibrate.board.detect import BoardView, find_board
from brushloop.calibrate.board.lens import Lens, LensFile, guidance, unknown_lens
from brushloop.calibrate.board.lens import fit_lens as fit
from brushloop.calibrate.board.pix2len import Plane, fit_plane, paper_mm
from brushloop.calibrate.board.spec import (
    MM_PER_INCH,
    Board,
    BoardSpec,
    Checkerboard,
    charuco_board,
    drawn,
    print_board,
)
from brushloop.calibrate.commands import PrintRequest
from brushloop.calibrate.compare import field_around
from brushloop.calibrate.errors import CalibrationError
from brushloop.calibrate.stroke.preprocess import PX_PER_MM as RASTER_PX_PER_MM
from brushloop.calibrate.stroke.preprocess import prepare, rectify_by
from tests.calibrate.given import iou
from tests.calibrate.simulated_rigs import CAMERAS, Shot, boards, sheet, true_mask, true_scale
from tests.command import refused

DATA = Path(__file__).parents[4] / "shared" / "data" / "opencv_calib"
real = pytest.mark.skipif(not DATA.is_dir(), reason="OpenCV's real photographs of boards are not here")
CHECKERS = Checkerboard(inner_corners=(9, 6), square_mm=25.0)
CHARUCO = BoardSpec(squares=(5, 7), square_mm=40.0, marker_mm=20.0, dictionary="DICT_6X6_250", origin_mm=(0.0, 0.0))
TRUE = Lens(size_px=(640, 480), matrix=(800.0, 805.0, 322.0, 236.0), distortion=(-0.21, 0.06, 0.001, -0.0005, 0.0))
LONG = TRUE.model_copy(update={"matrix": (1280.0, 1288.0, 322.0, 236.0)})
"""The lens of another camera."""
BOARD_MM = np.column_stack([np.arange(54) % 9 + 1.0, np.arange(54) // 9 + 1.0]) * 25.0


def checkers(square_px: int = 40) -> np.ndarray:
    board = (np.indices((7, 10)).sum(axis=0) % 2 * 215 + 20).astype(np.uint8)
    picture = np.kron(board, np.ones((square_px, square_px), np.uint8))
    return cv2.copyMakeBorder(picture, 60, 60, 60, 60, cv2.BORDER_CONSTANT, value=235)


def charuco() -> np.ndarray:
    picture = charuco_board(CHARUCO, "test").generateImage((500, 700))
    return cv2.copyMakeBorder(picture, 50, 50, 50, 50, cv2.BORDER_CONSTANT, value=255)


def view(name: str, turn: Sequence[float], place: Sequence[float], noise: np.ndarray, lens: Lens = TRUE) -> BoardView:
    """Corners as a lens sees them, each off by its noise (54, 2) px."""
    flat = np.column_stack([BOARD_MM, np.zeros(54)])
    pixels, _ = cv2.projectPoints(flat, np.array(turn), np.array(place), lens.camera, np.array(lens.distortion))
    return BoardView(name, TRUE.size_px, pixels.reshape(-1, 2) + noise, BOARD_MM)


def views(count: int, noise_px: float = 0.1, seed: int = 0, lens: Lens = TRUE) -> list[BoardView]:
    """Boards held in many ways, all in the picture."""
    rng, made = np.random.default_rng(seed), list[BoardView]()
    while len(made) < count:
        turn = rng.uniform([-0.6, -0.6, -3], [0.6, 0.6, 3])
        place = rng.uniform([-220, -180, 420], [40, 40, 700])
        seen = view(f"{len(made)}.png", turn, place, rng.normal(0, noise_px, (54, 2)), lens)
        if seen.pixels.min() > 1 and (seen.pixels < np.array(TRUE.size_px) - 1).all():
            made.append(seen)
    return made


def renamed(seen: Sequence[BoardView], stem: str) -> list[BoardView]:
    return [dataclasses.replace(one, name=f"{stem}{one.name}") for one in seen]


def fit_lens(seen: Sequence[BoardView]) -> LensFile:
    return fit(seen, "a board", {"0.png": "ab"}, {})


@real
def test_opencvs_own_photographs_give_its_own_lens() -> None:
    """OpenCV's 13 photographs by one camera."""
    paths = sorted(DATA.glob("left[0-9]*.jpg"))
    fitted = fit_lens([find_board(cv2.imread(str(path), 0), CHECKERS, path.name) for path in paths])
    assert len(fitted.residuals_px) == 13
    assert fitted.rms_px <= 0.20
    assert fitted.lens.matrix[0] == pytest.approx(535.92, rel=0.01)
    assert (fitted.dropped, fitted.warnings) == ({}, ())
    assert len(find_board(cv2.imread(str(DATA / "choriginal.jpg"), 0), CHARUCO, "photograph").pixels) == 24


@pytest.mark.parametrize("slant", [0.0, 0.4], ids=["face on", "slanted alike"])
def test_a_board_that_is_always_held_alike_gives_no_lens(slant: float) -> None:
    rng, alike = np.random.default_rng(3), list[BoardView]()
    for k in range(10):
        turn, place = np.array([slant, 0, 0]) + rng.normal(0, 0.01, 3), rng.uniform([-180, -150, 450], [0, 0, 650])
        alike.append(view(f"{k}.png", turn, place, rng.normal(0, 0.1, (54, 2))))
    with pytest.raises(CalibrationError, match=r"10 usable views; different angles of the board: \d, at least 4"):
        fit_lens(alike)


def test_the_lens_is_found_and_its_distortion_undone() -> None:
    fitted = fit_lens(views(12))
    assert fitted.warnings == ()
    assert fitted.rms_px == pytest.approx(0.1 * 2**0.5, rel=0.1)
    corners = np.array([[10.0, 10.0], [630.0, 10.0], [320.0, 470.0]])
    assert fitted.lens.undistorted(corners) == pytest.approx(TRUE.undistorted(corners), abs=1.5)
    assert TRUE.distorted(TRUE.undistorted(corners)) == pytest.approx(corners, abs=1e-6)


def test_photographs_that_do_not_fit_are_dropped_by_name_or_leave_a_residual_that_says_so() -> None:
    seen = views(10)
    off_px = np.random.default_rng(1).normal(0, 2, (54, 2))
    seen[4] = dataclasses.replace(seen[4], name="bent.png", pixels=seen[4].pixels + off_px)
    fitted = fit_lens(seen)
    assert list(fitted.dropped) == ["bent.png"]
    assert "bent.png" not in fitted.residuals_px
    assert fitted.lens.matrix[0] == pytest.approx(800.0, rel=0.005)
    [warning] = fit_lens([*renamed(views(7), "left"), *renamed(views(7, seed=1, lens=LONG), "right")]).warnings
    assert "exceeds 0.5 px" in warning
    assert "only one camera" in warning


def test_it_says_what_else_to_photograph() -> None:
    one_corner = [one for one in views(60) if one.pixels.max(axis=0)[0] < 420][:5]
    lens = fit_lens([*one_corner, *renamed(one_corner, "again-")])
    assert lens.ways == 5, "a view given again is no other way to hold the board"
    message = " / ".join((*lens.guidance, *fit_lens(one_corner).guidance))
    assert "more different angles (5 of 6 so far)" in message
    assert "take more photographs (5 of" in message
    assert "right" in message
    assert guidance(views(40), [20.0] * 40) == ()


def test_photographs_of_mixed_sizes_are_refused() -> None:
    mixed = views(5)
    mixed[0] = dataclasses.replace(mixed[0], name="big.png", size_px=(1280, 960))
    message = r"have several sizes, .*: big\.png is 1280 x 960 px, 1\.png is 640 x 480 px"
    with pytest.raises(CalibrationError, match=message):
        fit_lens(mixed)


@pytest.mark.parametrize(
    ("image", "board", "message"),
    [
        (np.full((480, 640), 235, np.uint8), CHECKERS, "is blank"),
        (np.full((480, 640), 255, np.uint8), CHARUCO, "is blank"),
        (checkers(), Checkerboard(inner_corners=(8, 6), square_mm=25.0), "shows .*9 x 6 inner corners, not 8 x 6"),
        (checkers(), Checkerboard(inner_corners=(9, 7), square_mm=25.0), "shows .*9 x 6 inner corners, not 9 x 7"),
        (np.hstack([charuco(), charuco()]), CHARUCO, "two boards"),
        (np.ascontiguousarray(charuco()[:, ::-1]), CHARUCO, "mirrored"),
        (charuco(), CHARUCO.model_copy(update={"squares": (4, 5)}), "another board"),
        (charuco(), CHARUCO.model_copy(update={"squares": (6, 7)}), "are not arranged as on this board"),
        (np.where(np.arange(520) > 240, 128, checkers()), CHECKERS, "no complete board"),
    ],
    ids=["blank", "blank charuco", "smaller", "larger", "two charuco", "mirrored", "few", "many", "hidden"],
)
def test_a_photograph_of_no_use_is_refused_with_the_reason(image: np.ndarray, board: object, message: str) -> None:
    with pytest.raises(CalibrationError, match=message):
        find_board(image.astype(np.uint8), board, "photograph")


def test_a_board_that_is_too_bright_is_flagged() -> None:
    bright = np.where(charuco() > 100, 255, 40).astype(np.uint8)
    assert "saturated" in find_board(bright, CHARUCO, "bright").flags[0]


def test_the_command_says_of_every_photograph_why_it_was_of_no_use(tmp_path: Path) -> None:
    blank, mirrored, torn = (tmp_path / name for name in ("blank.png", "mirrored.png", "torn.png"))
    cv2.imwrite(str(blank), np.full((480, 640), 235, np.uint8))
    cv2.imwrite(str(mirrored), np.ascontiguousarray(charuco()[:, ::-1]))
    torn.write_bytes(blank.read_bytes()[:100])
    board = ("--charuco", "5x7", "--square-mm", "40", "--marker-mm", "20", "--dictionary", "DICT_6X6_250")

    def refusal(*photographs: Path, options: Sequence[str] = board) -> str:
        why = refused("camera", "intrinsics", *photographs, *options, "--out", tmp_path / "out")
        assert not (tmp_path / "out").exists()
        return why

    why = refusal(blank, mirrored)
    assert why.startswith(f"2 photographs: 0 usable views of the board, at least 4 needed; {blank}: is blank")
    assert f"{mirrored}: the photograph is mirrored" in why
    assert "not a complete PNG or JPEG" in refusal(torn)
    assert "inner_corners.1: Field required" in refusal(blank, options=("--checkerboard", "9"))
    assert "give either --checkerboard" in refusal(blank, options=())


# The printed board

SPEC = BoardSpec(squares=(7, 5), square_mm=20.0, marker_mm=15.0, dictionary="DICT_5X5_50", origin_mm=(-10.0, 5.0))
PX_PER_MM = 8


def test_a_board_that_cannot_be_is_refused() -> None:
    for change, words in (({"dictionary": "DICT_NONE"}, "not one of OpenCV's"), ({"marker_mm": 20.0}, "must be less")):
        with pytest.raises(ValidationError, match=words):
            BoardSpec.model_validate(SPEC.model_dump() | change)


def printed(board: Board) -> np.ndarray:
    """The page as a printer lays it down at 8 px/mm."""
    canvas = FigureCanvasAgg(drawn(board, "a4"))
    canvas.figure.set_dpi(PX_PER_MM * MM_PER_INCH)
    canvas.draw()
    return np.ascontiguousarray(np.asarray(canvas.buffer_rgba())[..., 0])


@pytest.mark.parametrize("board", [SPEC, Checkerboard(inner_corners=(7, 5), square_mm=20.0)], ids=["charuco", "plain"])
def test_a_printed_board_is_seen_whole_and_at_true_scale(board: Board) -> None:
    view = find_board(printed(board), board, "print")
    assert len(view.pixels) in (24, 35)
    assert np.polyfit(view.board_mm[:, 0], view.pixels[:, 0], 1)[0] == pytest.approx(PX_PER_MM, rel=1e-4)
    [words] = drawn(board, "a4").texts
    assert "of 20 mm" in words.get_text()
    assert "Print at 100 %: the board is" in words.get_text()


def test_a_page_is_a4_holds_its_board_and_overwrites_nothing_but_a_pdf(tmp_path: Path) -> None:
    def written(name: str, charuco: str = "7x5") -> bytes:
        request = PrintRequest(charuco=charuco, square_mm=12.0, out=tmp_path / name)
        return print_board(request).path.read_bytes()

    data = written("board.pdf")
    points = [float(v) for v in re.search(rb"MediaBox \[ *0 0 ([\d.]+) ([\d.]+) *\]", data).groups()]
    assert np.array(points) / 72.0 * MM_PER_INCH == pytest.approx([210.0, 297.0])
    assert written("board.pdf") == data
    recording = tmp_path / "s.pdf"
    recording.write_bytes(b"\x89MCAP0\r\n")
    for name, charuco, why in (
        ("x.pdf", "26x20", "has no room for a board of 312 x 240 mm"),
        ("s.mcap", "7x5", "must end in .pdf"),
        ("no/board.pdf", "7x5", "there is no folder"),
        ("s.pdf", "7x5", "is not a PDF; it is not overwritten"),
    ):
        with pytest.raises(CalibrationError, match=why):
            written(name, charuco)
    assert recording.read_bytes() == b"\x89MCAP0\r\n"
    assert not (tmp_path / "x.pdf").exists()


# The frozen brushes and cameras of the loopback rig, held against the sheet itself

WORST = 2e-4


def plane_of(shot: Shot, off_px: np.ndarray | float = 0.0) -> Plane:
    """The plane by a lens of which nothing is known, from corners that are each off by so much."""
    view = find_board(shot.image, shot.board, "rig")
    return fit_plane(view.pixels + off_px, paper_mm(view, shot.board), unknown_lens(view.size_px), "rig")


@pytest.mark.parametrize("rig", [1, 2, 3], ids=["keystone", "shadow and pincushion", "barrel"])
def test_scale_strokes_and_anchors_are_right_whatever_the_camera_does(rig: int) -> None:
    shot = sheet(rig, 1)
    plane, [anchor] = plane_of(shot), shot.anchors_mm
    assert plane.mm_per_px == pytest.approx(true_scale(shot, plane.middle_px), rel=WORST)
    assert plane.to_paper(shot.optics.image_of(np.array([anchor]))) == pytest.approx(np.array([anchor]), abs=0.1)
    window = field_around(anchor)
    raster = rectify_by(shot.image, plane, window, "rig")
    at = ((anchor[0] - window[0]) * RASTER_PX_PER_MM, (window[1] + window[3] - anchor[1]) * RASTER_PX_PER_MM)
    mask, truth = prepare(raster, at, "rig").mask, true_mask(shot, window, RASTER_PX_PER_MM)
    assert iou(mask, truth) >= 0.95


def test_a_misnamed_corner_is_dropped_and_corners_on_no_plane_are_refused() -> None:
    [shot] = boards(1, 1)
    seen = plane_of(shot)
    noise_px = np.random.default_rng(1).normal(0, 4, (seen.corners + seen.corners_dropped, 2))
    misnamed_px = np.zeros_like(noise_px)
    misnamed_px[3] = (7.0, -5.0)
    plane = plane_of(shot, misnamed_px)
    assert (plane.corners, plane.corners_dropped) == (seen.corners - 1, seen.corners_dropped + 1)
    assert plane.mm_per_px == pytest.approx(true_scale(shot, plane.middle_px), rel=WORST)
    with pytest.raises(CalibrationError, match="residual"):
        plane_of(shot, noise_px)


@pytest.mark.soak
@pytest.mark.timeout(1800)
def test_the_interval_of_pix2len_holds_the_truth_as_often_as_it_says() -> None:
    held: list[bool] = []
    rigs = itertools.product(range(len(CAMERAS)), (0, 1))  # two seeds: of 400 boards, 1 % is one standard error
    for shot in itertools.chain.from_iterable(boards(rig, 40, seed) for rig, seed in rigs):
        plane = plane_of(shot)
        truth = true_scale(shot, plane.middle_px)
        assert plane.mm_per_px == pytest.approx(truth, rel=WORST)
        held.append(plane.mm_per_px_low <= truth <= plane.mm_per_px_high)
    assert 0.93 <= np.mean(held) <= 0.97
