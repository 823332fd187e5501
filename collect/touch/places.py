"""Where zero touch marks the paper, and which patches it uses up."""

from __future__ import annotations

import math

from brushloop.collect.errors import StepError
from brushloop.collect.rig.config import PaperConfig
from brushloop.collect.rig.config_touch import CameraTouchConfig, TouchConfig
from brushloop.collect.rig.paper import Sheet
from brushloop.collect.touch.heights import KnownHeights, Reach

SLACK_STEPS = 2
"""Fine steps beyond the coarse step, on either side: a coarse touch is accurate only to its step."""


class SpotGrid:
    """The spots around one point, to and fro from the lower left, so that consecutive touches are neighbours."""

    def __init__(
        self, at_mm: tuple[float, float], config: CameraTouchConfig, sheet_mm: tuple[float, float], lowest_z_mm: float
    ) -> None:
        """No spot lies lower than `lowest_z_mm`."""
        self.lowest_z_mm = lowest_z_mm
        self._at_mm = at_mm
        self._sheet_mm = sheet_mm
        self._config = config
        self._next = 0

    def take(self) -> tuple[float, float]:
        """The next fresh spot. Raises `StepError` where it does not lie on the sheet."""
        row, column = divmod(self._next, self._config.columns)
        self._next += 1
        column = self._config.columns - 1 - column if row % 2 else column
        pitch_mm = self._config.pitch_mm
        x_mm, y_mm = self._at_mm[0] + column * pitch_mm, self._at_mm[1] + row * pitch_mm
        if not (0.0 <= x_mm <= self._sheet_mm[0] and 0.0 <= y_mm <= self._sheet_mm[1]):
            raise StepError(
                f"the touches at ({self._at_mm[0]:g}, {self._at_mm[1]:g}) mm do not fit on the sheet: "
                f"spot {self._next} would lie at ({x_mm:g}, {y_mm:g}) mm"
            )
        return x_mm, y_mm


def fine_count(config: CameraTouchConfig) -> int:
    """SpotGrid of one fine row."""
    return 1 + 2 * SLACK_STEPS + math.ceil(config.coarse_step_mm / config.fine_step_mm)


def coarse_count(config: CameraTouchConfig, reach: Reach) -> int:
    """SpotGrid of a whole coarse row, which ends early where ink is seen."""
    return math.ceil((reach.start_z_mm - reach.lowest_z_mm) / config.coarse_step_mm) + 1


MARK_MM = 3.0
"""Half the side of the paper that one mark may cover; a shallow touch leaves less."""
Rect = tuple[float, float, float, float]
"""x, y, width, height in the paper frame."""


def touch_rects(paper: PaperConfig, config: TouchConfig) -> list[Rect]:
    """Where a measured zero touch lowers the tip: at points or, by camera, in a patch around each point."""
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
    """The most spots that each point's patch may take."""
    known, camera = KnownHeights(paper, config), config.camera
    reaches = [known.reach(x, y, camera.extent_mm) for x, y in config.points_mm]
    return [coarse_count(camera, reach) + config.touches * fine_count(camera) for reach in reaches]


def used_patches(sheet: Sheet, paper: PaperConfig, config: TouchConfig) -> set[int]:
    """The patches whose middle parts zero touch may ink; none for the taught height.

    A patch counts if a mark reaches more than `MARK_MM` into it: touch points in the sheet's margin cost no patch.
    """
    m = MARK_MM
    rects = [(x - m, y - m, w + 2 * m, h + 2 * m) for x, y, w, h in touch_rects(paper, config)]
    patches = [sheet.patch(index) for index in range(sheet.capacity)]
    return {patch.index for patch in patches for rect in rects if _reaches_into(rect, patch.rect_mm)}


def _reaches_into(rect: Rect, patch: Rect) -> bool:
    (ax, ay, aw, ah), (bx, by, bw, bh) = rect, patch
    across, along = min(ax + aw, bx + bw) - max(ax, bx), min(ay + ah, by + bh) - max(ay, by)
    return across > MARK_MM and along > MARK_MM
