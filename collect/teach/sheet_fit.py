"""Where sheet and board lie, from their touched corners and by the camera; and which corners were mistaken."""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from brushloop.calibrate.board.lens import apply, homography
from brushloop.calibrate.board.pix2len import paper_mm
from brushloop.calibrate.board.spec import BoardSpec, BoardView, size_mm
from brushloop.collect.errors import CannotTeach
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


def check_board(board: Mapping[str, Sequence[Point]], spec: BoardSpec) -> None:
    """Raise `CannotTeach` where the touched corners of the board do not form the printed one, and say why.

    Names swapped or given as in a mirror, a print of another size, or one corner that was touched badly.
    """
    printed = corners_of(*size_mm(spec))
    touched = np.array([np.mean(board[name], axis=0)[:2] for name in CORNERS])
    if problem := _mixed_up(touched, printed):
        raise CannotTeach(
            f"the corners of the board {problem}.",
            "The name on the print is along its lower edge; seen from above, the corners follow counter-clockwise.",
        )
    _, scale = _turn_and_scale(printed, touched)
    distances = _distances(printed * scale, touched)
    if max(distances) > WORST_CORNER_MM:
        listed = ", ".join(f"{name} {off:.1f}" for name, off in zip(CORNERS, distances, strict=True))
        size_x_mm, size_y_mm = size_mm(spec)
        raise CannotTeach(
            f"the corners of the board do not form its rectangle of {size_x_mm:g} x {size_y_mm:g} mm (off by, in mm: "
            f"{listed}).",
            "Touch the corner that is off again, or correct the description of the print in the camera step.",
        )
    if abs(scale - 1.0) > WORST_SCALE:
        raise CannotTeach(
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

    The board gives most of the turn, the sheet's own corners its origin and its size. Raises `CannotTeach` for a sheet
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
    mean = [s[[k for k, one in enumerate(sk) if one == corner]].mean(axis=0) for corner in range(4)]
    along = (mean[1] - mean[0]) + (mean[2] - mean[3])
    up = (mean[3] - mean[0]) + (mean[2] - mean[1])
    if along[0] * up[1] - along[1] * up[0] <= 0.0:
        raise CannotTeach(
            "the corners of the sheet were named as in a mirror.", "Seen from above they follow counter-clockwise."
        )
    own = math.atan2(along[1] - up[0], along[0] + up[1])
    askew = math.degrees(math.remainder(own - _turn_and_scale(printed[bk], b)[0], math.tau))
    if abs(abs(askew) - 180.0) < 30.0 or abs(abs(askew) - 90.0) < 30.0:
        raise CannotTeach(
            f"the corners of the sheet were named turned by {askew:.0f} deg against those of the board.",
            "The lower left corner of both is the one beside the print's name.",
        )
    if abs(askew) > ASKEW_DEG:
        raise CannotTeach(
            f"the sheet lies turned by {askew:+.1f} deg on its board.", "Lay its edges along the squares; touch again."
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


# Where the camera sees the sheet end on its board


Margins = tuple[float, float, float, float]
"""How much of the board is free beside the sheet in mm: left, right, lower, upper."""
SIDES = ("left", "right", "lower", "upper")
STEP_MM = 0.25
MIDDLE = 0.5
"""Share of the sheet's width or height over which an edge is looked for: corners may be bent."""
LEAST_CONTRAST = 12.0
"""Least difference in gray levels between the board's pattern and the plain sheet, as standard deviations along it."""
TIMES_PLAIN = 2.5
"""Least ratio of the two: a board without a sheet must not pass for plain paper."""
OFF_MM = 2.5
"""A touched edge that the camera sees farther off than this is doubted: hand and camera together err by 1 mm."""
MISTAKEN = (
    ((1, 0, 3, 2), "the corners were named turned by half a turn: upper for lower, right for left"),
    ((1, 0, 2, 3), "left and right corners were taken for one another, as in a mirror"),
    ((0, 1, 3, 2), "lower and upper corners were taken for one another, as in a mirror"),
)
"""Which touched side each seen one is, if corners were taken for one another."""


def touched_margins(fit: SheetFit, spec: BoardSpec) -> Margins:
    """As they follow from the touched corners."""
    (x, y), (width, height), (board_width, board_height) = fit.board_origin_mm, fit.size_mm, size_mm(spec)
    return -x, board_width + x - width, -y, board_height + y - height


def seen_margins(image: NDArray[np.uint8], view: BoardView, spec: BoardSpec, touched: Margins) -> Margins | None:
    """Where the board's pattern ends on each side, looking outward from the middle of the touched sheet.

    `image` is an undistorted photograph, `view` its board, whose spec has its origin at (0, 0). None where an edge is
    not seen.
    """
    left, right, lower, upper = touched
    board = np.array(size_mm(spec))
    to_pixels = homography(paper_mm(view, spec), view.pixels, "camera")
    middle = (np.array([left - right, lower - upper]) + board) / 2.0
    half = MIDDLE * (board - [left + right, lower + upper]) / 2.0
    seen: list[float] = []
    for axis, outward in ((0, -1), (0, 1), (1, -1), (1, 1)):
        far = middle[axis] if outward < 0 else board[axis] - middle[axis]
        out_mm = np.arange(0.0, far, STEP_MM)
        beside_mm = np.arange(-half[1 - axis], half[1 - axis], STEP_MM)
        points = np.empty((len(out_mm), len(beside_mm), 2))
        points[..., axis] = middle[axis] + outward * out_mm[:, None]
        points[..., 1 - axis] = middle[1 - axis] + beside_mm
        at = apply(to_pixels, points.reshape(-1, 2)).reshape(points.shape).astype(np.float32)
        gray = cv2.remap(image, at[..., 0], at[..., 1], cv2.INTER_LINEAR)
        # The spread along the edge rises from that of plain paper to that of the pattern.
        spread = np.asarray(gray, np.float64).std(axis=1)
        plain, pattern = float(np.median(spread[: len(spread) // 3])), float(np.quantile(spread, 0.95))
        if pattern - plain < LEAST_CONTRAST or pattern < TIMES_PLAIN * plain:
            return None
        seen.append(float(far - out_mm[int(np.argmax(spread > (plain + pattern) / 2.0))]))
    return seen[0], seen[1], seen[2], seen[3]


def check_seen(seen: Margins, touched: Margins) -> float:
    """How far the touched edges are from the seen ones at worst, in mm.

    Raises `CannotTeach` where that is more than `OFF_MM`, and says whether sides were taken for one another.
    """

    def off_mm(sides: tuple[int, ...]) -> float:
        return max(abs(seen[k] - touched[side]) for k, side in enumerate(sides))

    if (as_named_mm := off_mm((0, 1, 2, 3))) <= OFF_MM:
        return as_named_mm
    for sides, what in MISTAKEN:
        if off_mm(sides) <= OFF_MM:
            raise CannotTeach(
                f"the camera sees the sheet elsewhere on its board: {what}.",
                "Touch the corners of board and sheet again; lower left is the one beside the beginning of its name.",
            )
    pairs = zip(SIDES, seen, touched, strict=True)
    listed = ", ".join(f"{side} {far:.1f} mm ({by_hand:.1f} touched)" for side, far, by_hand in pairs)
    raise CannotTeach(
        f"the camera sees other margins of the board beside the sheet than were touched: {listed}.",
        "Sheet or board has moved, or a corner was touched beside the sheet: touch all corners again.",
    )
