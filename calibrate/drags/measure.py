"""Find strokes that travel along the paper and their defects, measure them, and fit width against depth.

A stroke with a defect (torn into parts, hollow, under glare) is still used. Its parts lie farther apart than drops
beside a press, so more of them are taken for the stroke.

A press model does not predict a drag. Both depend on how wide the brush opens at a depth, so the fitted slope of width
against depth can be compared with the one that CCD-BSM gives for a brush of known R and L.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from brushloop.calibrate.errors import CaptureRefused
from brushloop.calibrate.stats import Line, fit_line
from brushloop.calibrate.stroke.measure import Measured, measure, outline
from brushloop.calibrate.stroke.params import Gray, Mask, Params
from brushloop.calibrate.stroke.preprocess import Prepared, components, fill_holes, preprocess, touches_edge
from brushloop.calibrate.stroke.rectify import on_raster, rescale
from brushloop.sessions.errors import SessionDamaged
from brushloop.sessions.recording import Capture
from brushloop.sessions.records import Stroke

THUMB_PX = 160
DEPTH_NAMES = ("depth_mm", "depth_mid_mm", "depth_mid_mm_nominal")
LENGTH_NAME = "length_mm"
LEVEL_DEG = 20.0
"""Bent strokes along x have a rectangle that is a little tilted: only strokes of another direction are turned."""
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
    """Describe what is wrong with a stroke's ink, one phrase for each defect; empty for a sound stroke."""
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


@dataclass(frozen=True, slots=True)
class Drag:
    """One drag, with its commanded and measured values."""

    stroke_id: str
    commanded: dict[str, float]
    measured: Measured
    cut: bool
    """True where the photograph cuts the stroke."""
    flags: tuple[str, ...]
    """Defects, as `defects` words them."""
    thumbnail: NDArray[np.uint8]
    """(160, 160) gray photograph with the stroke's outline drawn in."""

    @property
    def weight(self) -> float:
        """Weight in a fit: a stroke with a defect counts less."""
        return FLAGGED_WEIGHT if self.flags else 1.0

    @property
    def depth_mm(self) -> float | None:
        """The commanded depth, under whichever name the source gives it."""
        return _depth_in(self.commanded)


def depth_of(stroke: Stroke) -> float | None:
    """The commanded depth of an imported stroke, mm, under whichever name its table gives it."""
    return _depth_in(dict(stroke.commanded)) if stroke.depth_mm is None else stroke.depth_mm


def _depth_in(commanded: dict[str, float]) -> float | None:
    return next((commanded[name] for name in DEPTH_NAMES if name in commanded), None)


@dataclass(slots=True)
class DragResults:
    """Everything that the report of an imported session needs."""

    strokes: list[Drag] = field(default_factory=list[Drag])
    refused: list[tuple[str, str]] = field(default_factory=list[tuple[str, str]])
    width_on_depth: Line | None = None
    length_on_commanded: Line | None = None


def validate_drags(captures: Iterator[Capture], params: Params) -> DragResults:
    """Measure every stroke, then fit width on depth and length on commanded length over those that are not cut.

    Strokes with a defect count less, as in a fit.
    """
    results = DragResults()
    for capture in captures:
        try:
            results.strokes.append(_measure(capture, params))
        except (CaptureRefused, SessionDamaged) as error:
            results.refused.append((capture.stroke.stroke_id, error.what))
    whole = [drag for drag in results.strokes if not drag.cut]
    deep = [(drag.depth_mm, drag.measured.mid_width_mm, drag.weight) for drag in whole if drag.depth_mm is not None]
    results.width_on_depth = fit_line([d for d, _, _ in deep], [w for _, w, _ in deep], [w for _, _, w in deep])
    long = [drag for drag in whole if LENGTH_NAME in drag.commanded]
    results.length_on_commanded = fit_line(
        [drag.commanded[LENGTH_NAME] for drag in long],
        [drag.measured.length_mm for drag in long],
        [drag.weight for drag in long],
    )
    return results


def _measure(capture: Capture, params: Params) -> Drag:
    stroke = capture.stroke
    if stroke.px_per_mm is None:
        raise CaptureRefused(stroke.stroke_id, "has no scale (px_per_mm)")
    raster = rescale(capture.image(), stroke.px_per_mm, capture.where)
    anchor = on_raster(stroke.anchor_px, stroke.px_per_mm) if stroke.anchor_px is not None else None
    prepared, _, flags = prepare_drag(raster, anchor, capture.where, params)
    commanded = dict(stroke.commanded)
    if stroke.depth_mm is not None:
        commanded["depth_mm"] = stroke.depth_mm
    if stroke.tilt_deg is not None:
        commanded["tilt_deg"] = stroke.tilt_deg
    # A start in the table means a commanded path, which runs along x. Scanned strokes have neither.
    size = measure(along_axis(prepared.mask) if anchor is None else prepared.mask)
    return Drag(stroke.stroke_id, commanded, size, prepared.cut, flags, _thumbnail(raster, prepared.mask))


def along_axis(mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """The mask turned until the stroke's longer axis, that of its smallest enclosing rectangle, is the x axis.

    A mask whose axis is within `LEVEL_DEG` of x is returned as it is.
    """
    points = cv2.findNonZero(mask.astype(np.uint8))
    centre, (width, height), angle = cv2.minAreaRect(points)
    turn = angle if width >= height else angle - 90.0
    turn = (turn + 90.0) % 180.0 - 90.0
    if abs(turn) < LEVEL_DEG:
        return mask
    side = int(np.hypot(*mask.shape)) + 2
    matrix = cv2.getRotationMatrix2D(centre, turn, 1.0)
    matrix[:, 2] += 0.5 * side - np.array(centre)
    turned = cv2.warpAffine(255 * mask.astype(np.uint8), matrix, (side, side), flags=cv2.INTER_LINEAR)
    return np.asarray(turned > 127, np.bool_)


def _thumbnail(raster: NDArray[np.uint8], mask: NDArray[np.bool_]) -> NDArray[np.uint8]:
    rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
    side = round(1.15 * max(rows[-1] - rows[0], columns[-1] - columns[0])) + 8
    centre = ((rows[0] + rows[-1]) // 2, (columns[0] + columns[-1]) // 2)
    # Padded by `side`, so that a square of that size around the stroke always fits.
    rows_shown, columns_shown = (slice(c + side // 2, c + side // 2 + side) for c in centre)
    crop = np.pad(raster, side, mode="edge")[rows_shown, columns_shown]
    inside = np.pad(mask.astype(np.uint8), side)[rows_shown, columns_shown]
    small = cv2.resize(crop, (THUMB_PX, THUMB_PX), interpolation=cv2.INTER_AREA)
    shape = cv2.resize(inside, (THUMB_PX, THUMB_PX), interpolation=cv2.INTER_AREA)
    outline = cv2.morphologyEx((shape > 0).astype(np.uint8), cv2.MORPH_GRADIENT, np.ones((2, 2), np.uint8)) > 0
    small[outline & (small > 90)] = 150
    small[outline & (small <= 90)] = 230
    return small.astype(np.uint8)
