"""Checks of the shape of a stroke: split bristles, bent tip."""

from __future__ import annotations

from collect.quality.mark import Mark
from collect.quality.verdict import Check, Failure
from collect.rig.config_quality import QualityConfig


def split(mark: Mark, limits: QualityConfig) -> Check:
    """One group of hairs, not two."""
    passed = mark.gap_mm < limits.split_mm
    reason = f"The bristles are split: a gap of {mark.gap_mm:.1f} mm. Comb the brush together on the rim and dip again."
    return Check(Failure.SPLIT, mark.gap_mm, "mm", limits.split_mm, passed, "" if passed else reason)


def bent(mark: Mark, limits: QualityConfig) -> Check:
    """A mark that runs along the heading."""
    passed = mark.bent_deg < limits.bent_deg
    reason = f"The tip is bent: the stroke runs {mark.bent_deg:.0f} deg off. Wipe the tip straight and dip again."
    return Check(Failure.BENT, mark.bent_deg, "deg", limits.bent_deg, passed, "" if passed else reason)
