"""The paper plane in one photograph: corners found, lens undone, plane fitted."""

from __future__ import annotations

import numpy as np

from calibrate.board.detect import View, see
from calibrate.board.lens import Floats, Gray, Lens, unknown_lens
from calibrate.board.plane import Plane, fit_bent_plane
from calibrate.board.scale import BENT, OTHER_LENS, BoardSpec
from calibrate.errors import CalibrationError

BEND_PX = 0.5
"""A lens that bends the board by more (root mean square) is visible: one flat view is too little to calibrate it by."""
LEFT_PX = 1.5
"""A lens file that leaves more is not of this camera; less is a focus that breathes: the view's own k1 takes it up."""


def see_plane(image: Gray, spec: BoardSpec, lens: Lens | None = None, where: str = "camera") -> Plane:
    """The paper plane from one photograph, its own radial term fitted. Raises `CalibrationError`."""
    return see_flagged(image, spec, lens, where)[0]


def see_flagged(
    image: Gray,
    spec: BoardSpec,
    lens: Lens | None = None,
    where: str = "camera",
    sheet_mm: tuple[float, float] | None = None,
) -> tuple[Plane, tuple[str, ...]]:
    """The same, and what is not as it should be with the photograph; a sheet of that size may lie on the board.

    Raises `CalibrationError`.
    """
    if lens is not None:
        lens.check_size(image, where)
    view = see(image, spec, where, None if sheet_mm is None else beside(spec, sheet_mm))
    return fit_bent_plane(view.pixels, paper_mm(view, spec), lens or unknown_lens(view.size_px), where), view.flags


def see_straight(
    image: Gray, spec: BoardSpec, lens: Lens | None, where: str, sheet_mm: tuple[float, float] | None = None
) -> tuple[Plane, tuple[str, ...]]:
    """The same, for what is to be measured with. Raises `CalibrationError` also where more is bent than is known of."""
    plane, flags = see_flagged(image, spec, lens, where, sheet_mm)
    if told := bend(plane, known=lens is not None):
        raise CalibrationError(where, told)
    return plane, flags


def bend(plane: Plane, *, known: bool) -> str:
    """What is to be done about the lens, in words; empty where it is straight enough, or as it is known to be."""
    if plane.bend_px <= (LEFT_PX if known else BEND_PX):
        return ""
    return f"the board is bent by {plane.bend_px:.1f} px: if it lies flat, {OTHER_LENS if known else BENT}"


def paper_mm(view: View, spec: BoardSpec) -> Floats:
    """(n, 2) places of a view's corners in the paper frame."""
    height_mm = spec.squares[1] * spec.square_mm
    # The board counts y downward from its upper left corner; the paper frame counts it upward.
    flip = np.array([1.0, -1.0])
    return np.array([spec.origin_mm[0], spec.origin_mm[1] + height_mm]) + flip * view.board_mm


def beside(spec: BoardSpec, sheet_mm: tuple[float, float]) -> int:
    """Corners of the board that lie half a square and more beside a sheet at the origin of the paper frame."""
    (columns, rows), side, (x_mm, y_mm) = spec.squares, spec.square_mm, spec.origin_mm
    across = x_mm + side * np.arange(1, columns)
    along = y_mm + side * np.arange(1, rows)
    gap_mm = 0.5 * side
    clear_x = (across <= -gap_mm) | (across >= sheet_mm[0] + gap_mm)
    clear_y = (along <= -gap_mm) | (along >= sheet_mm[1] + gap_mm)
    return int((clear_x[:, None] | clear_y[None, :]).sum())
