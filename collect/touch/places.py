"""Which paper cells zero touch and the self-check use up, so that no press ever lands there."""

from __future__ import annotations

import math

from collect.rig.config import PaperConfig
from collect.rig.config_touch import TouchConfig
from collect.rig.paper import Sheet
from collect.touch.camera import coarse_count, fine_count
from collect.touch.reach import Known
from collect.touch.selfcheck import Triangle

MARK_MM = 3.0
"""Half the side of the paper that one mark may cover; a shallow touch leaves less."""

Rect = tuple[float, float, float, float]
"""x, y, width, height in the paper frame."""


def touch_rects(paper: PaperConfig, config: TouchConfig) -> list[Rect]:
    """Where a measured zero touch lets the tip down: at points, by camera within a patch for each point."""
    match config.method:
        case "taught":
            return []
        case "force" | "jog":
            return [(x, y, 0.0, 0.0) for x, y in config.points_mm or [paper.touch_point_mm]]
        case "camera":
            pitch_mm, columns = config.camera.pitch_mm, config.camera.columns
            rows = [math.ceil(spots / columns) for spots in patch_spots(paper, config)]
            return [
                (x, y, (columns - 1) * pitch_mm, (count - 1) * pitch_mm)
                for (x, y), count in zip(config.points_mm, rows, strict=True)
            ]


def patch_spots(paper: PaperConfig, config: TouchConfig) -> list[int]:
    """Spots of each point's patch by camera, at most."""
    known, camera = Known(paper, config), config.camera
    reaches = [known.reach(x, y, camera.extent_mm) for x, y in config.points_mm]
    return [coarse_count(camera, reach) + config.touches * fine_count(camera) for reach in reaches]


def touched_rects(paper: PaperConfig, config: TouchConfig) -> list[Rect]:
    """The paper that zero touch may ink: nothing for the taught height."""
    m = MARK_MM
    return [(x - m, y - m, w + 2 * m, h + 2 * m) for x, y, w, h in touch_rects(paper, config)]


def used_cells(sheet: Sheet, paper: PaperConfig, config: TouchConfig, check_mm: Triangle | None = None) -> set[int]:
    """The cells whose middle parts zero touch, and a self-check at `check_mm`, may ink.

    A cell counts where a mark reaches more than `MARK_MM` into it: touch points in the sheet's margin cost no cell.
    """
    m = MARK_MM
    rects = touched_rects(paper, config) + [(x - m, y - m, 2 * m, 2 * m) for x, y in check_mm or ()]
    cells = [sheet.cell(index) for index in range(sheet.capacity)]
    return {cell.index for cell in cells for rect in rects if _reaches_into(rect, cell.rect_mm)}


def _reaches_into(rect: Rect, cell: Rect) -> bool:
    (ax, ay, aw, ah), (bx, by, bw, bh) = rect, cell
    across, along = min(ax + aw, bx + bw) - max(ax, bx), min(ay + ah, by + bh) - max(ay, by)
    return across > MARK_MM and along > MARK_MM
