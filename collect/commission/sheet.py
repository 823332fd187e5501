"""Step 4: the sheet and the board under it, by their touched corners; and which corners were mistaken.

A sheet that was named turned by half a turn together with its board looks right here; the three marks of the proof's
self-check show it.
"""

from __future__ import annotations

import itertools
import math
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from brushloop.calibrate.board.spec import BoardSpec, size_mm
from brushloop.collect.commission.arm import taught_arm, tip_of, touch
from brushloop.collect.commission.camera import board_of
from brushloop.collect.commission.notebook import Notebook, Taught
from brushloop.collect.commission.step import Step, Visit
from brushloop.collect.errors import NotAccepted
from brushloop.collect.rig.paper import PaperPlane, fit_plane

Floats = NDArray[np.float64]
Point = tuple[float, float, float]
CORNERS = ("lower left", "lower right", "upper right", "upper left")
HAND_MM = 0.15
"""Smallest plausible error of a touch by hand, in one axis."""
WORST_CORNER_MM = 3.0
"""A corner that is off by more than this was not merely touched inaccurately."""
WORST_SCALE = 0.004
"""Relative error of the board's size from which the print is doubted: 1 mm over a page."""
EXPLAINED, LEAST_MM = 0.2, 0.3
"""Names were mixed up if that explains all but this share of the largest misfit, or leaves no more than this."""
ASKEW_DEG = 0.5
"""A sheet that is turned by more against its board must be laid straight: `rig.toml` has one turn for both."""
BOARD, SHEET = "board-corner", "sheet-corner"
THINGS = ((BOARD, "the board's outermost square"), (SHEET, "the sheet"))
GOOD_MM = 0.13
"""Standard error of the sheet's origin, in each axis, at which touching ends."""
MOST_ROUNDS = 5
WORST_MM = 0.25
EASY_M = (0.25, 0.7)
"""Distances from the foot of the arm at which it holds a brush upright without being folded up or stretched out."""
INSET_MM = 2.0
"""Distance of the touch point from the sheet's edges: beside every patch."""


class SheetStep(Step):
    """Origin, turn, size and plane of the sheet, and the board's place on it."""

    name = "sheet"
    title = "Sheet and board"
    minutes = 8
    needs = ("camera", "tip")
    observes = (BOARD, SHEET)

    async def carry_out(self, visit: Visit) -> None:
        """Have the corners touched until the origin is known well enough. Raises `NotAccepted`, `StepError`."""
        visit.say(
            "Lay the board where the sheet will lie, in the middle of the picture, and the sheet on it, its edges "
            "along the squares.",
            "Touch each corner with the brush upright (hold a set square beside it), and hold still.",
        )
        async with taught_arm(visit.notebook) as reader:
            for number in range(MOST_ROUNDS):
                for kind, thing in THINGS:
                    if number and kind == BOARD and number % 2:
                        continue  # the sheet's own corners give its origin, and need more touches
                    for corner in CORNERS:
                        how = f"Bring the tip to the {corner} corner of {thing}" + (" once more." if number else ".")
                        await touch(visit, reader, f"{kind} {number} {corner}", how, may_skip=True)
                    if kind == BOARD:
                        with visit.asked_again_if_refused(BOARD):
                            check_board(all_corners(visit.notebook, BOARD), board_of(visit.notebook))
                with visit.asked_again_if_refused(SHEET):
                    fit = fitted(visit.notebook)
                visit.say(*in_words(fit))
                if fit.origin_sigma_mm <= GOOD_MM:
                    break
            with visit.asked_again_if_refused(BOARD, SHEET):
                if (sigma_mm := fitted(visit.notebook).origin_sigma_mm) > WORST_MM:
                    raise NotAccepted(
                        f"the corner of the sheet is known to {sigma_mm:.2f} mm only.",
                        "Fix the sheet, hold still while you press Enter, and touch the corners again.",
                    )

    def derived(self, notebook: Notebook) -> dict[str, Taught]:
        """Everything that follows from the touched corners and the tip."""
        fit = fitted(notebook)
        plane, sigma_mm, point = fit.plane, fit.origin_sigma_mm, touch_point(fit)
        touches = len(notebook.touched(BOARD)) + len(notebook.touched(SHEET))
        how = f"{touches} corners of board and sheet touched by hand"
        known = f"residuals up to {max(fit.residuals_mm.values()):.2f} mm"
        leaning = f"the sheet leans by {plane.slope_deg:.2f} deg; not yet measured by touch"
        slopes = [plane.z0_mm, plane.slope_x, plane.slope_y]
        return {
            "paper.origin_mm": Taught(list(fit.origin_mm), how, "mm", sigma_mm, known),
            "paper.yaw_deg": Taught(fit.yaw_deg, how, "deg", fit.yaw_sigma_deg, known),
            "paper.size_mm": Taught(list(fit.size_mm), how, "mm", sigma_mm, known),
            "paper.touch_point_mm": Taught(list(point), "beside every patch", "mm"),
            "paper.touch_z_mm": Taught(plane.touch_z_mm(*point), how, "mm", fit.depth_sigma_mm, leaning),
            "board.origin_mm": Taught(list(fit.board_origin_mm), how, "mm", sigma_mm, known),
            "aside.plane": Taught(slopes, how, "mm", fit.depth_sigma_mm, known),
        }


def touch_point(fit: SheetFit) -> tuple[float, float]:
    """Inside the lowest corner of the sheet: the floor of every press is counted from there."""
    points = inside_corners(fit.size_mm, INSET_MM)
    x, y = min(points.tolist(), key=lambda at: fit.plane.touch_z_mm(at[0], at[1]))
    return round(x, 3), round(y, 3)


def all_corners(notebook: Notebook, kind: str) -> dict[str, list[Point]]:
    """The tip at every touch of each corner, in the base frame. Raises `NotAccepted` where a corner was skipped."""
    offset_mm, corners = notebook.numbers("robot.tcp_offset_mm"), defaultdict[str, list[Point]](list)
    for name, flange in notebook.touched(kind).items():
        corners[name.split(" ", 1)[1]].append(tip_of(flange, offset_mm))
    thing = kind.removesuffix("-corner")
    if missing := [f"{thing} {name}" for name in CORNERS if name not in corners]:
        nearest_m, farthest_m = EASY_M
        raise NotAccepted(
            f"not touched: {', '.join(missing)}.",
            "All four corners of both are needed. What the arm does not reach by hand is out of its reach: move the "
            f"board with the sheet, so that all corners are {nearest_m:g} to {farthest_m:g} m from the arm's foot, or "
            "turn its wrist the other way round, and touch all corners again.",
        )
    return dict(corners)


def fitted(notebook: Notebook) -> SheetFit:
    """The sheet from everything touched so far. Raises `NotAccepted` where a corner was skipped."""
    return fit_sheet(all_corners(notebook, BOARD), all_corners(notebook, SHEET), board_of(notebook))


def in_words(fit: SheetFit) -> tuple[str, ...]:
    """The result in words for the person."""
    (x, y), (width, height) = fit.origin_mm, fit.size_mm
    worst = max(fit.residuals_mm, key=lambda name: fit.residuals_mm[name])
    return (
        f"sheet of {width:.1f} x {height:.1f} mm, origin ({x:.2f}, {y:.2f}) mm, known to {fit.origin_sigma_mm:.2f} mm "
        f"(goal {GOOD_MM:g}), turned by {fit.yaw_deg:.2f} +- {fit.yaw_sigma_deg:.2f} deg, leaning by "
        f"{fit.plane.slope_deg:.2f} deg",
        f"largest residual: {worst}, {fit.residuals_mm[worst]:.2f} mm; "
        f"the board measures {100 * fit.scale:.2f} % of its printed size",
    )


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
    residuals_mm: dict[str, float]
    """Residual of each touch, along the sheet."""
    origin_sigma_mm: float
    """Standard error of the origin in each axis, at worst."""
    yaw_sigma_deg: float
    depth_sigma_mm: float
    """Standard error of the plane's height in the middle of the sheet."""
    scale: float
    """Touched over printed size of the board."""


def corners_of(size_x_mm: float, size_y_mm: float) -> Floats:
    """(4, 2) corners of a rectangle in the order of `CORNERS`, from its lower left one."""
    return np.array([[0.0, 0.0], [size_x_mm, 0.0], [size_x_mm, size_y_mm], [0.0, size_y_mm]])


def inside_corners(size_mm: tuple[float, float], by_mm: float) -> Floats:
    """(4, 2) points inside the corners of a sheet, this far from its edges, in the order of `CORNERS`."""
    middle = np.array(size_mm) / 2.0
    return middle + (corners_of(*size_mm) - middle) * (1.0 - by_mm / middle)


def check_board(board: Mapping[str, Sequence[Point]], spec: BoardSpec) -> None:
    """Raise `NotAccepted` where the touched corners of the board do not form the printed one, and say why.

    Names swapped or given as in a mirror, a print of another size, or one corner that was touched badly.
    """
    printed = corners_of(*size_mm(spec))
    touched = np.array([np.mean(board[name], axis=0)[:2] for name in CORNERS])
    if problem := _mixed_up(touched, printed):
        raise NotAccepted(
            f"the corners of the board {problem}.",
            "The name on the print is along its lower edge; seen from above, the corners follow counter-clockwise.",
        )
    _, scale = _turn_and_scale(printed, touched)
    distances = _distances(printed * scale, touched)
    if max(distances) > WORST_CORNER_MM:
        listed = ", ".join(f"{name} {off:.1f}" for name, off in zip(CORNERS, distances, strict=True))
        size_x_mm, size_y_mm = size_mm(spec)
        raise NotAccepted(
            f"the corners of the board do not form its rectangle of {size_x_mm:g} x {size_y_mm:g} mm (off by, in mm: "
            f"{listed}).",
            "Touch the corner that is off again, or correct the description of the print in the camera step.",
        )
    if abs(scale - 1.0) > WORST_SCALE:
        raise NotAccepted(
            f"the board is {100.0 * scale:.1f} % of its printed size: its squares measure "
            f"{scale * spec.square_mm:.2f} mm, not {spec.square_mm:g} mm.",
            "Print it again at 100 %, without `fit to page`, or measure ten squares with calipers and teach the camera "
            "again with that size.",
        )


def _mixed_up(touched: Floats, printed: Floats) -> str:
    """Why the corners do not fit: a mirror, or two names that were exchanged; empty if nothing explains it."""
    as_named = max(_distances(printed, touched))
    if as_named <= WORST_CORNER_MM:
        return ""
    enough_mm = max(LEAST_MM, EXPLAINED * as_named)
    if max(_distances(printed, touched * [1.0, -1.0])) <= enough_mm:
        return (
            f"fit only as in a mirror (off by {as_named:.1f} mm otherwise): were they named from the other side, or is "
            "the photograph mirrored?"
        )
    exchanges = list[tuple[float, str]]()
    for a, b in itertools.combinations(range(len(CORNERS)), 2):
        exchanged = touched.copy()
        exchanged[[a, b]] = touched[[b, a]]
        exchanges.append((max(_distances(printed, exchanged)), f"{CORNERS[a]} and {CORNERS[b]}"))
    off_mm, pair = min(exchanges)
    if off_mm > enough_mm:
        return ""
    return f"fit only if {pair} are swapped (off by {as_named:.1f} mm otherwise): one was touched in the other's place"


def fit_sheet(board: Mapping[str, Sequence[Point]], sheet: Mapping[str, Sequence[Point]], spec: BoardSpec) -> SheetFit:
    """Least squares over all touches of four board corners and four sheet corners, by name; base frame, in mm.

    The board gives most of the turn, the sheet's own corners its origin and its size. Raises `NotAccepted` for a sheet
    that lies askew on its board or whose corners were named otherwise, and `StepError` where it leans too much.
    """
    printed = corners_of(*size_mm(spec))
    on_board = [(CORNERS.index(name), point) for name, points in board.items() for point in points]
    on_sheet = [(CORNERS.index(name), point) for name, points in sheet.items() for point in points]
    b, bk = np.array([p[:2] for _, p in on_board]), [k for k, _ in on_board]
    s, sk = np.array([p[:2] for _, p in on_sheet]), [k for k, _ in on_sheet]
    _check_askew(b, bk, s, sk, printed)

    def off(values: Floats) -> Floats:
        yaw, bx, by, sx, sy, width, height = values
        turn = _rotation(yaw)
        board_at, sheet_at = printed[bk] @ turn.T + [bx, by], corners_of(width, height)[sk] @ turn.T + [sx, sy]
        return np.concatenate([(b - board_at).ravel(), (s - sheet_at).ravel()])

    yaw0, scale = _turn_and_scale(printed[bk], b)
    local = s @ _rotation(yaw0)
    low, high = local.min(axis=0), local.max(axis=0)
    board0 = b.mean(axis=0) - _rotation(yaw0) @ printed[bk].mean(axis=0)
    solved = least_squares(off, np.array([yaw0, *board0, *(_rotation(yaw0) @ low), *(high - low)]))
    yaw, bx, by, sx, sy, width, height = (float(v) for v in solved.x)
    residuals = np.asarray(solved.fun, np.float64).reshape(-1, 2)
    noise_mm = max(math.sqrt(float((residuals**2).sum()) / max(residuals.size - 7, 1)), HAND_MM)
    slopes = np.asarray(solved.jac, np.float64)
    sigmas = noise_mm * np.sqrt(np.diag(np.linalg.inv(slopes.T @ slopes)))
    turn, origin = _rotation(yaw), np.array([sx, sy])
    board_x, board_y = (float(v) for v in (np.array([bx, by]) - origin) @ turn)
    points = [p for _, p in (*on_board, *on_sheet)]
    plane = fit_plane([(*((np.array(p[:2]) - origin) @ turn).tolist(), p[2]) for p in points])
    names = [f"board {CORNERS[k]}" for k in bk] + [f"sheet {CORNERS[k]}" for k in sk]
    lengths = [float(v) for v in np.linalg.norm(residuals, axis=1)]
    above_mm = max(math.sqrt(sum(r * r for r in plane.residuals_mm) / max(len(points) - 3, 1)), HAND_MM)
    return SheetFit(
        (sx, sy),
        math.degrees(math.remainder(yaw, math.tau)),
        (width, height),
        (board_x, board_y),
        plane.plane,
        {f"{name} {number}": length for number, (name, length) in enumerate(zip(names, lengths, strict=True), 1)},
        float(max(sigmas[3:5])),
        math.degrees(float(sigmas[0])),
        above_mm / math.sqrt(len(points)),
        scale,
    )


def _check_askew(b: Floats, bk: list[int], s: Floats, sk: list[int], printed: Floats) -> None:
    mean = [s[[k for k, number in enumerate(sk) if number == corner]].mean(axis=0) for corner in range(4)]
    along = (mean[1] - mean[0]) + (mean[2] - mean[3])
    up = (mean[3] - mean[0]) + (mean[2] - mean[1])
    if along[0] * up[1] - along[1] * up[0] <= 0.0:
        raise NotAccepted(
            "the corners of the sheet were named as in a mirror.", "Seen from above they follow counter-clockwise."
        )
    own = math.atan2(along[1] - up[0], along[0] + up[1])
    askew = math.degrees(math.remainder(own - _turn_and_scale(printed[bk], b)[0], math.tau))
    if abs(askew) > ASKEW_DEG:
        raise NotAccepted(
            f"the sheet lies turned by {askew:+.1f} deg on its board.",
            "Lay its edges along the squares, and touch again; the lower left corner of both is the one beside the "
            "print's name.",
        )


def _rotation(angle: float) -> Floats:
    """(2, 2) turn by an angle in rad."""
    return np.array([[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]])


def _turn_and_scale(printed: Floats, touched: Floats) -> tuple[float, float]:
    """Angle in rad of the rigid fit, and touched over printed size."""
    a, b = printed - printed.mean(axis=0), touched - touched.mean(axis=0)
    dot, cross = float((a * b).sum()), float((a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]).sum())
    return math.atan2(cross, dot), math.hypot(dot, cross) / float((a**2).sum())


def _distances(printed: Floats, touched: Floats) -> list[float]:
    """Residuals of the rigid fit."""
    turn = _rotation(_turn_and_scale(printed, touched)[0])
    off = touched - touched.mean(axis=0) - (printed - printed.mean(axis=0)) @ turn.T
    return [float(v) for v in np.linalg.norm(off, axis=1)]
