"""A printable board: a PDF of filled rectangles at true scale, with a ruler to check the print."""

from __future__ import annotations

import zlib
from pathlib import Path

import numpy as np

from brushloop.calibrate.board.spec import Board, Checkerboard, charuco_board, describe, size_mm
from brushloop.calibrate.errors import CalibrationError
from brushloop.calibrate.files import check_target

POINTS_PER_MM = 72.0 / 25.4
PAGES_MM = {"a4": (210.0, 297.0), "a3": (297.0, 420.0), "a2": (420.0, 594.0), "letter": (215.9, 279.4)}
MARGIN_MM = 8.0
RULER_MM = 100.0
RULER_ROOM_MM = 14.0
Rectangle = tuple[float, float, float, float]
"""x, y, width, height in mm, y down from the page's upper edge."""


def write_pdf(board: Board, path: Path, page: str = "a4") -> Path:
    """Write the board on one page, turned if it only fits that way.

    Raises `CalibrationError` if it does not fit, or if `path` is not that of a PDF: no other file is overwritten.
    """
    check_target(path, ".pdf")
    if not path.parent.is_dir():
        raise CalibrationError(str(path), f"there is no folder {path.parent}")
    if path.exists() and not (path.is_file() and path.read_bytes().startswith(b"%PDF")):
        raise CalibrationError(str(path), "exists and is not a PDF; it is not overwritten")
    page_mm = _page(board, page)
    content = _content(board, page_mm)
    path.write_bytes(_document(page_mm, content))
    return path


def rectangles(board: Board) -> list[Rectangle]:
    """The black rectangles, x right and y down in mm from the board's upper left corner."""
    if isinstance(board, Checkerboard):
        columns, rows = (n + 1 for n in board.inner_corners)
        return _squares(columns, rows, board.square_mm)
    made = charuco_board(board, "board")
    dictionary = made.getDictionary()
    black = _squares(*board.squares, board.square_mm)
    for number, corners in zip(np.ravel(made.getIds()), made.getObjPoints(), strict=True):
        left, top = (float(v) for v in np.asarray(corners)[0, :2])
        side = dictionary.markerSize + 2
        bits = dictionary.generateImageMarker(int(number), side)
        bit_mm = board.marker_mm / side
        for row in range(side):
            for start, end in _runs(np.asarray(bits)[row] == 0):
                black.append((left + start * bit_mm, top + row * bit_mm, (end - start) * bit_mm, bit_mm))
    return black


def _page(board: Board, page: str) -> tuple[float, float]:
    if page not in PAGES_MM:
        raise CalibrationError(f"page {page!r}", f"is not one of {', '.join(PAGES_MM)}")
    width, height = size_mm(board)
    upright = PAGES_MM[page]
    for page_mm in (upright, (upright[1], upright[0])):
        if width + 2 * MARGIN_MM <= page_mm[0] and height + 2 * MARGIN_MM + RULER_ROOM_MM <= page_mm[1]:
            return page_mm
    raise CalibrationError(
        f"page {page}",
        f"has no room for a board of {width:g} x {height:g} mm with {MARGIN_MM:g} mm around it and a ruler below",
    )


def _content(board: Board, page_mm: tuple[float, float]) -> bytes:
    width, height = size_mm(board)
    left, top = (page_mm[0] - width) / 2.0, (page_mm[1] - height - RULER_ROOM_MM) / 2.0
    black = [(left + x, top + y, w, h) for x, y, w, h in rectangles(board)]
    below = top + height + 5.0
    ruler_mm = min(RULER_MM, width // 10.0 * 10.0)
    black.append((left, below, ruler_mm, 0.2))
    black += [
        (left + at - 0.1, below, 0.2, 3.0 if at % 50 == 0 else 2.0) for at in np.arange(0.0, ruler_mm + 1.0, 10.0)
    ]
    lines = ["0 g"]
    # From mm with y down to points with y up.
    lines.append(f"{POINTS_PER_MM:.9f} 0 0 {-POINTS_PER_MM:.9f} 0 {page_mm[1] * POINTS_PER_MM:.6f} cm")
    lines += [f"{x:.5f} {y:.5f} {w:.5f} {h:.5f} re" for x, y, w, h in black]
    lines.append("f")
    words = f"{describe(board)}. Print at 100 %; the line is {ruler_mm:g} mm long."
    lines += ["BT", f"/F1 2.6 Tf 1 0 0 -1 {left:.3f} {below + 6.5:.3f} Tm", f"({words}) Tj", "ET"]
    return "\n".join(lines).encode("ascii")


def _squares(columns: int, rows: int, side: float) -> list[Rectangle]:
    return [(c * side, r * side, side, side) for r in range(rows) for c in range(columns) if (c + r) % 2 == 0]


def _runs(black: np.ndarray[tuple[int], np.dtype[np.bool_]]) -> list[tuple[int, int]]:
    edges = np.flatnonzero(np.diff(np.concatenate([[False], black, [False]]).astype(np.int8)))
    return [(int(a), int(b)) for a, b in zip(edges[::2], edges[1::2], strict=True)]


def _document(page_mm: tuple[float, float], content: bytes) -> bytes:
    """PDF 1.4 with one page (ISO 32000-1, 7.5): five objects, their offsets, the trailer."""
    width, height = (v * POINTS_PER_MM for v in page_mm)
    packed = zlib.compress(content)
    objects = [
        b"<< /Type /Catalog /Pages 2 0 R /ViewerPreferences << /PrintScaling /None >> >>",
        b"<< /Type /Pages /Kids [3 0 R] /Count 1 >>",
        f"<< /Type /Page /Parent 2 0 R /MediaBox [0 0 {width:.4f} {height:.4f}] /Contents 4 0 R "
        f"/Resources << /Font << /F1 5 0 R >> >> >>".encode(),
        f"<< /Length {len(packed)} /Filter /FlateDecode >>\nstream\n".encode() + packed + b"\nendstream",
        b"<< /Type /Font /Subtype /Type1 /BaseFont /Helvetica >>",
    ]
    document, offsets = b"%PDF-1.4\n%\xe2\xe3\xcf\xd3\n", list[int]()
    for number, body in enumerate(objects, start=1):
        offsets.append(len(document))
        document += f"{number} 0 obj\n".encode() + body + b"\nendobj\n"
    table = b"".join(f"{offset:010d} 00000 n \n".encode() for offset in offsets)
    count = len(objects) + 1
    return (
        document
        + f"xref\n0 {count}\n0000000000 65535 f \n".encode()
        + table
        + f"trailer\n<< /Size {count} /Root 1 0 R >>\nstartxref\n{len(document)}\n%%EOF\n".encode()
    )
