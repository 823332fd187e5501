"""Step 4: the sheet and the board under it, by their touched corners."""

from __future__ import annotations

import asyncio
from collections import defaultdict

import numpy as np

from brushloop.calibrate.board.detect import find_board
from brushloop.calibrate.board.lens import read_lens
from brushloop.calibrate.errors import CalibrationError
from brushloop.collect.errors import CannotTeach
from brushloop.collect.teach.arm import ArmReader, taught_arm, tip_of, touch
from brushloop.collect.teach.camera import board_of, still, taught_camera
from brushloop.collect.teach.day import Day, Step, Target, TargetKind
from brushloop.collect.teach.sheet_fit import (
    CORNERS,
    OFF_MM,
    Point,
    SheetFit,
    check_board,
    check_seen,
    corners_of,
    fit_sheet,
    seen_margins,
    touched_margins,
)
from brushloop.collect.teach.store import Notebook, Taught, taught

BOARD: TargetKind = "board-corner"
SHEET: TargetKind = "sheet-corner"
THINGS: tuple[tuple[TargetKind, str], ...] = ((BOARD, "the board's outermost square"), (SHEET, "the sheet"))
GOOD_MM = 0.13
"""Standard error of the sheet's origin, in each axis, at which touching ends."""
MOST_ROUNDS = 5
WORST_MM = 0.25
EASY_M = (0.25, 0.7)
"""Distances from the foot of the arm at which it holds a brush upright without being folded up or stretched out."""
VIEW, SEEN = "sheet-view", "aside.sheet_seen"
INSET_MM = 2.0
"""Distance of the touch point from the sheet's edges: beside every patch."""


class SheetStep(Step):
    """Origin, turn, size and plane of the sheet, and the board's place on it."""

    name = "sheet"
    title = "Sheet and board"
    minutes = 8
    needs = ("camera", "tip")
    observes = (BOARD, SHEET, VIEW, SEEN)

    async def teach(self, day: Day) -> None:
        """Have the corners touched until the origin is known well enough. Raises `CannotTeach`, `StepError`."""
        await day.say(
            "Lay the board where the sheet will lie, in the middle of the picture, and the sheet on it, its edges "
            "along the squares.",
            "Touch each corner with the brush upright (hold a set square beside it), and hold still.",
        )
        async with taught_arm(day.notebook) as reader:
            for number in range(MOST_ROUNDS):
                for kind, thing in THINGS:
                    if number and kind == BOARD and number % 2:
                        continue  # the sheet's own corners give its origin, and need more touches
                    for corner in CORNERS:
                        how = f"Bring the tip to the {corner} corner of {thing}" + (" once more." if number else ".")
                        target = Target(kind, number, corner)
                        await touch(day, reader, target, how, f"{kind} {number} {corner}", may_skip=True)
                    if kind == BOARD:
                        with day.asked_again_if_refused(BOARD):
                            check_board(all_corners(day.notebook, BOARD), board_of(day.notebook))
                with day.asked_again_if_refused(SHEET):
                    fit = fitted(day.notebook)
                await day.say(*in_words(fit))
                if fit.origin_sigma_mm <= GOOD_MM:
                    break
            with day.asked_again_if_refused(BOARD, SHEET):
                if (sigma_mm := fitted(day.notebook).origin_sigma_mm) > WORST_MM:
                    raise CannotTeach(
                        f"the corner of the sheet is known to {sigma_mm:.2f} mm only.",
                        "Fix the sheet, hold still while you press Enter, and touch the corners again.",
                    )
            if SEEN not in day.notebook.values:
                await self._seen(day, reader)

    async def _seen(self, day: Day, reader: ArmReader) -> None:
        """Compare the touched sheet with the one that the camera sees on the board. Raises `CannotTeach`."""
        how = "Guide the arm so far away that it hides neither board nor sheet from the camera."
        if await touch(day, reader, Target("clear-view", 1), how, f"{VIEW} 0", may_skip=True) is None:
            found = "not checked against the camera: the arm was in its way"
        else:
            await day.working("looking for the sheet's edges on the board")
            with day.asked_again_if_refused(BOARD, SHEET, VIEW):
                found = await _compared(day)
        await day.say(f"The sheet: {found}.", tone="warning" if found.startswith("not") else "finding")
        day.keep("sheet", SEEN, found, "the edges of the sheet on the board, in one picture")

    def derived(self, notebook: Notebook) -> dict[str, Taught]:
        """Everything that follows from the touched corners and the tip."""
        fit = fitted(notebook)
        plane, sigma_mm, point = fit.plane, fit.origin_sigma_mm, touch_point(fit)
        touches = len(notebook.touched(BOARD)) + len(notebook.touched(SHEET))
        how = f"{touches} corners of board and sheet touched by hand"
        known = (
            f"residuals up to {max(fit.residuals_mm.values()):.2f} mm; "
            f"{notebook.get(SEEN) or 'not checked against the camera'}"
        )
        leaning = f"the sheet leans by {plane.slope_deg:.2f} deg; not yet measured by touch"
        z_mm, depth_mm = plane.touch_z_mm(*point), fit.depth_sigma_mm
        return {
            "paper.origin_mm": taught("sheet", list(fit.origin_mm), how, "mm", sigma=sigma_mm, known=known),
            "paper.yaw_deg": taught("sheet", fit.yaw_deg, how, "deg", sigma=fit.yaw_sigma_deg, known=known),
            "paper.size_mm": taught("sheet", list(fit.size_mm), how, "mm", sigma=sigma_mm, known=known),
            "paper.touch_point_mm": taught("sheet", list(point), "beside every patch", "mm"),
            "paper.touch_z_mm": taught("sheet", z_mm, how, "mm", sigma=depth_mm, known=leaning),
            "board.origin_mm": taught("sheet", list(fit.board_origin_mm), how, "mm", sigma=sigma_mm, known=known),
            "aside.plane": taught(
                "sheet", [plane.z0_mm, plane.slope_x, plane.slope_y], how, "mm", sigma=depth_mm, known=known
            ),
        }


async def _compared(day: Day) -> str:
    """What the camera says of the touched sheet. Raises `CannotTeach` where it sees it elsewhere."""
    spec, fit = board_of(day.notebook), fitted(day.notebook)
    touched = touched_margins(fit, spec)
    try:
        async with taught_camera(day.notebook, day.clock) as camera:
            picture = await still(camera, day.clock)
        if (file := day.notebook.get("camera.lens_file")) is not None:
            lens = read_lens(day.rig_path.parent / str(file))
            lens.check_size(picture, "camera")
            picture = lens.undistort(picture)
        view = await asyncio.to_thread(find_board, picture, spec, "camera")
        seen = await asyncio.to_thread(seen_margins, picture, view, spec, touched)
    except CalibrationError as error:
        return f"not checked against the camera: {error.what}"
    if seen is None:
        return "not checked against the camera: it does not see all edges of the sheet"
    return f"the camera sees its edges within {check_seen(seen, touched):.1f} mm (at most {OFF_MM:g})"


def touch_point(fit: SheetFit) -> tuple[float, float]:
    """Inside the lowest corner of the sheet: the floor of every press is counted from there."""
    middle = np.array(fit.size_mm) / 2.0
    points = middle + (corners_of(*fit.size_mm) - middle) * (1.0 - INSET_MM / middle)
    x, y = min(points.tolist(), key=lambda at: fit.plane.touch_z_mm(at[0], at[1]))
    return round(x, 3), round(y, 3)


def all_corners(notebook: Notebook, kind: TargetKind) -> dict[str, list[Point]]:
    """The tip at every touch of each corner, in the base frame. Raises `CannotTeach` where a corner was skipped."""
    offset_mm, found = notebook.numbers("robot.tcp_offset_mm"), defaultdict[str, list[Point]](list)
    for name, flange in notebook.touched(kind).items():
        found[name.split(" ", 1)[1]].append(tip_of(flange, offset_mm))
    thing = kind.removesuffix("-corner")
    if missing := [f"{thing} {name}" for name in CORNERS if name not in found]:
        nearest_m, farthest_m = EASY_M
        raise CannotTeach(
            f"not touched: {', '.join(missing)}.",
            "All four corners of both are needed. What the arm does not reach by hand is out of its reach: move the "
            f"board with the sheet, so that all corners are {nearest_m:g} to {farthest_m:g} m from the arm's foot, or "
            "turn its wrist the other way round, and touch all corners again.",
        )
    return dict(found)


def fitted(notebook: Notebook) -> SheetFit:
    """The sheet from everything touched so far. Raises `CannotTeach` where a corner was skipped."""
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
