"""Fit a lens to a set of views by Zhang's method, and detect sets that mix two cameras.

A set mixes two cameras if two lenses, each fitted to one part of it, fit far better than one lens fitted to all. The
parts are found without file names: starting from the lens fitted to all, each view pulls the lens in some direction,
and views of one camera pull alike. Names only confirm: parts that differ little count if files are named after them.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from brushloop.calibrate.board.detect import BoardView
from brushloop.calibrate.board.lens import Floats, Lens, rms
from brushloop.calibrate.errors import CalibrationError

LEAST = 3
"""Least number of views of a camera: fewer are outliers and do not determine a lens."""
STARTS, ROUNDS = 60, 20
APART = 0.65
"""Largest share of one lens's squared residuals that two lenses may leave to count as two cameras. Photographs of one
camera left 0.82 to 0.92 at the best partition (8 to 13 real photographs), at least 0.83 with a board curled by 1 mm."""
WORSE = 1.5
"""Least factor by which one camera's views fit the other's lens worse: one bad view does not make a camera."""
NAMED_APART, ALIKE = 0.97, 0.9
"""Limits if files are named after the parts: of the residuals as above, and of the views whose name fits their part."""
LEAST_NAMED = 8
"""With fewer views, names and parts agree by chance."""
UNITS = np.array([500.0, 500.0, 500.0, 500.0, 1.0, 1.0, 0.01, 0.01, 1.0])
"""Scales of fx, fy, cx, cy, k1, k2, p1, p2, k3 that give all of them similar weight."""

Part = NDArray[np.bool_]


@dataclass(frozen=True, slots=True)
class Solved:
    """A lens, and the pose of each board in front of it."""

    lens: Lens
    rms_px: float
    residuals_px: Floats
    """(views,) root mean square of each."""
    turns: tuple[Floats, ...]
    shifts_mm: tuple[Floats, ...]
    """Rotation vector and translation of each board."""

    @property
    def normals(self) -> Floats:
        """(views, 3) unit normals of the boards, toward the camera."""
        found = np.stack([np.asarray(cv2.Rodrigues(turn)[0], np.float64)[:, 2] for turn in self.turns])
        return np.asarray(np.where(found[:, 2:] < 0.0, -found, found), np.float64)


def solve(views: Sequence[BoardView], where: str) -> Solved:
    """Fit a lens by `cv2.calibrateCamera` (k1, k2, p1, p2, k3). Raises `CalibrationError` if none fits the views."""
    size = views[0].size_px
    objects = [_flat(view).astype(np.float32) for view in views]
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


def _flat(view: BoardView) -> Floats:
    """(n, 3) corners of a view in its board's own plane, z = 0."""
    return np.column_stack([view.board_mm, np.zeros(len(view.board_mm))])


def residuals(lens: Lens, view: BoardView) -> Floats:
    """(n, 2) px from where the lens puts each corner to where it was found, at the pose of the board that fits best."""
    board = _flat(view)
    _, turn, shift = cv2.solvePnP(board, view.pixels, lens.matrix, lens.distortion)
    turn, shift = cv2.solvePnPRefineLM(board, view.pixels, lens.matrix, lens.distortion, turn, shift)
    seen, _ = cv2.projectPoints(board, turn, shift, lens.matrix, lens.distortion)
    return view.pixels - np.asarray(seen, np.float64).reshape(-1, 2)


@dataclass(frozen=True, slots=True)
class TwoCameras:
    """The photographs of each of two cameras."""

    parts: tuple[tuple[str, ...], tuple[str, ...]]
    together_px: float
    apart_px: float
    """Root mean square residual with one lens, and with two."""


def two_cameras(views: Sequence[BoardView], solved: Solved) -> TwoCameras | None:
    """Split a set of views that two lenses explain far better than one; None for one camera or too few views."""
    part = _best_part(views, solved)
    if part is None:
        return None
    halves = _halves(views, part)
    try:
        one, other = (solve(half, "part") for half in halves)
    except CalibrationError:
        return None
    corners = [sum(len(view.pixels) for view in half) for half in halves]
    squares = [n * found.rms_px**2 for n, found in zip(corners, (one, other), strict=True)]
    left = sum(squares) / (sum(corners) * solved.rms_px**2)
    if not (left <= APART and _worse(halves[0], one, other) and _worse(halves[1], other, one)):
        named = _as_named([view.name for view in views], part)
        if named is None or left > NAMED_APART:
            return None
        part = named
    these, those = (tuple(view.name for view in half) for half in _halves(views, part))
    return TwoCameras((these, those), solved.rms_px, solved.rms_px * left**0.5)


def _halves(views: Sequence[BoardView], part: Part) -> tuple[list[BoardView], list[BoardView]]:
    pairs = list(zip(views, part.tolist(), strict=True))
    return [view for view, is_in in pairs if is_in], [view for view, is_in in pairs if not is_in]


def _worse(half: Sequence[BoardView], own: Solved, other: Solved) -> bool:
    return float(np.median([rms(residuals(other.lens, v)) / rms(residuals(own.lens, v)) for v in half])) >= WORSE


def _as_named(names: Sequence[str], part: Part) -> Part | None:
    """The views whose names differ only in digits (left01, left02), if they are this part or nearly so."""
    if len(names) < LEAST_NAMED:
        return None
    stems = [re.sub(r"\d+", "", name) for name in names]
    for stem in dict.fromkeys(stems):
        named = np.array([one == stem for one in stems])
        alike = float((named == part).mean())
        if _large_enough(named) and max(alike, 1.0 - alike) >= ALIKE:
            return named
    return None


def _best_part(views: Sequence[BoardView], solved: Solved) -> Part | None:
    """The views whose separate lens reduces the squared residuals most, to first order.

    Starts from many random halves; each view moves to the lens that fits it better, until none moves.
    """
    curves, pulls = _reduced(views, solved)
    rng, best_gain = np.random.default_rng(0), 0.0
    best: Part | None = None
    for _ in range(STARTS):
        part: Part = rng.random(len(views)) < 0.5
        for _ in range(ROUNDS):
            if not _large_enough(part):
                break
            here, there = _costs(curves, pulls, part), _costs(curves, pulls, ~part)
            gain = -float(np.where(part, here, there).sum())
            if gain > best_gain:
                best, best_gain = part, gain
            nearer = np.asarray(here < there, np.bool_)
            if bool((nearer == part).all()):
                break
            part = nearer
    return best


def _large_enough(part: Part) -> bool:
    count = int(np.count_nonzero(part))
    return LEAST <= count <= len(part) - LEAST


def _costs(curves: Floats, pulls: Floats, part: Part) -> Floats:
    """(n,) change of each view's squared residuals with the lens step that is best for one part."""
    curve, pull = (np.asarray(v[part].sum(axis=0), np.float64) for v in (curves, pulls))
    step: Floats = np.linalg.pinv(curve) @ pull
    return np.asarray(np.einsum("i,nij,j->n", step, curves, step) - 2.0 * pulls @ step, np.float64)


def _reduced(views: Sequence[BoardView], solved: Solved) -> tuple[Floats, Floats]:
    """Normal equations of each view for the lens, (n, 9, 9) and (n, 9), with its board's pose eliminated."""
    curves, pulls = list[Floats](), list[Floats]()
    for view, turn, shift in zip(views, solved.turns, solved.shifts_mm, strict=True):
        seen, slopes = cv2.projectPoints(_flat(view), turn, shift, solved.lens.matrix, solved.lens.distortion)
        off = (view.pixels - np.asarray(seen, np.float64).reshape(-1, 2)).ravel()
        of_board, of_lens = np.asarray(slopes, np.float64)[:, :6], np.asarray(slopes, np.float64)[:, 6:15] * UNITS
        basis, _ = np.linalg.qr(of_board)
        of_lens = of_lens - basis @ (basis.T @ of_lens)
        curves.append(of_lens.T @ of_lens)
        pulls.append(of_lens.T @ off)
    return np.array(curves), np.array(pulls)
