"""The self-check before a session: press an uneven triangle of marks, find them, refuse a mirrored or turned rig.

A stroke library can be flipped for months before anybody notices; three marks show it in a minute.
"""

from __future__ import annotations

import asyncio
import itertools
import math
from collections.abc import Sequence, Set

import numpy as np

from brushloop.calibrate.board.lens import Floats
from brushloop.collect.errors import StepError
from brushloop.collect.motion import Dip, Procedures, mark_moves
from brushloop.collect.rig.config import SelfCheckConfig
from brushloop.collect.rig.devices import Rig
from brushloop.collect.rig.paper import Patch, Sheet
from brushloop.collect.touch.camera import new_marks
from brushloop.drivers.devices import Frame
from brushloop.sessions.events import SelfCheckResult

Triangle = tuple[tuple[float, float], tuple[float, float], tuple[float, float]]

UNEVEN = 0.2
"""Least misfit of the second best order of the marks; below it, a mirror image could be taken for a turn."""
LEGS_MM = 24.0, 15.0
"""Legs along paper x and y of a triangle within one patch; unequal, so that no corner is mistaken for another."""
LEAST_SPAN_MM = 60.0
"""Least extent of a wide triangle along either axis."""
MOST_OF_SHEET = 0.25
"""Largest share of a sheet's patches that a check may take; smaller sheets are checked in one patch."""
MARK_MM = 0.3
"""How far one mark's centre may lie from where the others imply: no two presses bend the hairs alike. To distinguish
2 % from 1 %, a triangle must extend over more than 50 mm along both axes."""
LEAST_MARK_MM2, MOST_MARK_MM2 = 1.0, 400.0
"""More ink than any mark has: a brush that is pressed 10 mm deep leaves less."""
MIRRORS: dict[str, tuple[tuple[float, float], tuple[float, float]]] = {
    "mirrored in x": ((-1.0, 0.0), (0.0, 1.0)),
    "mirrored in y": ((1.0, 0.0), (0.0, -1.0)),
    "mirrored: x and y are swapped": ((0.0, 1.0), (1.0, 0.0)),
    "mirrored: x and y are swapped and negated": ((0.0, -1.0), (-1.0, 0.0)),
}


def partners(sheet: Sheet, patch: Patch, used: Set[int]) -> tuple[Patch, ...]:
    """Two free patches that make a wide triangle with this one, along its row and its column; empty without room.

    With marks known to a few tenths of a millimetre, a wide triangle distinguishes an error of 2 % from one of 1 %.
    """
    if sheet.capacity * MOST_OF_SHEET < 3:
        return ()
    row, column = divmod(patch.index, sheet.columns)
    free = [sheet.patch(index) for index in range(sheet.capacity) if index not in used and index != patch.index]
    x_mm, y_mm = patch.anchor_mm
    along_row = [c for c in free if c.index // sheet.columns == row and abs(c.anchor_mm[0] - x_mm) >= LEAST_SPAN_MM]
    along_column = [
        c for c in free if c.index % sheet.columns == column and abs(c.anchor_mm[1] - y_mm) >= LEAST_SPAN_MM
    ]
    # The farthest first: a square sheet needs a nearer one on one side, or the triangle would be too even.
    pairs = sorted(
        itertools.product(along_row, along_column),
        key=lambda pair: -abs(pair[0].anchor_mm[0] - x_mm) * abs(pair[1].anchor_mm[1] - y_mm),
    )
    wide = (pair for pair in pairs if _second_best(np.array([corner.anchor_mm for corner in (patch, *pair)])) >= UNEVEN)
    return next(wide, ())


def triangle_on(patches: Sequence[Patch]) -> Triangle:
    """One place in each of three patches, as far apart as the corners of the sheet, or three within the only one.

    Those within one patch are too close together to show a small error of scale. Raises `StepError` if they do not fit.
    """
    if len(patches) > 1:
        a, b, c = (patch.anchor_mm for patch in patches)
        return a, b, c
    [patch], (x_mm, y_mm) = patches, LEGS_MM
    if x_mm > patch.size_x_mm or y_mm > patch.size_y_mm:
        raise StepError(f"a triangle of {x_mm:g} by {y_mm:g} mm does not fit into patch {patch.index}")
    left, bottom = patch.x_mm + 0.5 * (patch.size_x_mm - x_mm), patch.y_mm + 0.5 * (patch.size_y_mm - y_mm)
    return (left, bottom), (left + x_mm, bottom), (left, bottom + y_mm)


async def self_check(procedures: Procedures, places_mm: Triangle, dip: Dip) -> SelfCheckResult:
    """Press the marks, photograph them and judge. The arm begins and ends at travel height; the patches are used up.

    Raises `StepError` with the figures if the marks are not found, mirrored, turned, stretched or displaced.
    """
    rig, plane = procedures.rig, procedures.plane
    config, commanded = rig.config.self_check, np.array(places_mm, np.float64)
    async with procedures.lifted_after():
        before = await procedures.photographer.photograph()
        for x_mm, y_mm in places_mm:
            await dip()
            above, near, *pressing = mark_moves(rig.config, plane, x_mm, y_mm)
            await procedures.go(above, near)
            await procedures.queue(pressing)
        after = await procedures.photographer.photograph()
    found_mm = await asyncio.to_thread(_find, rig, before, after)
    return judge(commanded, found_mm, config)


def _find(rig: Rig, before: Frame, after: Frame) -> Floats:
    try:
        marks = new_marks(rig.config, before, after, LEAST_MARK_MM2)
    except StepError as error:
        # A board in a mirrored picture is not seen either.
        raise StepError(f"self-check: {error}") from None
    if marks and marks[0].ink_mm2 > MOST_MARK_MM2:
        large = marks[0]
        raise StepError(
            f"self-check: {large.ink_mm2:.0f} mm2 at ({large.x_mm:.0f}, {large.y_mm:.0f}) mm became dark, more than "
            "a mark: is the arm, or its shadow, in the picture? See motion.park_mm"
        )
    if len(marks) != 3:
        listed = "; ".join(f"{m.ink_mm2:.1f} mm2 at ({m.x_mm:.0f}, {m.y_mm:.0f})" for m in marks[:6])
        raise StepError(
            f"self-check: 3 marks were pressed, new marks seen: {len(marks)} ({listed or 'none'}). "
            "Was the sheet blank where they were pressed, is there ink on the brush, and does the camera see the place?"
        )
    return np.array([(m.x_mm, m.y_mm) for m in marks], np.float64)


def judge(commanded_mm: Floats, found_mm: Floats, config: SelfCheckConfig) -> SelfCheckResult:
    """Compare three found marks, in any order, with the commanded ones; both are (3, 2).

    There is one affine map for each order of three points; the right order is the one whose map keeps angles best.
    Raises `StepError` with the figures if the map mirrors, or turns, stretches or displaces beyond the limits.
    """
    orders = [found_mm[list(order)] for order in itertools.permutations(range(3))]
    found, linear = min(((f, _linear(commanded_mm, f)) for f in orders), key=lambda pair: _unlike(pair[1]))
    if np.linalg.det(linear) < 0.0:
        name = max(MIRRORS, key=lambda n: float((np.array(MIRRORS[n]) * linear).sum()))
        raise _refused(
            f"the marks are {name}", found, "Check paper.origin_mm, paper.yaw_deg, board origin and camera mounting"
        )
    turn = math.atan2(linear[1, 0] - linear[0, 1], linear[0, 0] + linear[1, 1])
    if abs(math.degrees(turn)) > config.turn_deg:
        what = f"the marks are turned by {math.degrees(turn):+.2f} deg, limit {config.turn_deg:g}"
        raise _refused(what, found, "Check paper.yaw_deg and how the board lies")
    scale = float(np.linalg.norm(linear[:, 0])), float(np.linalg.norm(linear[:, 1]))
    spans = np.ptp(commanded_mm, axis=0)
    if any(abs(s - 1.0) > config.scale + MARK_MM / span for s, span in zip(scale, spans, strict=True)):
        listed = " and ".join(f"{100.0 * (s - 1.0):+.2f} % along {axis}" for s, axis in zip(scale, "xy", strict=True))
        raise _refused(
            f"lengths are off by {listed}, limit {100.0 * config.scale:g} %", found, "Check the board's square_mm"
        )
    offset = (found - commanded_mm).mean(axis=0)
    if float(np.linalg.norm(offset)) > config.offset_mm:
        what = f"the marks lie off by ({offset[0]:+.2f}, {offset[1]:+.2f}) mm, limit {config.offset_mm:g} mm"
        raise _refused(what, found, "Check paper.origin_mm and the board's origin")
    rotation = np.array([[math.cos(turn), -math.sin(turn)], [math.sin(turn), math.cos(turn)]])
    left = (found - found.mean(axis=0)) - (commanded_mm - commanded_mm.mean(axis=0)) @ rotation.T
    return SelfCheckResult(
        sheet=0,
        patches=(),
        commanded_mm=commanded_mm.tolist(),
        found_mm=found.tolist(),
        offset_mm=(float(offset[0]), float(offset[1])),
        turn_deg=math.degrees(turn),
        scale=scale,
        residuals_mm=tuple(float(v) for v in np.linalg.norm(left, axis=1)),
    )


def _linear(commanded_mm: Floats, found_mm: Floats) -> Floats:
    """(2, 2): the linear part of the affine map from one triangle to the other."""
    edges_mm, found_edges_mm = commanded_mm[1:] - commanded_mm[0], found_mm[1:] - found_mm[0]
    return np.asarray(np.linalg.solve(edges_mm, found_edges_mm), np.float64).T


def _second_best(commanded_mm: Floats) -> float:
    """Error in the angles for the best of the wrong orders of a triangle's corners."""
    wrong = list(itertools.permutations(range(3)))[1:]
    return min(_unlike(_linear(commanded_mm, commanded_mm[list(order)])) for order in wrong)


def _unlike(linear: Floats) -> float:
    """How far a map is from one that keeps angles; 0 for turns, mirrors and even scales."""
    area = abs(float(np.linalg.det(linear)))
    return math.inf if area < 1e-9 else float(np.abs(linear.T @ linear / area - np.eye(2)).max())


def _refused(what: str, found_mm: Floats, remedy: str) -> StepError:
    listed = ", ".join(f"({x:.1f}, {y:.1f})" for x, y in found_mm)
    return StepError(f"self-check: {what}. The marks are at {listed} mm. {remedy}.")
