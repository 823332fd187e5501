"""The printable board: what is black in it is OpenCV's board at true scale."""

from __future__ import annotations

import re
import zlib
from pathlib import Path

import numpy as np
import pytest

from brushloop.calibrate.board.detect import find_board
from brushloop.calibrate.board.pdf import POINTS_PER_MM, write_pdf
from brushloop.calibrate.board.spec import BoardSpec, Checkerboard
from brushloop.calibrate.errors import CalibrationError

BOARD = BoardSpec(squares=(7, 5), square_mm=25.0, marker_mm=18.0, dictionary="DICT_5X5_50", origin_mm=(0.0, 0.0))
PX_PER_MM = 8


def printed(path: Path) -> tuple[np.ndarray, str]:
    """The page as a printer lays it down at 8 px/mm, read from the file's bytes, and its text."""
    data = path.read_bytes()
    width, height = (float(v) / POINTS_PER_MM for v in re.search(rb"MediaBox \[0 0 ([\d.]+) ([\d.]+)\]", data).groups())
    content = zlib.decompress(data.split(b"stream\n")[1].split(b"\nendstream")[0]).decode()
    scale = [float(v) for v in re.search(r"^([-\d. ]+) cm$", content, re.M)[1].split()]
    assert scale == pytest.approx([POINTS_PER_MM, 0, 0, -POINTS_PER_MM, 0, height * POINTS_PER_MM], abs=1e-3)
    page = np.full((round(height * PX_PER_MM), round(width * PX_PER_MM)), 255, np.uint8)
    for line in re.findall(r"^([\d. ]+) re$", content, re.M):
        x, y, w, h = (float(v) * PX_PER_MM for v in line.split())
        page[round(y) : round(y + h), round(x) : round(x + w)] = 0
    return page, re.search(r"\((.*)\) Tj", content)[1]


def test_a_printed_charuco_board_is_seen_whole_and_at_true_scale(tmp_path: Path) -> None:
    page, words = printed(write_pdf(BOARD, tmp_path / "board.pdf"))
    view = find_board(page, BOARD, "print")
    assert len(view.ids) == 24
    fit = np.polyfit(view.board_mm[:, 0], view.pixels[:, 0], 1)
    assert fit[0] == pytest.approx(PX_PER_MM, rel=1e-4)
    assert "7 x 5 squares of 25 mm" in words
    assert "the line is 100 mm long" in words


def test_a_printed_checkerboard_too(tmp_path: Path) -> None:
    board = Checkerboard(inner_corners=(7, 5), square_mm=20.0)
    page, _ = printed(write_pdf(board, tmp_path / "board.pdf"))
    assert find_board(page, board, "print").pixels[0, 0] != 0


def test_the_cross_reference_table_points_at_the_objects(tmp_path: Path) -> None:
    data = write_pdf(BOARD, tmp_path / "board.pdf").read_bytes()
    start = int(re.search(rb"startxref\n(\d+)", data)[1])
    offsets = [int(v) for v in re.findall(rb"(\d{10}) 00000 n", data[start:])]
    assert [data[offset : offset + 7] for offset in offsets] == [f"{k} 0 obj".encode() for k in range(1, 6)]


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
