"""The checks of a capture: a number, its limit, and what an operator should do; and the verdict that follows.

A new check needs a name in `Failure`, a limit in `QualityConfig`, and a place here: in `judge_mark` if it judges the
measured mark, in `Photograph.check_press` if it judges the photograph or the ink.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from enum import StrEnum

import numpy as np

from brushloop.calibrate.board.pix2len import Plane
from brushloop.calibrate.stroke.preprocess import PX_PER_MM, Gray, rectify
from brushloop.collect.photograph import measure
from brushloop.collect.photograph.measure import Ink, Mark, Point, around, measure_mark, mm2, on_sheet, take, tell_apart
from brushloop.collect.rig.config import QualityConfig
from brushloop.collect.rig.paper import Patch
from brushloop.sessions.records import Check


class Failure(StrEnum):
    """The failures in the order in which they are judged; the first that is found is the cause.

    A stroke can be judged only in a sound picture and once it is distinguished from other ink; its place and tone,
    only if the hairs carried ink; its shape comes last.
    """

    EXPOSURE = "exposure", "well lit", True
    BLURRED = "blurred", "sharp", True
    CUT = "cut", "in frame", True
    GLARE = "glare", "no glare", True
    NEIGHBOUR = "neighbour", "alone"
    BLANK = "blank", "inked"
    DRY = "dry", "wet"
    SMEARED = "smeared", "no smear"
    MISPLACED = "misplaced", "in place"
    FAINT = "faint", "dark"
    SPLIT = "split", "whole"
    BENT = "bent", "straight"

    def __new__(cls, name: str, if_passed: str, of_picture: bool = False) -> Failure:
        """`if_passed` is what a capture is that passed; `of_picture` tells that the photograph failed, not the stroke:
        the stroke on paper may be sound."""
        failure = str.__new__(cls, name)
        failure._value_, failure.if_passed, failure.of_picture = name, if_passed, of_picture
        return failure

    if_passed: str
    of_picture: bool


@dataclass(frozen=True, slots=True)
class Verdict:
    """All checks of one capture that could be measured, in the order of `Failure`."""

    checks: tuple[Check, ...]

    @property
    def passed(self) -> bool:
        """Whether the capture is sound."""
        return self.cause is None

    @property
    def cause(self) -> Check | None:
        """The dominant failure: the first in the order of `Failure`; None where all passed."""
        return next((check for check in self.checks if not check.passed), None)

    @property
    def reason(self) -> str:
        """The cause's reason, with the other failures named; empty where all passed."""
        failed = [check for check in self.checks if not check.passed]
        if not failed:
            return ""
        others = f" Also failed: {', '.join(check.name for check in failed[1:])}." if failed[1:] else ""
        return failed[0].reason + others


MARGIN_MM = 4.0
"""Margin around the patch in which a stroke that leaves it is looked for."""
FAR_MM = 45.0
"""Margin around the patch in which a press that left nothing in it is looked for."""
LIGHT_MM = 22.0
"""Margin around the patch that shows enough paper to tell glare from the light."""
LONGEST, WIDEST = 1.6, 0.65
"""Length and width of the largest mark per depth of its press; a few mm more come from the tip."""
CROSSING_MM = 4.0
"""Length of ink across the edge of a patch, in mm; the end of one stroke that goes too far covers less."""


@dataclass(frozen=True, slots=True)
class Photograph:
    """A photograph of the sheet, and the limits that it is judged by."""

    image: Gray
    """(h, w), without the distortion of the lens."""
    plane: Plane
    limits: QualityConfig
    sheet_mm: tuple[float, float] | None = None
    """Width and height: excludes the sheet's edge and the table beyond it."""
    previous: Gray | None = None
    """The last valid photograph before a press, from the same camera pose: it separates new ink from old, and reveals
    a press that landed far off."""

    def check_frame(self) -> Verdict:
        """Check exposure and blur, as before any press or for the board's picture."""
        # The paper is neither dark nor saturated.
        level, limits, reason = measure.paper_level(self.image), self.limits, ""
        if level < limits.dark_level:
            reason = f"The picture is too dark ({level:.0f} of 255 on the paper). Turn the light on or expose longer."
        if level >= limits.bright_level:
            reason = f"The picture is too bright ({level:.0f} of 255 on the paper). Expose shorter or dim the light."
        limit = limits.dark_level if level < 0.5 * (limits.dark_level + limits.bright_level) else limits.bright_level
        checks = [_check(Failure.EXPOSURE, level, "of 255", limit, reason, passed=not reason)]
        # Edges are sharp where the picture has most contrast; there is none where a bare sheet fills it.
        if (sigma_px := measure.blur_px(measure.busiest_tile(self.image))) is not None:
            sigma_mm = sigma_px * self.plane.mm_per_px
            blurred = f"The picture is blurred by {sigma_mm:.2f} mm."
            reason = f"{blurred} Focus the lens, clean it, and see that nothing shakes."
            checks.append(_check(Failure.BLURRED, sigma_mm, "mm", limits.blur_mm, reason))
        return Verdict(tuple(checks))

    def check_press(self, patch: Patch, depth_mm: float) -> Verdict:
        """Judge one press of commanded depth `depth_mm`, by the checks that no earlier failure makes meaningless."""
        frame, limits, anchor = self.check_frame(), self.limits, patch.anchor_mm
        if not frame.passed:
            return frame
        ink = self._ink(patch, MARGIN_MM, anchor)
        checks = [*frame.checks, cut(ink, self.plane, self.image.shape, anchor, limits), self._glare(patch)]
        if not all(check.passed for check in checks):
            return Verdict(tuple(checks))
        checks.append(neighbour(ink, limits))
        enough = blank(ink.own_mm2, depth_mm, limits)
        mark = measure_mark(ink, anchor)
        if not enough.passed or mark is None:
            far = None if self.previous is None else self._ink(patch, FAR_MM, anchor)
            if far is not None and blank(far.own_mm2, depth_mm, limits).passed:
                away_mm = float(np.hypot(*(far.window.points_mm(far.own) - np.array(anchor)).T).min())
                reason = f"The stroke lies {away_mm:.0f} mm away from its patch. {_WHERE}"
                enough = _check(Failure.MISPLACED, away_mm, "mm", limits.misplaced_mm, reason, passed=False)
            return Verdict((*checks, enough))
        return Verdict((*checks, enough, *judge_mark(mark, depth_mm, limits)))

    def check_drawing(self, patch: Patch, depth_mm: float) -> Verdict:
        """Judge a figure that was drawn down to `depth_mm`.

        Checks exposure and blur, that the patch holds ink that `previous` does not show, and that nothing new lies
        across the patch's edge, as an arm still in the picture would. The shape is not judged: every figure has its
        own.
        """
        frame, gate = self.check_frame(), self.limits.ink_gate
        if not frame.passed:
            return frame
        inside = on_sheet(patch.rect_mm, self.sheet_mm)
        inked = take(self.image, self.plane, inside).inked(gate)
        if self.previous is not None:
            inked = inked & ~take(self.previous, self.plane, inside).inked(gate)
        edge = np.concatenate([inked[0], inked[-1], inked[1:-1, 0], inked[1:-1, -1]])
        length_mm = float(edge.sum()) / PX_PER_MM
        across = f"New ink, or the arm, lies across {length_mm:.0f} mm of the patch's edge."
        reason = f"{across} Is the arm out of the picture?"
        crossing = _check(Failure.NEIGHBOUR, length_mm, "mm", CROSSING_MM, reason)
        return Verdict((*frame.checks, crossing, blank(mm2(inked), depth_mm, self.limits)))

    def check_blank(self, patch: Patch) -> Check:
        """Check that the patch is blank; `NEIGHBOUR` if it holds ink or is not completely seen."""
        limits = self.limits
        window = take(self.image, self.plane, on_sheet(patch.rect_mm, self.sheet_mm))
        if (hidden_mm2 := mm2(~window.in_view)) > 0.0:
            # A patch that lies partly outside the frame cannot be called blank.
            reason = (
                f"Patch {patch.index} is not completely in the picture, {hidden_mm2:.0f} mm^2 are hidden. "
                "Move the camera or the sheet."
            )
            return _check(Failure.NEIGHBOUR, hidden_mm2, "mm^2", limits.foreign_mm2, reason, passed=False)
        ink_mm2 = mm2(window.inked(limits.ink_gate))
        what = f"Patch {patch.index} is not blank: {ink_mm2:.1f} mm^2 of ink."
        reason = f"{what} Is this the sheet that the session expects?"
        return _check(Failure.NEIGHBOUR, ink_mm2, "mm^2", limits.foreign_mm2, reason)

    def _ink(self, patch: Patch, margin_mm: float, anchor_mm: Point) -> Ink:
        """The ink in the patch and a margin around it: the stroke's own, other new ink, and old ink."""
        window = around(patch.rect_mm, margin_mm, self.sheet_mm)
        inside = on_sheet(patch.rect_mm, self.sheet_mm)
        before = None if self.previous is None else take(self.previous, self.plane, window, measure.COARSE_PX_PER_MM)
        return tell_apart(take(self.image, self.plane, window), before, inside, anchor_mm, self.limits.ink_gate)

    def _glare(self, patch: Patch) -> Check:
        """No reflection in the patch; enough paper around it is looked at to measure the light."""
        window, inside = around(patch.rect_mm, LIGHT_MM, self.sheet_mm), on_sheet(patch.rect_mm, self.sheet_mm)
        raster = rectify(self.image, self.plane.homography, window, measure.COARSE_PX_PER_MM)
        spots, scale = measure.glare(raster, self.limits.glare_share), measure.BRIGHT_PX_PER_MM
        left, top = inside[0] - window[0], window[1] + window[3] - inside[1] - inside[3]
        rows = slice(round(top * scale), round((top + inside[3]) * scale))
        columns = slice(round(left * scale), round((left + inside[2]) * scale))
        area_mm2 = float(spots[rows, columns].sum()) / scale**2
        reason = f"{area_mm2:.0f} mm^2 of glare in the patch. Move the lamp, or wait until the ink no longer shines."
        return _check(Failure.GLARE, area_mm2, "mm^2", self.limits.glare_mm2, reason)


def _check(name: Failure, score: float, unit: str, limit: float, reason: str, *, passed: bool | None = None) -> Check:
    """A check whose `reason` counts only if it failed; unless `passed` is given, the score must be below the limit."""
    passed = score < limit if passed is None else passed
    return Check(name=name, score=score, threshold=limit, unit=unit, passed=passed, reason="" if passed else reason)


def cut(ink: Ink, plane: Plane, shape: tuple[int, ...], anchor_mm: Point, limits: QualityConfig) -> Check:
    """The stroke, or the zero-touch point if there is none, lies completely in the frame."""
    points = ink.window.points_mm(ink.own) if ink.own.any() else np.array([anchor_mm])
    gap_mm = measure.edge_mm(points, plane, shape)
    reason = f"The stroke ends {max(gap_mm, 0.0):.1f} mm from the edge of the picture. Move the camera or the sheet."
    return _check(Failure.CUT, gap_mm, "mm", limits.edge_mm, reason, passed=gap_mm >= limits.edge_mm)


def neighbour(ink: Ink, limits: QualityConfig) -> Check:
    """The patch holds no ink but the press's own."""
    area_mm2 = ink.before_mm2 + ink.beside_mm2
    source = (
        "a neighbouring stroke reaches into this patch. Leave this patch out; next session, use larger patches"
        if ink.before_mm2 > ink.beside_mm2
        else "ink dripped, or something lies beside the stroke. Wipe the brush on the rim after each dip"
    )
    reason = f"{area_mm2:.1f} mm^2 of ink in the patch do not belong to the stroke: {source}."
    return _check(Failure.NEIGHBOUR, area_mm2, "mm^2", limits.foreign_mm2, reason)


def blank(own_mm2: float, depth_mm: float, limits: QualityConfig) -> Check:
    """The press left ink."""
    least_mm2 = limits.blank_mm2_per_mm * depth_mm
    reason = f"No stroke: only {own_mm2:.1f} mm^2 of ink. Dip again; if the well is full, teach the touch height again."
    return _check(Failure.BLANK, own_mm2, "mm^2", least_mm2, reason, passed=own_mm2 >= least_mm2)


def judge_mark(mark: Mark, depth_mm: float, limits: QualityConfig) -> Iterator[Check]:
    """The checks of a mark. The head, tip and tone of a dry brush's mark mean nothing."""
    # It is ink without streaks of bare paper.
    reason = f"The brush was dry: the ink is streaky ({mark.uneven:.2f}). Dip again, deeper or longer."
    dry = _check(Failure.DRY, mark.uneven, "of the mean", limits.uneven, reason)
    yield dry
    if not dry.passed:
        return
    # It is no larger than a press of its depth makes it: a brush that moves sideways leaves more.
    excess_mm = max(mark.length_mm - LONGEST * depth_mm, mark.width_mm - WIDEST * depth_mm, 0.0)
    reason = (
        f"The stroke is smeared: {mark.length_mm:.0f} by {mark.width_mm:.0f} mm at a depth of {depth_mm:g} mm. Did "
        "another client move the arm, or did the sheet slip?"
    )
    yield _check(Failure.SMEARED, excess_mm, "mm", limits.smeared_mm, reason)
    # It begins where the tip touched.
    along, aside = mark.head_mm
    off_mm = math.hypot(along - limits.head_mm, aside)
    reason = f"The stroke begins {off_mm:.1f} mm from where the tip should have touched. {_WHERE}"
    yield _check(Failure.MISPLACED, off_mm, "mm", limits.misplaced_mm, reason)
    # Its ink is dark.
    reason = f"The ink is faint: darkness {mark.tone:.2f}. Stir or renew the ink, and dip again."
    yield _check(Failure.FAINT, mark.tone, "of 1", limits.faint_tone, reason, passed=mark.tone >= limits.faint_tone)
    # One group of hairs made it, not two.
    reason = f"The bristles are split: a gap of {mark.gap_mm:.1f} mm. Comb the brush together on the rim and dip again."
    yield _check(Failure.SPLIT, mark.gap_mm, "mm", limits.split_mm, reason)
    # It runs along the heading.
    reason = f"The tip is bent: the stroke is {mark.bent_deg:.0f} deg off the heading. Wipe it straight; dip again."
    yield _check(Failure.BENT, mark.bent_deg, "deg", limits.bent_deg, reason)


_WHERE = "Check the sheet's origin, and whether the sheet slipped or the brush is loose."
