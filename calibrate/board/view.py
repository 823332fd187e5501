"""The board in one photograph: corners found, plane fitted, lens checked; for live use, artefacts and pre-flight."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from brushloop.calibrate.board.artefact import LensFile
from brushloop.calibrate.board.detect import BoardView, find_board
from brushloop.calibrate.board.intrinsics import RMS_LIMIT_PX
from brushloop.calibrate.board.lens import Floats, Gray, Lens, unknown_lens
from brushloop.calibrate.board.pix2len import Plane, distorted_share, fit_plane
from brushloop.calibrate.board.spec import BoardSpec
from brushloop.calibrate.errors import CalibrationError

VISIBLE_PX = 0.5
"""A lens that distorts the board by more (root mean square) needs a lens file: one flat view cannot calibrate it."""
REMAINING_PX = 1.5
"""Distortion left by the lens file: more means another camera; less is a small change of focus, which k1 describes."""
DISTORTED_SHARE = 0.85
"""Share of squared residuals that one radial term explains: 0.7 for a board curled lengthwise, more for a lens."""
NO_LENS_FILE = (
    "the lens bends straight lines: calibrate it with `brushloop camera intrinsics`, then name the lens file as "
    "camera.lens_file in rig.toml, or with --lens"
)
OTHER_LENS = "distortion remains after the lens was corrected: the lens file is of another camera, or of another focus"
LEAST_PX_PER_MM = 4.0
"""Below this a tip of 0.5 mm is two pixels wide."""
WORST_INTERVAL = 5e-4
"""Relative half width of pix2len's interval: 0.01 mm over 20 mm."""
REFOCUSED = 0.02
"""Difference of k1 from its calibrated value beyond which the lens has changed."""


def see_board(image: Gray, spec: BoardSpec, where: str = "camera", lens: Lens | None = None) -> Plane:
    """Fit the paper plane in an undistorted photograph, or in one seen through a known lens, which is not refitted.

    Raises `CalibrationError`; if the lens distorts, the message says what to do about it.
    """
    view, through = _find(image, spec, where, lens)
    corners_mm = paper_mm(view, spec)
    try:
        return replace(fit_plane(view.pixels, corners_mm, through, where, radial_terms=0), flags=view.flags)
    except CalibrationError as error:
        if distorted_share(view.pixels, corners_mm, through, where) > DISTORTED_SHARE:
            raise CalibrationError(where, f"{error.what}; {NO_LENS_FILE if lens is None else OTHER_LENS}") from None
        raise


def see_board_and_lens(
    image: Gray,
    spec: BoardSpec,
    lens: Lens | None = None,
    where: str = "camera",
    sheet_mm: tuple[float, float] | None = None,
) -> Plane:
    """Fit the paper plane and the lens's k1 in a photograph as it was taken.

    A sheet of `sheet_mm` may lie on the board. Raises `CalibrationError`.
    """
    view, through = _find(image, spec, where, lens, sheet_mm)
    return replace(fit_plane(view.pixels, paper_mm(view, spec), through, where), flags=view.flags)


def calibration_plane(
    image: Gray, spec: BoardSpec, lens: Lens | None, where: str, sheet_mm: tuple[float, float] | None = None
) -> Plane:
    """`see_board_and_lens` for measuring: also raises `CalibrationError` if the lens distorts more than is known."""
    plane = see_board_and_lens(image, spec, lens, where, sheet_mm)
    if problem := lens_problem(plane, known=lens is not None):
        raise CalibrationError(where, problem)
    return plane


def lens_problem(plane: Plane, *, known: bool) -> str:
    """Advice about the lens; empty if it distorts little, or as its file says."""
    if plane.distortion_px <= (REMAINING_PX if known else VISIBLE_PX):
        return ""
    advice = OTHER_LENS if known else NO_LENS_FILE
    return f"the board is bent by {plane.distortion_px:.1f} px: if it lies flat, {advice}"


def preflight(
    image: Gray, spec: BoardSpec, lens: LensFile | None = None, rms_limit_px: float = RMS_LIMIT_PX
) -> tuple[Plane, tuple[str, ...]]:
    """The plane in a photograph of the board, and warnings for the operator before a session.

    Raises `CalibrationError` where the board is not seen at all.
    """
    plane = see_board_and_lens(image, spec, lens.lens() if lens else None)
    warnings = list(plane.flags)
    if lens is not None and lens.rms_px > rms_limit_px:
        warnings.append(f"the lens was calibrated with a residual of {lens.rms_px:.2f} px, limit {rms_limit_px:g} px")
    if problem := lens_problem(plane, known=lens is not None):
        warnings.append(problem)
    if plane.rms_px > rms_limit_px:
        warnings.append(f"the board's residual is {plane.rms_px:.2f} px, limit {rms_limit_px:g} px: is the board flat?")
    k1 = float(plane.lens.distortion[0])
    if lens is not None and abs(k1 - lens.distortion[0]) > REFOCUSED:
        warnings.append(f"k1 is {k1:+.3f} here and was {lens.distortion[0]:+.3f}: was the lens refocused?")
    if 1.0 / plane.mm_per_px < LEAST_PX_PER_MM:
        warnings.append(f"only {1.0 / plane.mm_per_px:.1f} px/mm, at least {LEAST_PX_PER_MM:g} are needed")
    low, high = plane.interval_mm_per_px
    if (high - low) / 2.0 > WORST_INTERVAL * plane.mm_per_px:
        reach = 50.0 * (high - low) / plane.mm_per_px
        warnings.append(f"pix2len is only known to {reach:.2f} %: show more of the board")
    if plane.dropped:
        warnings.append(f"{len(plane.dropped)} corners do not lie on the plane of the others")
    return plane, tuple(warnings)


def paper_mm(view: BoardView, spec: BoardSpec) -> Floats:
    """(n, 2) corners of a view in the paper frame."""
    depth_mm = spec.squares[1] * spec.square_mm
    # The board counts y downward from its upper left corner; the paper frame counts it upward.
    flip = np.array([1.0, -1.0])
    return np.array([spec.origin_mm[0], spec.origin_mm[1] + depth_mm]) + flip * view.board_mm


def corners_beside(spec: BoardSpec, sheet_mm: tuple[float, float]) -> int:
    """Number of corners at least half a square outside a sheet that lies at the origin of the paper frame."""
    (columns, rows), side, (x_mm, y_mm) = spec.squares, spec.square_mm, spec.origin_mm
    across = x_mm + side * np.arange(1, columns)
    along = y_mm + side * np.arange(1, rows)
    gap_mm = 0.5 * side
    clear_x = (across <= -gap_mm) | (across >= sheet_mm[0] + gap_mm)
    clear_y = (along <= -gap_mm) | (along >= sheet_mm[1] + gap_mm)
    return int((clear_x[:, None] | clear_y[None, :]).sum())


def _find(
    image: Gray, spec: BoardSpec, where: str, lens: Lens | None, sheet_mm: tuple[float, float] | None = None
) -> tuple[BoardView, Lens]:
    if lens is not None:
        lens.check_size(image, where)
    view = find_board(image, spec, where, None if sheet_mm is None else corners_beside(spec, sheet_mm))
    return view, lens or unknown_lens(view.size_px)
