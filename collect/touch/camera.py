"""Zero touch by first ink: touch rows of fresh spots, each a little lower, and find where the new ink begins."""

from __future__ import annotations

import asyncio
import itertools
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
from brushloop.collect.errors import StepError
from brushloop.collect.motion import Dip, Move, Procedures, over, slowly, upright
from brushloop.collect.photograph.frames import undistorted
from brushloop.collect.rig.config import PaperConfig, RigConfig, TouchConfig
from brushloop.collect.rig.paper import PaperPlane, fit_plane
from brushloop.collect.touch.heights import KnownHeights, Reach, Touch, at_one_point
from brushloop.drivers.devices import Frame
from brushloop.sessions.events import TouchedPoint

DARK_SHARE = 0.5
"""Pixels darker than this share of the paper are not paper, and are ignored in measuring the change of light."""
DARKER = 0.2
"""Share of the paper's brightness that a pixel must have lost to belong to a mark."""
JOIN_MM = 1.5
"""Parts that lie closer together belong to one mark."""


@dataclass(frozen=True, slots=True)
class Mark:
    """A mark of new ink: its centroid, weighted by darkness, in the paper frame, and its mm2 of black."""

    x_mm: float
    y_mm: float
    ink_mm2: float


def new_marks(config: RigConfig, before: Frame, after: Frame, least_ink_mm2: float) -> list[Mark]:
    """New marks of at least `least_ink_mm2`, the largest first. The camera must not have moved in between.

    The change of the light is taken off; a picture that shows no paper shows no marks. Raises `StepError` if the board
    is not seen.
    """
    import skimage.measure  # slow to import

    first, second = (undistorted(config.camera, frame.image) for frame in (before, after))
    try:
        image_to_paper = see_board(second, config.board).plane.homography
    except CalibrationError as error:
        raise StepError(f"the board is not seen: {error.what}") from None
    first, second = first.astype(np.float32), second.astype(np.float32)
    paper = float(np.quantile(first, 0.9))
    clean = first > DARK_SHARE * paper
    if paper < 1.0 or not clean.any():
        return []
    light = float(np.median(second[clean] / first[clean]))
    darkening = first - second / max(light, 1e-3)
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


def first_ink(inked: NDArray[np.bool_]) -> int:
    """Index of the first spot with ink in a row of spots, (m,) from the highest to the lowest; one has ink at least.

    Raises `StepError` if the first spot has ink, or if a spot below an inked one has none: otherwise a brush that ran
    dry would be mistaken for one that did not touch.
    """
    first = int(np.argmax(inked))
    if first == 0:
        raise StepError("the highest touch of the row left ink: the paper lies higher than expected")
    if not inked[first:].all():
        missing = first + int(np.argmin(inked[first:]))
        raise StepError(f"touch {missing + 1} of the row left no ink though a higher one did: is the brush dry?")
    return first


COARSE_STEP_MM, FINE_STEP_MM = 0.5, 0.08
"""Steps of the rows of touches by camera; the error of a touch is about half of a fine step."""
PITCH_MM, COLUMNS = 4.0, 9
"""Distance between spots, and spots in a row of a point's patch: a shallow touch leaves a mark of one to three
millimetres, and camera and arm must agree on the place within a quarter of the pitch."""
EXTENT_MM = (COLUMNS - 1) * PITCH_MM
SPOTS_PER_PHOTO = 2
"""Touches per photograph in the coarse row, which ends when ink is seen; few, so that spots stay small."""
SLACK_STEPS = 2
"""Fine steps beyond the coarse step, on either side: a coarse touch is accurate only to its step."""
FINE_COUNT = 1 + 2 * SLACK_STEPS + math.ceil(COARSE_STEP_MM / FINE_STEP_MM)
"""Spots of one fine row."""
OFF_MM = 0.375 * PITCH_MM
"""How far along either axis a spot's mark may lie from it."""
SPOTS_PER_DIP = 2
"""Touches after which the brush is dipped again: a tip that dries leaves no ink at first."""
LEAST_INK_MM2 = 0.25
"""Darkening that counts as ink: area times how much darker it became, 1 being black."""
Spot = tuple[float, float, float]
"""x and y in the paper frame, z of the tip in the base frame."""


def spots(at_mm: tuple[float, float], sheet_mm: tuple[float, float]) -> Iterator[tuple[float, float]]:
    """Fresh spots around one point, to and fro from the lower left, so that consecutive touches are neighbours.

    Raises `StepError` where the next one does not lie on the sheet.
    """
    for number in itertools.count():
        row, column = divmod(number, COLUMNS)
        column = COLUMNS - 1 - column if row % 2 else column
        x_mm, y_mm = at_mm[0] + column * PITCH_MM, at_mm[1] + row * PITCH_MM
        if not (0.0 <= x_mm <= sheet_mm[0] and 0.0 <= y_mm <= sheet_mm[1]):
            raise StepError(
                f"the touches at ({at_mm[0]:g}, {at_mm[1]:g}) mm do not fit on the sheet: "
                f"spot {number + 1} would lie at ({x_mm:g}, {y_mm:g}) mm"
            )
        yield x_mm, y_mm


def coarse_count(reach: Reach) -> int:
    """Spots of a whole coarse row, which ends early where ink is seen; all of them are photographed."""
    heights = math.ceil((reach.start_z_mm - reach.lowest_z_mm) / COARSE_STEP_MM) + 1
    return math.ceil(heights / SPOTS_PER_PHOTO) * SPOTS_PER_PHOTO


def most_spots(paper: PaperConfig, config: TouchConfig) -> list[tuple[Reach, int]]:
    """The first approach at each point, and the most spots that its patch may take."""
    known = KnownHeights(paper, config, EXTENT_MM)
    reaches = [known.reach(*point) for point in config.points_mm]
    return [(reach, coarse_count(reach) + config.touches * FINE_COUNT) for reach in reaches]


def most_dips(paper: PaperConfig, config: TouchConfig) -> int:
    """The most dips that the touches of all points may take."""
    return sum(math.ceil(count / SPOTS_PER_DIP) for _, count in most_spots(paper, config))


class FirstInkTouch:
    """Touches by camera on one rig. The sheet must be blank where it touches."""

    def __init__(self, procedures: Procedures, config: TouchConfig, dip: Dip) -> None:
        self._procedures = procedures
        self._rig = procedures.rig
        self._config = config
        self._dip = dip
        self._since_dip = SPOTS_PER_DIP
        self._last: Frame | None = None

    async def measure(self, points_mm: list[tuple[float, float]]) -> list[TouchedPoint]:
        """Touch every point coarsely, then finely in rounds, each along the plane fitted to the previous round.

        Without that plane, the sheet's lean along a row would be mistaken for height. Raises `StepError`.
        """
        paper, touches = self._rig.config.paper, self._config.touches
        known, rough = KnownHeights(paper, self._config, EXTENT_MM), list[Touch]()
        patches = list[tuple[Iterator[tuple[float, float]], Reach]]()
        for point in points_mm:
            fresh, reach = spots(point, paper.size_mm), known.reach(*point)
            patches.append((fresh, reach))
            rough.append(await self._coarse(fresh, reach))
            known.add(rough[-1].x_mm, rough[-1].y_mm, rough[-1].z_mm)
        rounds = [rough]
        for k in range(touches):
            lean = _plane(rounds[-1])
            # Staggered by parts of a step: equal heights would only repeat the same result.
            higher_mm = 0.5 * FINE_STEP_MM * (FINE_COUNT - 1) - k / touches * FINE_STEP_MM
            places = zip(patches, rough, strict=True)
            rounds.append([await self._fine(*patch, around, lean, higher_mm) for patch, around in places])
        by_point = [list(point) for point in zip(*rounds[1:], strict=True)]
        lean = _plane([touch for point in by_point for touch in point])
        return [at_one_point(point, self._config, lean) for point in by_point]

    async def _coarse(self, fresh: Iterator[tuple[float, float]], reach: Reach) -> Touch:
        """Touch lower and lower until a photograph shows ink."""
        heights_mm = (reach.start_z_mm - k * COARSE_STEP_MM for k in range(coarse_count(reach)))
        spots = ((*next(fresh), max(z_mm, reach.lowest_z_mm)) for z_mm in heights_mm)
        return await self._row(spots, COARSE_STEP_MM, SPOTS_PER_PHOTO)

    async def _fine(
        self, fresh: Iterator[tuple[float, float]], reach: Reach, around: Touch, lean: PaperPlane, higher_mm: float
    ) -> Touch:
        """Touch a whole row in fine steps along the leaning sheet."""
        touched = list[Spot]()
        for k in range(FINE_COUNT):
            x, y = next(fresh)
            along_mm = lean.touch_z_mm(x, y) - lean.touch_z_mm(around.x_mm, around.y_mm)
            z_mm = around.z_mm + along_mm + higher_mm - k * FINE_STEP_MM
            touched.append((x, y, max(z_mm, reach.lowest_z_mm)))
        return await self._row(touched, FINE_STEP_MM, FINE_COUNT)

    async def _row(self, spots: Iterable[Spot], step_mm: float, per_photograph: int) -> Touch:
        """Touch one spot after the other until a photograph shows ink. Raises `StepError` if none does."""
        before, touched = await self._photograph(), list[Spot]()
        for spot in spots:
            touched.append(spot)
            await self._touch(spot)
            if len(touched) % per_photograph == 0:
                inked = await self._inked(before, touched)
                if inked.any():
                    # Half way to the last clean spot: every height between them is equally likely.
                    first = first_ink(inked)
                    x, y, z = (0.5 * (a + b) for a, b in zip(touched[first - 1], touched[first], strict=True))
                    return Touch(x, y, z, step_mm / math.sqrt(12.0))
        raise StepError(f"no touch of the row, down to {touched[-1][2]:.2f} mm, left ink on the paper")

    async def _touch(self, spot: Spot) -> None:
        if self._since_dip >= SPOTS_PER_DIP:
            await self._dip()
            self._since_dip = 0
        x, y, z = spot
        rig = self._rig.config
        await self._procedures.go(over(rig, x, y), slowly(rig, x, y, z + self._config.above_mm))
        down = Move(upright(rig, x, y, z), self._config.speed_mm_s)
        up = slowly(rig, x, y, rig.motion.safe_z_mm)
        await self._procedures.queue([down, up])
        self._since_dip += 1
        self._last = None

    async def _photograph(self) -> Frame:
        if self._last is None:
            self._last = await self._procedures.photographer.photograph()
        return self._last

    async def _inked(self, before: Frame, touched: list[Spot]) -> NDArray[np.bool_]:
        """(m,) whether new ink is seen at each spot."""
        after = await self._photograph()
        marks = await asyncio.to_thread(new_marks, self._rig.config, before, after, LEAST_INK_MM2)
        off_mm = [[max(abs(mark.x_mm - x), abs(mark.y_mm - y)) for mark in marks] for x, y, _ in touched]
        return np.array([min(off, default=math.inf) <= OFF_MM for off in off_mm])


def _plane(touches: list[Touch]) -> PaperPlane:
    return fit_plane([(t.x_mm, t.y_mm, t.z_mm) for t in touches])[0]
