"""The boards that a camera is calibrated with: ChArUco boards and plain checkerboards."""

from __future__ import annotations

from typing import Annotated

import cv2
from pydantic import Field, model_validator

from brushloop.calibrate.artefact import Frozen
from brushloop.calibrate.errors import CalibrationError

Corners = Annotated[int, Field(ge=3, le=60)]
Place = Annotated[float, Field(ge=-1e6, le=1e6, allow_inf_nan=False)]


class BoardSpec(Frozen):
    """A ChArUco board in the plane of the paper, in view of the camera."""

    squares: tuple[Annotated[int, Field(ge=2, le=50)], Annotated[int, Field(ge=2, le=50)]]
    """Columns and rows of squares."""
    square_mm: Annotated[float, Field(gt=0.0, le=1000.0)]
    marker_mm: Annotated[float, Field(gt=0.0, le=1000.0)]
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
    square_mm: Annotated[float, Field(gt=0.0, le=1000.0)]


Board = Checkerboard | BoardSpec


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
