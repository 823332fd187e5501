"""One lens through several views of a board: Zhang's method by OpenCV, and what its residuals say of the lens."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from calibrate.board.detect import View
from calibrate.board.lens import Floats, Lens
from calibrate.errors import CalibrationError


@dataclass(frozen=True, slots=True)
class Solved:
    """A lens, and how each board lies before it."""

    lens: Lens
    rms_px: float
    residuals_px: Floats
    """(views,) root mean square of each."""
    turns: tuple[Floats, ...]
    shifts_mm: tuple[Floats, ...]
    """Rotation vector and translation of each board."""

    @property
    def normals(self) -> Floats:
        """(views, 3) unit vectors out of each board, toward the camera."""
        found = np.stack([np.asarray(cv2.Rodrigues(turn)[0], np.float64)[:, 2] for turn in self.turns])
        return np.asarray(np.where(found[:, 2:] < 0.0, -found, found), np.float64)


def solve(views: Sequence[View], where: str) -> Solved:
    """`cv2.calibrateCamera` (k1, k2, p1, p2, k3). Raises `CalibrationError` where no lens explains the views."""
    size = views[0].size_px
    objects = [flat(view).astype(np.float32) for view in views]
    pixels = [view.pixels.astype(np.float32).reshape(-1, 1, 2) for view in views]
    try:
        rms, matrix, distortion, turns, shifts, _, _, per_view = cv2.calibrateCameraExtended(
            objects, pixels, size, np.zeros((3, 3)), np.zeros(5)
        )
    except cv2.error as error:
        raise CalibrationError(where, f"no lens explains these views: {error.err}") from None
    return Solved(
        Lens(np.asarray(matrix, np.float64), np.asarray(distortion, np.float64).ravel()[:5], size),
        float(rms),
        np.asarray(per_view, np.float64).ravel(),
        tuple(np.asarray(turn, np.float64) for turn in turns),
        tuple(np.asarray(shift, np.float64) for shift in shifts),
    )


def flat(view: View) -> Floats:
    """(n, 3) corners of a view on its board, which is flat."""
    return np.column_stack([view.board_mm, np.zeros(len(view.board_mm))])


def through(lens: Lens, view: View) -> float:
    """Residual of a view, root mean square in px, its board laid as well as this lens allows."""
    board = flat(view)
    _, turn, shift = cv2.solvePnP(board, view.pixels, lens.matrix, lens.distortion)
    turn, shift = cv2.solvePnPRefineLM(board, view.pixels, lens.matrix, lens.distortion, turn, shift)
    seen, _ = cv2.projectPoints(board, turn, shift, lens.matrix, lens.distortion)
    return float(np.sqrt(((view.pixels - np.asarray(seen, np.float64).reshape(-1, 2)) ** 2).sum(axis=1).mean()))
