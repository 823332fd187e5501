"""The board in one photograph: its corners are found, the plane is fitted, and the lens is checked.

Also what a session recorded of the rig: board, sheet and lens.
"""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
from pydantic import BaseModel, ValidationError

from brushloop.calibrate.board.detect import BoardView, find_board
from brushloop.calibrate.board.lens import Floats, Gray, Lens, unknown_lens
from brushloop.calibrate.board.pix2len import Plane, distorted_share, fit_plane
from brushloop.calibrate.board.spec import BoardSpec
from brushloop.calibrate.errors import CalibrationError, invalid
from brushloop.calibrate.files import read_bounded
from brushloop.sessions.recording import Recording

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
EFFECTIVE = "rig.effective.json"
"""The configuration in effect: rig.toml, with the changes that the environment made."""


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
    image: Gray, spec: BoardSpec, lens: Lens | None, where: str, sheet_mm: tuple[float, float] | None = None
) -> tuple[BoardView, Plane]:
    """The corners in a photograph as it was taken; and the paper plane, fitted to them together with the lens's k1.

    A sheet of `sheet_mm` may lie on the board. Raises `CalibrationError`, also for a lens that distorts more than is
    known.
    """
    view, through = _find(image, spec, where, lens, sheet_mm)
    plane = fit_plane(view.pixels, paper_mm(view, spec), through, where)
    if plane.distortion_px > (VISIBLE_PX if lens is None else REMAINING_PX):
        advice = NO_LENS_FILE if lens is None else OTHER_LENS
        raise CalibrationError(where, f"the board is bent by {plane.distortion_px:.1f} px: if it lies flat, {advice}")
    return view, replace(plane, flags=view.flags)


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


class _Paper(BaseModel):
    size_mm: tuple[float, float] | None = None


class _Camera(BaseModel):
    optics: Lens | None = None


class RigView(BaseModel):
    """What a session recorded of the board, the sheet that lies on it, and the lens; None if nothing."""

    board: BoardSpec | None = None
    paper: _Paper | None = None
    camera: _Camera | None = None

    @property
    def sheet_mm(self) -> tuple[float, float] | None:
        """Width and height of the sheet."""
        return None if self.paper is None else self.paper.size_mm

    @property
    def lens(self) -> Lens | None:
        """The lens that the session was collected with."""
        return None if self.camera is None else self.camera.optics


def rig_of(session: Recording | Path) -> RigView:
    """The rig of a recording, or of the folder of a session that may still be open. Raises `CalibrationError`."""
    inside = isinstance(session, Recording)
    where = f"{session.path} {EFFECTIVE}" if inside else str(session / EFFECTIVE)
    data = session.attachment(EFFECTIVE) if inside else read_bounded(session / EFFECTIVE)
    try:
        return RigView.model_validate(json.loads(data))
    except ValidationError as error:
        raise invalid(where, error) from None
    except (ValueError, RecursionError):
        raise CalibrationError(where, "holds no board") from None


def board_of(session: Recording | Path) -> BoardSpec:
    """The board of a session's rig. Raises `CalibrationError` where the session names none."""
    board = rig_of(session).board
    if board is None:
        where = session.path if isinstance(session, Recording) else session
        raise CalibrationError(f"{where} {EFFECTIVE}", "holds no board")
    return board
