"""Zero touch by first ink: touch rows of fresh spots, each a little lower, and find where the new ink begins."""

from __future__ import annotations

import asyncio
import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from brushloop.calibrate.board.lens import apply
from brushloop.calibrate.board.pix2len import local_scale, see_board
from brushloop.calibrate.errors import CalibrationError
from brushloop.calibrate.stroke import PX_PER_MM, rectify
from brushloop.collect.errors import StepError
from brushloop.collect.motion import Dip, Move, Procedures, touching, up
from brushloop.collect.photograph.frames import Gray, undistorted
from brushloop.collect.rig.config import RigConfig, TouchConfig
from brushloop.collect.rig.paper import PaperPlane, fit_plane
from brushloop.collect.touch.force import Floats
from brushloop.collect.touch.heights import (
    COARSE_STEP_MM,
    EXTENT_MM,
    FINE_COUNT,
    FINE_STEP_MM,
    PITCH_MM,
    SPOTS_PER_PHOTO,
    KnownHeights,
    Reach,
    Touch,
    at_one_point,
    coarse_count,
    lowest_z_mm,
    spots,
)
from brushloop.drivers.devices import Frame
from brushloop.sessions.events import TouchedPoint

DARK_SHARE = 0.5
"""Pixels darker than this share of the paper are not paper, and are ignored in measuring the change of light."""
DARKER = 0.2
"""Share of the paper's brightness that a pixel must have lost to belong to a mark."""
JOIN_MM = 1.5
"""Parts that lie closer together belong to one mark."""


def before_and_after(config: RigConfig, before: Frame, after: Frame) -> tuple[Gray, Gray, Floats]:
    """Return both photographs, gray and undistorted, and the (3, 3) map from the second one to the paper frame.

    Raises `StepError` if the board is not seen.
    """
    first, second = (undistorted(config.camera, frame.image) for frame in (before, after))
    try:
        return first, second, see_board(second, config.board).homography
    except CalibrationError as error:
        raise StepError(f"the board is not seen: {error.what}") from None


def _darkening(first: NDArray[np.float32], second: NDArray[np.float32]) -> tuple[NDArray[np.float32], float]:
    """(gray levels by which each pixel became darker, level of the paper), corrected for the light.

    Pictures that show no paper did not become darker.
    """
    paper = float(np.quantile(first, 0.9))
    clean = first > DARK_SHARE * paper
    if paper < 1.0 or not clean.any():
        return np.zeros_like(first), 1.0
    light = float(np.median(second[clean] / first[clean]))
    return np.asarray(first - second / max(light, 1e-3), np.float32), paper


def ink_at(
    before: Gray, after: Gray, image_to_paper: Floats, spots_mm: list[tuple[float, float]], side_mm: float
) -> Floats:
    """New ink in a square around each spot, (n,) in mm2 of paper turned black. Noise averages to 0."""
    amounts_mm2: list[float] = []
    for x, y in spots_mm:
        # Larger by one side all around, so that the median sees paper; at 20 px/mm.
        window = (x - 1.5 * side_mm, y - 1.5 * side_mm, 3.0 * side_mm, 3.0 * side_mm)
        first, second = (rectify(image, image_to_paper, window).astype(np.float32) for image in (before, after))
        darkening, paper = _darkening(first, second)
        third = darkening.shape[0] // 3
        amounts_mm2.append(float(darkening[third : 2 * third, third : 2 * third].sum()) / paper / PX_PER_MM**2)
    return np.array(amounts_mm2, np.float64)


@dataclass(frozen=True, slots=True)
class Mark:
    """A mark of new ink: its centroid, weighted by darkness, in the paper frame, and its mm2 of black."""

    x_mm: float
    y_mm: float
    ink_mm2: float


def new_marks(before: Gray, after: Gray, image_to_paper: Floats, least_ink_mm2: float) -> list[Mark]:
    """New marks of at least `least_ink_mm2`, the largest first. The camera must not have moved in between."""
    import skimage.measure  # slow to import

    first, second = before.astype(np.float32), after.astype(np.float32)
    darkening, paper = _darkening(first, second)
    darker = np.asarray(darkening / np.maximum(first, DARK_SHARE * paper), np.float32)
    height, width = darker.shape
    middle = np.array([0.5 * width, 0.5 * height])
    reach_px = max(1, round(0.5 * JOIN_MM / local_scale(lambda at: apply(image_to_paper, at), middle)))
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * reach_px + 1, 2 * reach_px + 1))
    joined = cv2.dilate((darker > DARKER).astype(np.uint8), kernel)
    measure: Any = skimage.measure
    marks: list[Mark] = []
    for part in measure.regionprops(measure.label(joined, connectivity=2), intensity_image=darker):
        # Noise averages to 0: without clipping, the margin that joining added has no weight.
        ink = float(part.image_intensity.sum())
        if ink > 0.0:
            row, column = part.centroid_weighted
            pixel = np.array([column, row], np.float64)
            [[x_mm, y_mm]] = apply(image_to_paper, pixel[None])
            mm_per_px = local_scale(lambda at: apply(image_to_paper, at), pixel)
            marks.append(Mark(float(x_mm), float(y_mm), ink * mm_per_px**2))
    return sorted((m for m in marks if m.ink_mm2 >= least_ink_mm2), key=lambda m: -m.ink_mm2)


def first_ink(ink_mm2: Floats, least_mm2: float) -> int:
    """Index of the first spot with ink in a row of spots, (m,) from the highest to the lowest.

    Raises `StepError` if the first spot has ink, if none has, or if a spot below an inked one has none: otherwise a
    brush that ran dry would be mistaken for one that did not touch.
    """
    seen = np.asarray(ink_mm2) >= least_mm2
    if not seen.any():
        raise StepError("no spot of the row left ink: nothing was touched")
    first = int(np.argmax(seen))
    if first == 0:
        raise StepError("the highest spot of the row has ink already: the paper lies higher than expected")
    if not seen[first:].all():
        missing = first + int(np.argmin(seen[first:]))
        raise StepError(f"spot {missing + 1} of the row left no ink though a higher one did: is the brush dry?")
    return first


Spot = tuple[float, float, float]
"""x and y in the paper frame, z of the tip in the base frame."""
WINDOW_MM = 0.75 * PITCH_MM
"""Side of the window in which a spot's ink is measured."""
SPOTS_PER_DIP = 2
"""Touches after which the brush is dipped again: a tip that dries leaves no ink at first."""
LEAST_INK_MM2 = 0.25
"""Darkening that counts as ink: area times how much darker it became, 1 being black."""


class FirstInkTouch:
    """Touches by camera on one rig. The sheet must be blank where it touches."""

    def __init__(self, procedures: Procedures, config: TouchConfig, dip: Dip) -> None:
        self._procedures = procedures
        self._rig = procedures.rig
        self._config = config
        self._dip = dip
        self._since_dip: int | None = None
        self._last: Frame | None = None

    async def measure(self, points_mm: list[tuple[float, float]]) -> list[TouchedPoint]:
        """Touch every point coarsely, then finely in rounds, each along the plane fitted to the previous round.

        Without that plane, the sheet's lean along a row would be mistaken for height. Raises `StepError`.
        """
        paper, touches = self._rig.config.paper, self._config.touches
        known = KnownHeights(paper, self._config)
        fresh = [spots(point, paper.size_mm) for point in points_mm]
        rough: list[Touch] = []
        for row, point in zip(fresh, points_mm, strict=True):
            rough.append(await self._coarse(row, known.reach(*point, EXTENT_MM)))
            known.add(rough[-1].x_mm, rough[-1].y_mm, rough[-1].z_mm)
        rounds = [rough]
        for k in range(touches):
            lean = _plane(rounds[-1])
            # Staggered by parts of a step: equal heights would only repeat the same result.
            higher_mm = 0.5 * FINE_STEP_MM * (FINE_COUNT - 1) - k / touches * FINE_STEP_MM
            rounds.append([])
            for row, point, around in zip(fresh, points_mm, rough, strict=True):
                lowest_mm = lowest_z_mm(paper, self._config, *point, EXTENT_MM)
                rounds[-1].append(await self._fine(row, around, lean, higher_mm, lowest_mm))
        by_point = [list(point) for point in zip(*rounds[1:], strict=True)]
        lean = _plane([touch for point in by_point for touch in point])
        return [at_one_point(point, self._config, lean) for point in by_point]

    async def _coarse(self, fresh: Iterator[tuple[float, float]], reach: Reach) -> Touch:
        """Touch lower and lower until a photograph shows ink."""
        heights_mm = (reach.start_z_mm - k * COARSE_STEP_MM for k in range(coarse_count(reach)))
        spots = ((*next(fresh), max(z_mm, reach.lowest_z_mm)) for z_mm in heights_mm)
        return await self._row(spots, COARSE_STEP_MM, SPOTS_PER_PHOTO)

    async def _fine(
        self, fresh: Iterator[tuple[float, float]], around: Touch, lean: PaperPlane, higher_mm: float, lowest_mm: float
    ) -> Touch:
        """Touch a whole row in fine steps along the leaning sheet."""
        touched = list[Spot]()
        for k in range(FINE_COUNT):
            x, y = next(fresh)
            along_mm = lean.touch_z_mm(x, y) - lean.touch_z_mm(around.x_mm, around.y_mm)
            z_mm = around.z_mm + along_mm + higher_mm - k * FINE_STEP_MM
            touched.append((x, y, max(z_mm, lowest_mm)))
        return await self._row(touched, FINE_STEP_MM, FINE_COUNT)

    async def _row(self, spots: Iterable[Spot], step_mm: float, per_photograph: int) -> Touch:
        """Touch one spot after the other until a photograph shows ink. Raises `StepError` if none does."""
        before, touched = await self._photograph(), list[Spot]()
        for spot in spots:
            touched.append(spot)
            await self._touch(spot)
            if len(touched) % per_photograph == 0:
                ink = await self._ink(before, touched)
                if (ink >= LEAST_INK_MM2).any():
                    return self._between(touched, ink, step_mm)
        raise StepError(f"nothing was touched down to {touched[-1][2]:.2f} mm: no spot of the row left ink")

    def _between(self, touched: list[Spot], ink_mm2: NDArray[np.float64], step_mm: float) -> Touch:
        """Half way between the last clean spot and the first inked one; every height between them is equally likely."""
        first = first_ink(ink_mm2, LEAST_INK_MM2)
        x, y, z = (0.5 * (a + b) for a, b in zip(touched[first - 1], touched[first], strict=True))
        return Touch(x, y, z, step_mm / math.sqrt(12.0))

    async def _touch(self, spot: Spot) -> None:
        if self._since_dip is None or self._since_dip >= SPOTS_PER_DIP:
            await self._dip()
            self._since_dip = 0
        x, y, z = spot
        await self._procedures.approach(x, y, z + self._config.above_mm)
        down = Move(touching(self._rig.config, x, y, z), self._config.speed_mm_s)
        await self._procedures.queue([down, up(self._rig.config, x, y)])
        self._since_dip += 1
        self._last = None

    async def _photograph(self) -> Frame:
        if self._last is None:
            self._last = await self._procedures.capture()
        return self._last

    async def _ink(self, before: Frame, touched: list[Spot]) -> NDArray[np.float64]:
        after = await self._photograph()
        frames = await asyncio.to_thread(before_and_after, self._rig.config, before, after)
        return await asyncio.to_thread(ink_at, *frames, [(x, y) for x, y, _ in touched], WINDOW_MM)


def _plane(touches: list[Touch]) -> PaperPlane:
    return fit_plane([(t.x_mm, t.y_mm, t.z_mm) for t in touches])[0]
