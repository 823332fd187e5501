"""The boards that a camera is calibrated with, ChArUco boards and plain checkerboards, and their printable PDF."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import cv2
import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from brushloop.calibrate.artefact import Frozen, checked_fields
from brushloop.calibrate.commands import BoardOptions, PrintRequest
from brushloop.calibrate.errors import CalibrationError
from brushloop.calibrate.files import Written, check_target
from brushloop.sessions.terminal import Progress, unseen

Corners = Annotated[int, Field(ge=3, le=60)]
Squares = Annotated[int, Field(ge=2, le=50)]
Side = Annotated[float, Field(gt=0.0, le=1000.0)]
Place = Annotated[float, Field(ge=-1e6, le=1e6, allow_inf_nan=False)]
MM_PER_INCH = 25.4
PAGES_MM = {"a4": (210.0, 297.0), "a3": (297.0, 420.0), "a2": (420.0, 594.0), "letter": (215.9, 279.4)}
MARGIN_MM, TEXT_ROOM_MM = 8.0, 8.0
Rectangle = tuple[float, float, float, float]
"""x, y, width, height in mm, y down from the page's upper edge."""


class BoardSpec(Frozen):
    """A ChArUco board in the plane of the paper, in view of the camera."""

    squares: tuple[Squares, Squares]
    """Columns and rows of squares."""
    square_mm: Side
    marker_mm: Side
    dictionary: Annotated[str, Field(pattern=r"^DICT_[0-9A-Z_]+$")] = "DICT_5X5_1000"
    origin_mm: tuple[Place, Place]
    """Lower left corner of the board, in the paper frame."""

    @model_validator(mode="after")
    def _exists(self) -> BoardSpec:
        if not isinstance(getattr(cv2.aruco, self.dictionary, None), int):
            raise ValueError(f"dictionary = {self.dictionary!r} is not one of OpenCV's DICT_*")
        if self.marker_mm >= self.square_mm:
            raise ValueError(f"marker_mm = {self.marker_mm} must be less than square_mm = {self.square_mm}")
        return self


class Checkerboard(Frozen):
    """A plain checkerboard, named by its inner corners as OpenCV does."""

    inner_corners: tuple[Corners, Corners]
    """Columns and rows."""
    square_mm: Side


Board = Checkerboard | BoardSpec


@dataclass(frozen=True, slots=True)
class BoardView:
    """One photograph of a board."""

    name: str
    size_px: tuple[int, int]
    """Width and height of the photograph."""
    pixels: NDArray[np.float64]
    """(n, 2) corners in the photograph."""
    board_mm: NDArray[np.float64]
    """(n, 2) the same corners on the board: x right, y down, from its upper left corner."""
    flags: tuple[str, ...] = ()
    """Problems with the photograph, although corners were found."""


def size_mm(board: Board) -> tuple[float, float]:
    """Width and height of the board."""
    columns, rows = (n + 1 for n in board.inner_corners) if isinstance(board, Checkerboard) else board.squares
    return columns * board.square_mm, rows * board.square_mm


def describe(board: Board) -> str:
    """One line that describes the board, printed below it."""
    if isinstance(board, Checkerboard):
        columns, rows = board.inner_corners
        return f"checkerboard, {columns} x {rows} inner corners, squares of {board.square_mm:g} mm"
    columns, rows = board.squares
    return (
        f"ChArUco, {columns} x {rows} squares of {board.square_mm:g} mm, "
        f"markers of {board.marker_mm:g} mm, {board.dictionary}"
    )


def charuco_board(spec: BoardSpec, where: str) -> cv2.aruco.CharucoBoard:
    """Make OpenCV's board. Raises `CalibrationError` if it needs more markers than the dictionary has."""
    dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, spec.dictionary))
    try:
        return cv2.aruco.CharucoBoard(spec.squares, spec.square_mm, spec.marker_mm, dictionary)
    except cv2.error as error:
        raise CalibrationError(where, f"the board cannot be made: {error}") from None


def named_board(options: BoardOptions) -> Board:
    """The board that a command names. Raises `CalibrationError`."""
    checkerboard, charuco = options.checkerboard, options.charuco
    if bool(checkerboard) == bool(charuco):
        what = "give either --checkerboard (inner corners) or --charuco (squares), such as 9x6"
        raise CalibrationError("board", what)
    size, square_mm = (checkerboard or charuco).lower().split("x"), options.square_mm
    with checked_fields("board"):
        if checkerboard:
            return Checkerboard.model_validate({"inner_corners": size, "square_mm": square_mm})
        marker_mm = options.marker_mm or 0.75 * square_mm
        markers = {"marker_mm": marker_mm, "dictionary": options.dictionary, "origin_mm": (0.0, 0.0)}
        return BoardSpec.model_validate({"squares": size, "square_mm": square_mm} | markers)


def check_pdf(path: Path) -> None:
    """Check before any work that a PDF may be written to `path`, in an existing folder. Raises `CalibrationError`."""
    check_target(path, ".pdf")
    if not path.parent.is_dir():
        raise CalibrationError(str(path), f"there is no folder {path.parent}")


def print_board(request: PrintRequest, _progress: Progress = unseen) -> Written:
    """Write a board as a PDF of one page, turned if it only fits that way.

    Raises `CalibrationError` if it does not fit, or if `out` is not that of a PDF: no other file is overwritten.
    """
    board, path = named_board(request), request.out
    check_pdf(path)
    if path.exists() and not (path.is_file() and path.read_bytes().startswith(b"%PDF")):
        raise CalibrationError(str(path), "exists and is not a PDF; it is not overwritten")
    drawn(board, request.page).savefig(path, format="pdf", metadata={"CreationDate": None})
    return Written(path, (f"{path}: {describe(board)}",))


def rectangles(board: Board) -> list[Rectangle]:
    """The black rectangles, x right and y down in mm from the board's upper left corner."""
    if isinstance(board, Checkerboard):
        columns, rows = (n + 1 for n in board.inner_corners)
        return _squares(columns, rows, board.square_mm)
    made = charuco_board(board, "board")
    dictionary = made.getDictionary()
    side = dictionary.markerSize + 2
    bit_mm = board.marker_mm / side
    black = _squares(*board.squares, board.square_mm)
    for number, corners in zip(np.ravel(made.getIds()), made.getObjPoints(), strict=True):
        left, top = np.asarray(corners)[0, :2].tolist()
        bits = np.asarray(dictionary.generateImageMarker(int(number), side)) == 0
        for row, line in enumerate(bits):
            # Where a run of black bits begins and where it ends: one rectangle each, without seams.
            runs = np.flatnonzero(np.diff(line, prepend=False, append=False)).reshape(-1, 2).tolist()
            black += [(left + a * bit_mm, top + row * bit_mm, (b - a) * bit_mm, bit_mm) for a, b in runs]
    return black


def drawn(board: Board, page: str) -> Any:
    """The page with the board and its name below, a matplotlib figure. Raises `CalibrationError` if it does not fit."""
    from matplotlib.collections import PatchCollection
    from matplotlib.figure import Figure
    from matplotlib.patches import Rectangle as Patch
    from matplotlib.transforms import Affine2D

    if page not in PAGES_MM:
        raise CalibrationError(f"page {page!r}", f"is not one of {', '.join(PAGES_MM)}")
    width, height = size_mm(board)
    needed_mm = width + 2 * MARGIN_MM, height + 2 * MARGIN_MM + TEXT_ROOM_MM
    turned = (PAGES_MM[page], PAGES_MM[page][::-1])
    page_mm = next((at for at in turned if needed_mm[0] <= at[0] and needed_mm[1] <= at[1]), None)
    if page_mm is None:
        size = f"{width:g} x {height:g} mm with {MARGIN_MM:g} mm around it and its name below"
        raise CalibrationError(f"page {page}", f"has no room for a board of {size}")
    left, top = (page_mm[0] - width) / 2.0, (page_mm[1] - height - TEXT_ROOM_MM) / 2.0
    figure: Any = Figure(figsize=(page_mm[0] / MM_PER_INCH, page_mm[1] / MM_PER_INCH))
    # From mm with y down to inches with y up.
    from_mm = Affine2D().translate(0.0, -page_mm[1]).scale(1.0 / MM_PER_INCH, -1.0 / MM_PER_INCH)
    patches = [Patch((left + x, top + y), w, h) for x, y, w, h in rectangles(board)]
    placed = from_mm + figure.dpi_scale_trans
    figure.add_artist(PatchCollection(patches, color="black", linewidth=0.0, transform=placed))
    words = f"{describe(board)}. Print at 100 %: the board is {width:g} x {height:g} mm."
    figure.text(left / page_mm[0], 1.0 - (top + height + 6.0) / page_mm[1], words, fontsize=7.0)
    return figure


def _squares(columns: int, rows: int, side: float) -> list[Rectangle]:
    return [(c * side, r * side, side, side) for r in range(rows) for c in range(columns) if (c + r) % 2 == 0]
