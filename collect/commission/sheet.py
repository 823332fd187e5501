"""Step 4: the sheet and the board under it, by their touched corners; and which corners were mistaken.

A sheet that was named turned by half a turn together with its board looks right here; the proof's self-check shows it.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from brushloop.calibrate.board.spec import BoardSpec, size_mm
from brushloop.collect.commission.arm import HAND_MM, Point, tips, touch
from brushloop.collect.commission.camera import board_of
from brushloop.collect.commission.tip import LEAST_OUTLIER_MM
from brushloop.collect.commission.visit import Notebook, Step, Taught, Visit
from brushloop.collect.errors import NotAccepted
from brushloop.collect.rig.paper import PaperPlane, fit_plane

Floats = NDArray[np.float64]
CORNERS = ("lower left", "lower right", "upper right", "upper left")
Corners = Sequence[Sequence[Point]]
"""The touches of each corner, in the order of `CORNERS`."""
WORST_CORNER_MM = 3.0
"""A corner that is off by more than this was not merely touched inaccurately."""
WORST_SCALE = 0.004
"""Relative error of the board's size from which the print is doubted: 1 mm over a page."""
EXPLAINED, LEAST_MM = 0.2, 0.3
"""Names were mixed up if that explains all but this share of the largest misfit, or leaves no more than this."""
ASKEW_DEG = 0.5
"""A sheet that is turned by more against its board must be laid straight: `rig.toml` has one turn for both."""
BOARD, SHEET = "board-corner", "sheet-corner"
THINGS = ((BOARD, "the board's printed squares"), (SHEET, "the sheet"))
GOOD_MM = 0.13
"""Standard error of the sheet's origin, in each axis, at which touching ends."""
MOST_ROUNDS = 5
WORST_MM = 0.25
INSET_MM = 2.0
"""Distance of the touch point from the sheet's edges: beside every patch."""


class SheetStep(Step):
    """Origin, turn, size and plane of the sheet, and the board's place on it."""

    name = "sheet"
    title = "Sheet and board"
    minutes = 8
    observes = (BOARD, SHEET)

    async def carry_out(self, visit: Visit) -> None:
        """Have the corners touched until the origin is known well enough. Raises `NotAccepted`, `StepError`."""
        visit.say(
            "Take off any plain paper that covers the board. See that the board lies in the middle of the picture, and "
            "the sheet on the board with its edges along the squares.",
            "Touch each corner with the brush upright (hold a set square beside it), and hold still.",
            "The lower edge is the one with the print's name.",
        )
        sigma_mm = math.inf
        for number in range(MOST_ROUNDS):
            for kind, thing in THINGS:
                if kind == BOARD and number % 2:
                    continue  # the sheet's own corners give its origin, and need more touches
                for corner in CORNERS:
                    why = f" once more: the sheet's origin is not known to {GOOD_MM:g} mm yet." if number else "."
                    how = f"Bring the tip to the {corner} corner of {thing}{why}"
                    await touch(visit, f"{kind} {number} {corner}", how, may_skip=True)
                if kind == BOARD:
                    with visit.asked_again_if_refused(BOARD):
                        check_board(all_corners(visit.notebook, BOARD), board_of(visit.notebook))
            with visit.asked_again_if_refused(SHEET):
                fit = fitted(visit.notebook)
            (x, y), (width, height) = fit.origin_mm, fit.size_mm
            reached = "✓" if fit.origin_sigma_mm <= GOOD_MM else "·"
            visit.say(
                f"sheet: {width:.1f} x {height:.1f} mm, turned by {fit.yaw_deg:.2f} deg, leaning by "
                f"{fit.plane.slope_deg:.2f} deg; origin ({x:.2f}, {y:.2f}) mm; residuals up to {fit.worst_mm:.2f} mm "
                f"(above {LEAST_OUTLIER_MM:g} mm, a touch slipped: press esc to go back to it)",
                f"{reached} standard error of the sheet's origin: {fit.origin_sigma_mm:.2f} mm (goal: {GOOD_MM:g} mm)",
            )
            if (sigma_mm := fit.origin_sigma_mm) <= GOOD_MM:
                return
        if sigma_mm > WORST_MM:
            visit.forget(BOARD, SHEET)
            raise NotAccepted(
                f"the standard error of the sheet's origin is {sigma_mm:.2f} mm, limit {WORST_MM:g} mm.",
                "Fix the sheet, hold still while you press Enter, and touch the corners again.",
            )

    def derived(self, notebook: Notebook) -> dict[str, Taught]:
        """Everything that follows from the touched corners and the tip."""
        fit = fitted(notebook)
        plane, sigma_mm = fit.plane, fit.origin_sigma_mm
        # Inside the lowest corner of the sheet: the floor of every press is counted from there.
        corners = inside_corners(fit.size_mm, INSET_MM).tolist()
        point = [round(at, 3) for at in min(corners, key=lambda at: plane.touch_z_mm(at[0], at[1]))]
        touches = len(notebook.touched(BOARD)) + len(notebook.touched(SHEET))
        how = f"{touches} corners of board and sheet touched by hand"
        known = f"residuals up to {fit.worst_mm:.2f} mm"
        leaning = f"the sheet leans by {plane.slope_deg:.2f} deg; not yet measured by zero touch"
        slopes = [plane.z0_mm, plane.slope_x, plane.slope_y]
        return {
            "paper.origin_mm": Taught(list(fit.origin_mm), how, sigma_mm, known),
            "paper.yaw_deg": Taught(fit.yaw_deg, how, fit.yaw_sigma_deg, known),
            "paper.size_mm": Taught(list(fit.size_mm), how, sigma_mm, known),
            "paper.touch_point_mm": Taught(point, "in the sheet's margin, beside every patch"),
            "paper.touch_z_mm": Taught(plane.touch_z_mm(*point), how, fit.depth_sigma_mm, leaning),
            "board.origin_mm": Taught(list(fit.board_origin_mm), how, sigma_mm, known),
            "aside.plane": Taught(slopes, how, fit.depth_sigma_mm, known),
        }


def all_corners(notebook: Notebook, kind: str) -> Corners:
    """The tip at every touch of each corner, in the base frame. Raises `NotAccepted` where a corner was skipped."""
    touched = {name: at for name, at in tips(notebook).items() if name.startswith(kind)}
    corners = [[at for name, at in touched.items() if name.endswith(corner)] for corner in CORNERS]
    if missing := [f"{kind.removesuffix('-corner')} {CORNERS[k]}" for k in range(4) if not corners[k]]:
        raise NotAccepted(
            f"not touched: {', '.join(missing)}.",
            "Board and sheet need all four corners. If the arm does not reach a corner by hand, move board and sheet, "
            "so that all corners are 0.25 to 0.7 m from the arm's foot, or turn the arm's wrist the other way round. "
            "Then touch all corners again.",
        )
    return corners


def fitted(notebook: Notebook) -> SheetFit:
    """The sheet from everything touched so far. Raises `NotAccepted` where a corner was skipped."""
    return fit_sheet(all_corners(notebook, BOARD), all_corners(notebook, SHEET), board_of(notebook))


# From touched corners to the sheet


@dataclass(frozen=True, slots=True)
class SheetFit:
    """The sheet in the base frame, and the board on which it lies in the sheet's frame."""

    origin_mm: tuple[float, float]
    yaw_deg: float
    size_mm: tuple[float, float]
    board_origin_mm: tuple[float, float]
    plane: PaperPlane
    """Through all touched corners."""
    worst_mm: float
    """Largest residual of a touch, along the sheet."""
    origin_sigma_mm: float
    """Standard error of the origin in each axis, at worst."""
    yaw_sigma_deg: float
    depth_sigma_mm: float
    """Standard error of the plane's height in the middle of the sheet."""


def corners_of(size_x_mm: float, size_y_mm: float) -> Floats:
    """(4, 2) corners of a rectangle in the order of `CORNERS`, from its lower left one."""
    return np.array([[0.0, 0.0], [size_x_mm, 0.0], [size_x_mm, size_y_mm], [0.0, size_y_mm]])


def inside_corners(size_mm: Sequence[float], by_mm: float) -> Floats:
    """(4, 2) points inside the corners of a sheet, this far from its edges, in the order of `CORNERS`."""
    middle = np.array(size_mm) / 2.0
    return middle + (corners_of(*size_mm) - middle) * (1.0 - by_mm / middle)


def check_board(board: Corners, spec: BoardSpec) -> None:
    """Raise `NotAccepted` where the touched corners of the board do not form the printed one, and say why.

    Names swapped or given as in a mirror, a print of another size, or one corner that was touched badly.
    """
    printed, (size_x_mm, size_y_mm) = corners_of(*size_mm(spec)), size_mm(spec)
    touched = np.array([np.mean(touches, axis=0)[:2] for touches in board])
    _, scale, off_mm = _similarity(printed, touched)
    if off_mm.max() > WORST_CORNER_MM:
        # Either pair of opposite corners gives the same shape.
        renamed = {
            "as in a mirror": touched * [1.0, -1.0],
            "if two opposite corners are swapped": touched[[2, 1, 0, 3]],
        }
        for a, b in itertools.pairwise([0, 1, 2, 3, 0]):
            swapped = touched.copy()
            swapped[[a, b]] = touched[[b, a]]
            renamed[f"if {CORNERS[a]} and {CORNERS[b]} are swapped"] = swapped
        left_mm, how = min((float(_similarity(printed, points)[2].max()), how) for how, points in renamed.items())
        if left_mm <= max(LEAST_MM, EXPLAINED * off_mm.max()):
            raise NotAccepted(
                f"the corners of the board fit only {how} (off by {off_mm.max():.1f} mm otherwise).",
                "The print's name is along the lower edge. Seen from above, touch the corners counter-clockwise.",
            )
        listed = ", ".join(f"{name} {off:.1f}" for name, off in zip(CORNERS, off_mm, strict=True))
        raise NotAccepted(
            f"the corners of the board do not form its rectangle of {size_x_mm:g} x {size_y_mm:g} mm (off by, in mm: "
            f"{listed}).",
            "Touch the corner that is off again, or correct the description of the print in the camera step.",
        )
    if abs(scale - 1.0) > WORST_SCALE:
        raise NotAccepted(
            f"the board is {100.0 * scale:.1f} % of its printed size: its squares measure "
            f"{scale * spec.square_mm:.2f} mm, not {spec.square_mm:g} mm.",
            "Print it again at 100 %, without `fit to page`, or measure ten squares with calipers and repeat the "
            "camera step with that size.",
        )


def fit_sheet(board: Corners, sheet: Corners, spec: BoardSpec) -> SheetFit:
    """Least squares over all touches of four board corners and four sheet corners; base frame, in mm.

    The board gives most of the turn, the sheet's own corners its origin and its size. Raises `NotAccepted` for a sheet
    that lies askew on its board or whose corners were named otherwise, and `StepError` where it leans too much.
    """
    printed = corners_of(*size_mm(spec))
    (bk, b), (sk, s) = (
        (np.repeat(range(4), [len(touches) for touches in corners]), np.concatenate(corners))
        for corners in (board, sheet)
    )
    yaw0, _, _ = _similarity(printed[bk], b[:, :2])
    _check_straight(np.array([np.mean(touches, axis=0)[:2] for touches in sheet]) @ _rotation(yaw0))

    def off(values: Floats) -> Floats:
        yaw, board_mm, sheet_mm, (width, height) = values[0], values[1:3], values[3:5], values[5:]
        turn = _rotation(yaw)
        board_at, sheet_at = printed[bk] @ turn.T + board_mm, corners_of(width, height)[sk] @ turn.T + sheet_mm
        return np.concatenate([(b[:, :2] - board_at).ravel(), (s[:, :2] - sheet_at).ravel()])

    # But for the turn, what is sought has a linear effect: it may begin anywhere.
    solved = least_squares(off, np.array([yaw0, *b[0, :2], *s[0, :2], *size_mm(spec)]))
    yaw, bx, by, sx, sy, width, height = (float(v) for v in solved.x)
    residuals = np.asarray(solved.fun, np.float64).reshape(-1, 2)
    noise_mm = max(math.sqrt(float((residuals**2).sum()) / max(residuals.size - 7, 1)), HAND_MM)
    slopes = np.asarray(solved.jac, np.float64)
    sigmas = noise_mm * np.sqrt(np.diag(np.linalg.inv(slopes.T @ slopes)))
    points, origin = np.vstack([b, s]), np.array([sx, sy])
    points[:, :2] = (points[:, :2] - origin) @ _rotation(yaw)
    plane, off_mm = fit_plane([(float(x), float(y), float(z)) for x, y, z in points])
    board_x, board_y = (float(v) for v in (np.array([bx, by]) - origin) @ _rotation(yaw))
    above_mm = max(math.sqrt(sum(r * r for r in off_mm) / max(len(points) - 3, 1)), HAND_MM)
    return SheetFit(
        (sx, sy),
        math.degrees(math.remainder(yaw, math.tau)),
        (width, height),
        (board_x, board_y),
        plane,
        float(np.linalg.norm(residuals, axis=1).max()),
        float(max(sigmas[3:5])),
        math.degrees(float(sigmas[0])),
        above_mm / math.sqrt(len(points)),
    )


def _check_straight(corners: Floats) -> None:
    """Raise `NotAccepted` if a sheet lies askew or in a mirror by its (4, 2) corners in the board's directions."""
    lower_left, lower_right, upper_right, upper_left = corners
    along, up = lower_right - lower_left + upper_right - upper_left, upper_left - lower_left + upper_right - lower_right
    if along[0] * up[1] - along[1] * up[0] <= 0.0:
        raise NotAccepted(
            "the sheet's corners were touched clockwise, as in a mirror.", "Touch them counter-clockwise."
        )
    askew_deg = math.degrees(math.atan2(along[1] - up[0], along[0] + up[1]))
    if abs(askew_deg) > ASKEW_DEG:
        raise NotAccepted(
            f"the sheet lies turned by {askew_deg:+.1f} deg on its board.",
            "Lay its edges along the squares, and touch the corners again. The lower left corner of board and sheet is "
            "the one beside the print's name.",
        )


def _rotation(angle: float) -> Floats:
    """(2, 2) turn by an angle in rad."""
    return np.array([[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]])


def _similarity(printed: Floats, touched: Floats) -> tuple[float, float, Floats]:
    """Angle in rad and scale of the best turn and scale of (n, 2) points onto others; (n,) distances that are left."""
    a, b = printed - printed.mean(axis=0), touched - touched.mean(axis=0)
    dot, cross = float((a * b).sum()), float((a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]).sum())
    angle, scale = math.atan2(cross, dot), math.hypot(dot, cross) / float((a**2).sum())
    return angle, scale, np.asarray(np.linalg.norm(b - scale * a @ _rotation(angle).T, axis=1), np.float64)
