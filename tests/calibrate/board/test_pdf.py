"""The printable board: what is black in it is OpenCV's board at true scale."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg

from brushloop.calibrate.board.detect import find_board
from brushloop.calibrate.board.spec import MM_PER_INCH, Board, BoardSpec, Checkerboard, drawn, write_pdf
from brushloop.calibrate.errors import CalibrationError

BOARD = BoardSpec(squares=(7, 5), square_mm=25.0, marker_mm=18.0, dictionary="DICT_5X5_50", origin_mm=(0.0, 0.0))
PX_PER_MM = 8


def printed(board: Board) -> np.ndarray:
    """The page as a printer lays it down at 8 px/mm."""
    canvas = FigureCanvasAgg(drawn(board, "a4"))
    canvas.figure.set_dpi(PX_PER_MM * MM_PER_INCH)
    canvas.draw()
    return np.ascontiguousarray(np.asarray(canvas.buffer_rgba())[..., 0])


def test_a_printed_charuco_board_is_seen_whole_and_at_true_scale() -> None:
    view = find_board(printed(BOARD), BOARD, "print")
    assert len(view.ids) == 24
    fit = np.polyfit(view.board_mm[:, 0], view.pixels[:, 0], 1)
    assert fit[0] == pytest.approx(PX_PER_MM, rel=1e-4)
    [words] = drawn(BOARD, "a4").texts
    assert "7 x 5 squares of 25 mm" in words.get_text()
    assert "the line is 100 mm long" in words.get_text()


def test_a_printed_checkerboard_too() -> None:
    board = Checkerboard(inner_corners=(7, 5), square_mm=20.0)
    assert find_board(printed(board), board, "print").pixels[0, 0] != 0


def test_the_page_is_a4(tmp_path: Path) -> None:
    data = write_pdf(BOARD, tmp_path / "board.pdf").read_bytes()
    points = [float(v) for v in re.search(rb"MediaBox \[ *0 0 ([\d.]+) ([\d.]+) *\]", data).groups()]
    assert np.array(points) / 72.0 * MM_PER_INCH == pytest.approx([210.0, 297.0])


def test_a_board_that_does_not_fit_the_page_is_refused(tmp_path: Path) -> None:
    with pytest.raises(CalibrationError, match="has no room for a board of 312 x 240 mm"):
        write_pdf(BoardSpec(squares=(26, 20), square_mm=12, marker_mm=9, origin_mm=(0, 0)), tmp_path / "x.pdf")
    assert not (tmp_path / "x.pdf").exists()


def test_only_a_pdf_is_ever_overwritten(tmp_path: Path) -> None:
    recording = tmp_path / "board.pdf"
    recording.write_bytes(b"\x89MCAP0\r\n")
    for path, why in (
        (tmp_path / "s.mcap", "must end in .pdf"),
        (tmp_path / "no" / "board.pdf", "there is no folder"),
        (recording, "is not a PDF; it is not overwritten"),
    ):
        with pytest.raises(CalibrationError, match=why):
            write_pdf(BOARD, path)
    assert recording.read_bytes() == b"\x89MCAP0\r\n"
    twice = [write_pdf(BOARD, tmp_path / "b.PDF").read_bytes() for _ in range(2)]
    assert twice[0] == twice[1]
