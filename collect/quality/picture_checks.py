"""Checks of the photograph: exposure, blur, a stroke cut by the frame, glare."""

from __future__ import annotations

import numpy as np

from calibrate.board.scale import PlaneFit
from calibrate.stroke.preprocess import Gray, rectify
from collect.quality import picture
from collect.quality.ink import Ink
from collect.quality.patch import Point, Rect
from collect.quality.verdict import Check, Failure
from collect.rig.config_quality import QualityConfig


def exposure(image: Gray, limits: QualityConfig) -> Check:
    """Paper neither dark nor saturated."""
    level = picture.paper_level(image)
    dark, bright = level < limits.dark_level, level >= limits.bright_level
    reason = ""
    if dark:
        reason = f"The picture is too dark: paper at {level:.0f} of 255. Turn the light on or expose longer."
    if bright:
        reason = f"The picture is too bright: paper at {level:.0f} of 255. Expose shorter or dim the light."
    limit = limits.dark_level if level < 0.5 * (limits.dark_level + limits.bright_level) else limits.bright_level
    return Check(Failure.EXPOSURE, level, "of 255", limit, not (dark or bright), reason)


def blurred(image: Gray, plane: PlaneFit, limits: QualityConfig) -> tuple[Check, ...]:
    """Sharp edges; none where the picture has no edge to measure, as with a bare sheet that fills it."""
    sigma_px = picture.blur_px(image)
    if sigma_px is None:
        return ()
    sigma_mm = sigma_px * plane.mm_per_px
    passed = sigma_mm < limits.blur_mm
    reason = f"The picture is blurred by {sigma_mm:.2f} mm. Focus the lens, clean it, and see that nothing shakes."
    return (Check(Failure.BLURRED, sigma_mm, "mm", limits.blur_mm, passed, "" if passed else reason),)


def cut(ink: Ink, plane: PlaneFit, shape: tuple[int, ...], anchor_mm: Point, limits: QualityConfig) -> Check:
    """The stroke, or where there is none the zero-touch point, wholly in the frame."""
    points = ink.patch.points_mm(ink.own) if ink.own.any() else np.array([anchor_mm])
    gap_mm = picture.edge_mm(points, plane, shape)
    passed = gap_mm >= limits.edge_mm
    reason = f"The stroke ends {max(gap_mm, 0.0):.1f} mm from the edge of the picture. Move the camera or the sheet."
    return Check(Failure.CUT, gap_mm, "mm", limits.edge_mm, passed, "" if passed else reason)


def glare(image: Gray, plane: PlaneFit, window: Rect, cell_mm: Rect, limits: QualityConfig) -> Check:
    """No reflection in the cell; `window` holds enough of the paper around it to know the light."""
    spots = picture.glare(rectify(image, plane.image_to_paper, window), limits.glare_share)
    scale = picture.BRIGHT_PX_PER_MM
    left, top = cell_mm[0] - window[0], window[1] + window[3] - cell_mm[1] - cell_mm[3]
    rows = slice(round(top * scale), round((top + cell_mm[3]) * scale))
    columns = slice(round(left * scale), round((left + cell_mm[2]) * scale))
    area_mm2 = float(spots[rows, columns].sum()) / scale**2
    passed = area_mm2 < limits.glare_mm2
    reason = f"{area_mm2:.0f} mm^2 of glare in the cell. Move the lamp, or wait until the ink has lost its shine."
    return Check(Failure.GLARE, area_mm2, "mm^2", limits.glare_mm2, passed, "" if passed else reason)
