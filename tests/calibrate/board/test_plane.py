"""Scale, plane, masks and anchors held against what is really there, and the board as it is printed."""

from __future__ import annotations

import itertools
import re
from pathlib import Path

import cv2
import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg
from pydantic import ValidationError

from brushloop.calibrate.board.detect import find_board
from brushloop.calibrate.board.lens import apply, unknown_lens
from brushloop.calibrate.board.pix2len import Plane, fit_plane, local_scale, paper_mm
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
from brushloop.calibrate.stroke import PX_PER_MM as RASTER_PX_PER_MM
from brushloop.calibrate.stroke import prepare, rectify_by
from tests.calibrate.simulated_rigs import CAMERAS, Shot, boards, sheet, true_mask, true_scale

SPEC = BoardSpec(squares=(7, 5), square_mm=20.0, marker_mm=15.0, dictionary="DICT_5X5_50", origin_mm=(-10.0, 5.0))
PLACES = np.array([[200.0, 150.0], [650.0, 150.0], [450.0, 300.0], [200.0, 420.0]])
PX_PER_MM = 8


@pytest.fixture(scope="module")
def seen() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Corners of the board seen at a slant, px and mm, and the homography from the image to the paper."""
    picture = charuco_board(SPEC, "test").generateImage((7 * 160, 5 * 160))
    picture = cv2.copyMakeBorder(picture, 40, 40, 40, 40, cv2.BORDER_CONSTANT, value=255)
    left_mm, top_mm, step = SPEC.origin_mm[0], SPEC.origin_mm[1] + 100.0, 1.0 / PX_PER_MM
    to_paper = np.array([[step, 0, left_mm - 39.5 * step], [0, -step, top_mm + 39.5 * step], [0, 0, 1]])
    slant = np.array([[0.62, 0.03, 30.0], [-0.02, 0.6, 40.0], [1e-5, 4e-5, 1.0]])
    image = cv2.warpPerspective(picture, slant, (900, 640), flags=cv2.INTER_AREA, borderValue=255)
    noisy = cv2.GaussianBlur(image, (0, 0), 0.8) + np.random.default_rng(0).normal(0, 2.0, image.shape)
    view = find_board(np.clip(noisy, 0, 255).astype(np.uint8), SPEC, "photo")
    return view.pixels, paper_mm(view, SPEC), to_paper @ np.linalg.inv(slant)


def flat(pixels: np.ndarray, paper: np.ndarray) -> Plane:
    return fit_plane(pixels, paper, unknown_lens((900, 640)), "photo", radial_terms=0)


def test_the_plane_is_found_to_hundredths_of_a_millimetre_and_its_scale_lies_in_a_narrow_interval(seen) -> None:
    pixels, paper, truth = seen
    plane = flat(pixels, paper)
    assert plane.corners == 24
    assert apply(plane.homography, PLACES) == pytest.approx(apply(truth, PLACES), abs=0.02)
    assert plane.mm_per_px_low < plane.mm_per_px < plane.mm_per_px_high
    assert plane.mm_per_px_high - plane.mm_per_px_low < 1e-3 * plane.mm_per_px
    assert plane.mm_per_px == pytest.approx(local_scale(lambda at: apply(truth, at), pixels.mean(axis=0)), rel=5e-4)


def test_a_misnamed_corner_is_dropped_and_corners_on_no_plane_are_refused(seen) -> None:
    pixels, paper, truth = seen
    misnamed = pixels.copy()
    misnamed[3] += (7.0, -5.0)
    plane = flat(misnamed, paper)
    assert (plane.corners, plane.corners_dropped) == (23, 1)
    assert apply(plane.homography, PLACES) == pytest.approx(apply(truth, PLACES), abs=0.03)
    with pytest.raises(CalibrationError, match="residual"):
        flat(pixels + np.random.default_rng(1).normal(0, 4, pixels.shape), paper)


@pytest.mark.parametrize(
    ("change", "words"),
    [({"dictionary": "DICT_NONE"}, "not one of OpenCV's"), ({"marker_mm": 20.0}, "must be less than")],
)
def test_a_board_that_cannot_be_is_refused(change: dict[str, object], words: str) -> None:
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
    assert len(view.ids) in (24, 35)
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


def plane_of(shot: Shot) -> Plane:
    """The plane by a lens of which nothing is known."""
    view = find_board(shot.image, shot.board, "rig")
    return fit_plane(view.pixels, paper_mm(view, shot.board), unknown_lens(view.size_px), "rig")


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
    assert (mask & truth).sum() / (mask | truth).sum() >= 0.95


@pytest.mark.soak
@pytest.mark.timeout(1800)
@pytest.mark.parametrize("seed", [0, 1])
def test_the_interval_of_pix2len_holds_the_truth_as_often_as_it_says(seed: int) -> None:
    held: list[bool] = []
    for shot in itertools.chain.from_iterable(boards(rig, 40, seed) for rig in range(len(CAMERAS))):
        plane = plane_of(shot)
        truth = true_scale(shot, plane.middle_px)
        assert plane.mm_per_px == pytest.approx(truth, rel=WORST)
        held.append(plane.mm_per_px_low <= truth <= plane.mm_per_px_high)
    assert 0.93 <= np.mean(held) <= 0.97
