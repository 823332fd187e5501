"""Which paper cells zero touch and the self-check use up, so that no press ever lands there."""

from __future__ import annotations

import math

from collect.config import PaperConfig
from collect.sheet import Sheet
from collect.touch.camera import coarse_count, fine_count
from collect.touch.config import TouchConfig
from collect.touch.reach import Known
from collect.touch.selfcheck import Triangle

MARK_MM = 3.0
"""Half the side of the paper that one mark may cover; a shallow touch leaves less."""

Rect = tuple[float, float, float, float]
"""x, y, width, height in the paper frame."""


def touched_rects(paper: PaperConfig, config: TouchConfig) -> list[Rect]:
    """The paper that zero touch may ink: nothing for the taught height, a patch for each point by camera."""
    match config.method:
        case "taught":
            return []
        case "force" | "jog":
            return [_around(*point) for point in config.points_mm or [paper.touch_point_mm]]
        case "camera":
            known, camera = Known(paper, config), config.camera
            rects: list[Rect] = []
            for x, y in config.points_mm:
                reach = known.reach(x, y, (camera.columns - 1) * camera.pitch_mm)
                spots = coarse_count(camera, reach) + config.touches * fine_count(camera)
                rows = math.ceil(spots / camera.columns)
                rects.append((x, y, (camera.columns - 1) * camera.pitch_mm, (rows - 1) * camera.pitch_mm))
            return [(x - MARK_MM, y - MARK_MM, w + 2 * MARK_MM, h + 2 * MARK_MM) for x, y, w, h in rects]


def used_cells(sheet: Sheet, paper: PaperConfig, config: TouchConfig, check_mm: Triangle | None = None) -> set[int]:
    """The cells whose middle parts zero touch, and a self-check at `check_mm`, may ink.

    A cell counts where a mark reaches more than `MARK_MM` into it: touch points in the sheet's margin cost no cell.
    """
    rects = touched_rects(paper, config) + [_around(*place) for place in check_mm or ()]
    cells = [sheet.cell(index) for index in range(sheet.capacity)]
    return {cell.index for cell in cells for rect in rects if _reaches_into(rect, cell.rect_mm)}


def _around(x_mm: float, y_mm: float) -> Rect:
    return x_mm - MARK_MM, y_mm - MARK_MM, 2.0 * MARK_MM, 2.0 * MARK_MM


def _reaches_into(rect: Rect, cell: Rect) -> bool:
    (ax, ay, aw, ah), (bx, by, bw, bh) = rect, cell
    across, along = min(ax + aw, bx + bw) - max(ax, bx), min(ay + ah, by + bh) - max(ay, by)
    return across > MARK_MM and along > MARK_MM
