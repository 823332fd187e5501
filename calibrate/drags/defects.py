"""Defects of a dragged stroke that can still be used: torn into parts, hollow, under glare.

The parts of a torn stroke lie farther apart than drops beside a press, so more of them are taken for the stroke.
"""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np

from calibrate.stroke.components import components, fill_holes
from calibrate.stroke.measure import outline
from calibrate.stroke.params import Gray, Mask, Params
from calibrate.stroke.preprocess import Prepared, preprocess, touches_edge

JOIN_MM = 6.0
"""Parts this close to the stroke belong to it."""
TORN_SHARE = 0.03
"""Share of the ink outside the largest part from which a stroke is torn."""
HOLLOW_SHARE = 0.75
"""Share of its outline that ink covers, below which a stroke is hollow: dry bristles, or glare on wet ink."""
FLAGGED_WEIGHT = 0.3
"""Weight in a fit of a stroke with any of these defects: its shape says less about the brush."""


def prepare_drag(
    raster: Gray, anchor_px: tuple[float, float] | None, where: str, params: Params
) -> tuple[Prepared, Mask, tuple[str, ...]]:
    """Find a drag on its raster: its connected part, all parts of it, and its defects. It is cut if any part is.

    Raises `CaptureRefused` as `prepare` does.
    """
    steps = preprocess(raster, anchor_px, where, params)
    wide = replace(params, join_mm=max(params.join_mm, JOIN_MM))
    whole = fill_holes(components(steps.ink, anchor_px, wide).mask, params)
    glare = tuple(flag for flag in steps.prepared.flags if flag.startswith("glare"))
    return replace(steps.prepared, cut=touches_edge(whole)), whole, (*defects(whole), *glare)


def defects(mask: Mask) -> tuple[str, ...]:
    """Words for what is wrong with a stroke's ink."""
    rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
    ink = mask[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]
    count, _, stats, _ = cv2.connectedComponentsWithStats(ink.astype(np.uint8), connectivity=8)
    areas = np.asarray(stats[1:, cv2.CC_STAT_AREA], np.float64)
    found: list[str] = []
    if areas.max() < (1.0 - TORN_SHARE) * areas.sum():
        found.append(f"torn: {count - 1} parts, the largest holds {100 * areas.max() / areas.sum():.0f} % of the ink")
    covered = float(np.count_nonzero(ink)) / float(np.count_nonzero(outline(ink)))
    if covered < HOLLOW_SHARE:
        found.append(f"hollow: ink covers {100 * covered:.0f} % of the outline")
    return tuple(found)
