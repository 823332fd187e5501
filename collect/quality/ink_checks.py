"""Checks of place and ink: a blank cell, foreign ink, no ink, a misplaced mark, a dry brush, faint ink."""

from __future__ import annotations

import math

from collect.quality.ink import Ink
from collect.quality.mark import Mark
from collect.quality.verdict import Check, Failure
from collect.rig.config_quality import QualityConfig

CROSSING_MM = 4.0
"""Ink across the edge of a cell: more than the end of one stroke that went too far."""


def before_press(cell: int, area_mm2: float, limits: QualityConfig) -> Check:
    """The cell holds no ink before its press."""
    reason = f"Cell {cell} is not blank: {area_mm2:.1f} mm^2 of ink. Is this the sheet that the session says it is?"
    return _most(Failure.NEIGHBOUR, area_mm2, "mm^2", limits.foreign_mm2, reason)


def unseen(cell: int, hidden_mm2: float, limits: QualityConfig) -> Check:
    """A cell that the frame cuts cannot be said to be blank."""
    reason = (
        f"Cell {cell} is not wholly in the picture, {hidden_mm2:.0f} mm^2 are hidden. Move the camera or the sheet."
    )
    return Check(Failure.NEIGHBOUR, hidden_mm2, "mm^2", limits.foreign_mm2, False, reason)


def neighbour(ink: Ink, limits: QualityConfig) -> Check:
    """No ink in the cell but the press's own."""
    area_mm2 = ink.before_mm2 + ink.beside_mm2
    source = (
        "a stroke from next door reaches in. Keep this cell out and make the cells larger"
        if ink.before_mm2 > ink.beside_mm2
        else "something dripped or lies apart from the stroke. Wipe the brush on the rim after a dip"
    )
    reason = f"{area_mm2:.1f} mm^2 of ink in the cell are not the stroke's: {source}."
    return _most(Failure.NEIGHBOUR, area_mm2, "mm^2", limits.foreign_mm2, reason)


def crossing(length_mm: float) -> Check:
    """No new ink across the edge of a figure's cell."""
    reason = f"New ink, or the arm, lies across {length_mm:.0f} mm of the cell's edge. Is the arm out of the picture?"
    return _most(Failure.NEIGHBOUR, length_mm, "mm", CROSSING_MM, reason)


def blank(own_mm2: float, height_mm: float, limits: QualityConfig) -> Check:
    """Some ink at all."""
    least_mm2 = limits.blank_mm2_per_mm * height_mm
    reason = f"No stroke: {own_mm2:.1f} mm^2 of ink. Dip again; if the well is full, teach the touch height anew."
    return _least(Failure.BLANK, own_mm2, "mm^2", least_mm2, reason)


def far_off(away_mm: float, limits: QualityConfig) -> Check:
    """A press whose ink lies outside its cell."""
    reason = f"The stroke lies {away_mm:.0f} mm away from its cell. {_WHERE}"
    return Check(Failure.MISPLACED, away_mm, "mm", limits.misplaced_mm, False, reason)


def misplaced(mark: Mark, limits: QualityConfig) -> Check:
    """The mark begins where the tip touched."""
    along, aside = mark.head_mm
    off_mm = math.hypot(along - limits.head_mm, aside)
    reason = f"The stroke begins {off_mm:.1f} mm from where the tip should have touched. {_WHERE}"
    return _most(Failure.MISPLACED, off_mm, "mm", limits.misplaced_mm, reason)


def dry(mark: Mark, limits: QualityConfig) -> Check:
    """Ink without streaks of bare paper."""
    reason = f"The brush was dry: the ink is streaky ({mark.uneven:.2f}). Dip again, deeper or longer."
    return _most(Failure.DRY, mark.uneven, "of the mean", limits.uneven, reason)


def faint(mark: Mark, limits: QualityConfig) -> Check:
    """Dark ink."""
    reason = f"The ink is faint: darkness {mark.tone:.2f}. Stir or renew the ink, and dip again."
    return _least(Failure.FAINT, mark.tone, "of 1", limits.faint_tone, reason)


_WHERE = "Check the sheet's origin, that the sheet has not slipped, and that the brush sits firm."


def _most(name: Failure, score: float, unit: str, limit: float, reason: str) -> Check:
    passed = score < limit
    return Check(name, score, unit, limit, passed, "" if passed else reason)


def _least(name: Failure, score: float, unit: str, limit: float, reason: str) -> Check:
    passed = score >= limit
    return Check(name, score, unit, limit, passed, "" if passed else reason)
