"""The quality check of a capture: one entry, ordered checks, a verdict in words."""

from __future__ import annotations

import numpy as np

from calibrate.board.scale import PlaneFit
from calibrate.stroke.preprocess import PX_PER_MM, Gray, Params
from collect.quality import ink_checks, picture_checks, shape_checks
from collect.quality.ink import Ink, mm2, tell_apart
from collect.quality.mark import measure_mark
from collect.quality.patch import Point, Rect, around, take
from collect.quality.verdict import Check, Failure, Verdict
from collect.rig.config_quality import QualityConfig
from collect.rig.paper import Cell

MARGIN_MM = 4.0
"""Around the cell, where a stroke that leaves it may be found."""
FAR_MM = 45.0
"""Around the cell, where a press that left nothing in it is looked for."""
LIGHT_MM = 22.0
"""Around the cell, to tell glare from the light."""


def check_frame(image: Gray, plane: PlaneFit, limits: QualityConfig) -> Verdict:
    """Exposure and blur of an (h, w) frame; needs no ink. For the board's picture, and before any press."""
    return Verdict(
        (picture_checks.exposure(image, limits), *picture_checks.blurred(image, plane, limits)),
    )


def check_capture(
    image: Gray,
    plane: PlaneFit,
    cell: Cell,
    *,
    height_mm: float,
    limits: QualityConfig,
    previous: Gray | None = None,
    sheet_mm: tuple[float, float] | None = None,
    anchor_mm: Point | None = None,
) -> Verdict:
    """Judge one press of commanded depth `height_mm` from the (h, w) photograph taken after it.

    `previous` is the last sound photograph before the press, from the same camera pose: with it, old ink is told from
    new, and a press that landed far off is found. `sheet_mm` (width, height) keeps the table beyond the sheet out.
    `anchor_mm` is the zero-touch point where it is not the cell's own. Checks that a failed one would spoil are left
    out of the verdict.
    """
    anchor = cell.anchor_mm if anchor_mm is None else anchor_mm
    frame = check_frame(image, plane, limits)
    if not frame.passed:
        return frame
    ink = _ink(image, previous, plane, around(cell.rect_mm, MARGIN_MM, sheet_mm), cell.rect_mm, anchor, limits)
    checks = [*frame.checks, picture_checks.cut(ink, plane, image.shape, anchor, limits)]
    window = around(cell.rect_mm, LIGHT_MM, sheet_mm)
    checks.append(picture_checks.glare(image, plane, window, cell.rect_mm, limits))
    if all(check.passed for check in checks):
        checks += _judge_ink(image, previous, plane, cell, ink, anchor, height_mm, sheet_mm, limits)
    return Verdict(tuple(sorted(checks, key=lambda check: list(Failure).index(check.name))))


def check_drawing(
    image: Gray,
    plane: PlaneFit,
    cell: Cell,
    *,
    height_mm: float,
    limits: QualityConfig,
    previous: Gray | None = None,
) -> Verdict:
    """Judge a figure, drawn down to `height_mm`, from the (h, w) photograph taken after it.

    Exposure, blur, whether its cell holds ink that `previous` does not show, and none across the cell's edge, as an arm
    would that is still in the picture. Its shape is not judged: no two figures have one in common.
    """
    frame = check_frame(image, plane, limits)
    if not frame.passed:
        return frame
    inked = take(image, plane.image_to_paper, cell.rect_mm, Params()).inked(limits.ink_gate)
    if previous is not None:
        inked = inked & ~take(previous, plane.image_to_paper, cell.rect_mm, Params()).inked(limits.ink_gate)
    edge = np.concatenate([inked[0], inked[-1], inked[1:-1, 0], inked[1:-1, -1]])
    crossing = ink_checks.crossing(float(edge.sum()) / PX_PER_MM)
    return Verdict((*frame.checks, crossing, ink_checks.blank(mm2(inked), height_mm, limits)))


def cell_is_blank(
    image: Gray,
    plane: PlaneFit,
    cell: Cell,
    *,
    limits: QualityConfig,
) -> Check:
    """Whether the cell may be pressed on, from an (h, w) photograph; `NEIGHBOUR` where it holds ink or is not seen."""
    patch = take(image, plane.image_to_paper, cell.rect_mm, Params())
    hidden_mm2 = mm2(~patch.in_view)
    if hidden_mm2 > 0.0:
        return ink_checks.unseen(cell.index, hidden_mm2, limits)
    return ink_checks.before_press(cell.index, mm2(patch.inked(limits.ink_gate)), limits)


def _judge_ink(
    image: Gray,
    previous: Gray | None,
    plane: PlaneFit,
    cell: Cell,
    ink: Ink,
    anchor: Point,
    height_mm: float,
    sheet_mm: tuple[float, float] | None,
    limits: QualityConfig,
) -> list[Check]:
    neighbour = ink_checks.neighbour(ink, limits)
    blank = ink_checks.blank(ink.own_mm2, height_mm, limits)
    if not blank.passed:
        far_mm = None
        if previous is not None:
            wide = around(cell.rect_mm, FAR_MM, sheet_mm)
            far_mm = _away_mm(
                _ink(image, previous, plane, wide, cell.rect_mm, anchor, limits), anchor, height_mm, limits
            )
        if far_mm is None:
            return [neighbour, blank]
        return [neighbour, ink_checks.far_off(far_mm, limits)]
    mark = measure_mark(ink, anchor)
    assert mark is not None
    dry = ink_checks.dry(mark, limits)
    checks = [neighbour, blank, dry]
    if dry.passed:
        # A dry brush leaves its head, its tip and its tone behind: none of them tells anything else then.
        checks += [ink_checks.misplaced(mark, limits), ink_checks.faint(mark, limits)]
        checks += [shape_checks.split(mark, limits), shape_checks.bent(mark, limits)]
    return checks


def _ink(
    image: Gray,
    previous: Gray | None,
    plane: PlaneFit,
    window: Rect,
    cell_mm: Rect,
    anchor: Point,
    limits: QualityConfig,
) -> Ink:
    now = take(image, plane.image_to_paper, window, Params())
    before = None if previous is None else take(previous, plane.image_to_paper, window, Params())
    return tell_apart(now, before, cell_mm, anchor, limits.ink_gate)


def _away_mm(ink: Ink, anchor: Point, height_mm: float, limits: QualityConfig) -> float | None:
    """Distance of the nearest new ink from the anchor, if there is as much of it as a press leaves."""
    if ink.own_mm2 < limits.blank_mm2_per_mm * height_mm:
        return None
    return float(np.hypot(*(ink.patch.points_mm(ink.own) - np.array(anchor)).T).min())
