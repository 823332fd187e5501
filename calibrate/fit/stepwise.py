"""The next press from the ink of those before, as text that a journal holds. No torch: a rig PC runs it.

Pure: the same captures give the same choice, in every process.
"""

from __future__ import annotations

import base64
import binascii
import hashlib
import zlib
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from calibrate.compare.field import SIZE_PX, Field
from calibrate.fit.adaptive import Cell, next_press
from calibrate.fit.fit import Grid, Pressed, fit_presses
from model.fitted import FittedPress

FIELD = Field()
"""Around the point of touch, as `brushloop fit` has it by default."""
REACH_MM = 12.0
"""To either side of the axis: no press of a brush that the loopback rig or the paper has is wider."""
LEVELS = 15
GIVEN_UP = 2
"""A cell whose captures showed no whole stroke so often is not chosen again."""


@dataclass(frozen=True, slots=True)
class Seen:
    """One captured press."""

    height_mm: float
    tilt_deg: float
    ink: str
    """Of `packed`; empty where the capture showed no whole stroke."""


@dataclass(frozen=True, slots=True)
class Design:
    """What can be chosen, and when to stop."""

    radius_mm: float
    length_mm: float
    cells: tuple[Cell, ...]
    enough_points: float
    least: int


@dataclass(frozen=True, slots=True)
class Next:
    """The choice."""

    cell: Cell | None
    """None: stop."""
    points: float
    """CSIM points, in the mean over the cells, that the presses so far leave to be won."""
    points_after: float
    strokes: int
    """Captures that the fit was made of."""
    ink_sha256: str
    """Of their ink, in the order of the fit."""
    why: str


def packed(mask: NDArray[np.bool_]) -> str:
    """A stroke on the field's raster (any even scale) as text: coverage of each pixel in 16 steps, compressed."""
    ink = cv2.resize(mask.astype(np.float32), (SIZE_PX, SIZE_PX), interpolation=cv2.INTER_AREA)[_rows()]
    return base64.b64encode(zlib.compress(np.round(LEVELS * ink).astype(np.uint8).tobytes(), 9)).decode()


def unpacked(text: str) -> NDArray[np.float64]:
    """The inverse: coverage on the pixels of `field_grid`. Raises ValueError for anything else."""
    grid = field_grid()
    shape = len(grid.y_mm), len(grid.x_mm)
    try:
        data = zlib.decompressobj().decompress(base64.b64decode(text, validate=True), shape[0] * shape[1])
        return np.frombuffer(data, np.uint8).reshape(shape) / LEVELS
    except (binascii.Error, zlib.error) as error:
        raise ValueError(f"no ink of a press: {error}") from None


def field_grid() -> Grid:
    """Pixel centres of packed ink around the point of touch."""
    left, top = FIELD.anchor_mm
    centres = np.asarray((np.arange(SIZE_PX) + 0.5) * FIELD.mm_per_px, np.float64)
    return Grid(np.asarray(centres - left), np.asarray(top - centres)[_rows()])


def next_cell(design: Design, seen: Sequence[Seen]) -> Next:
    """Fit what is seen, and choose. A second or two on a slow core."""
    strokes = [Pressed(s.height_mm, s.tilt_deg, unpacked(s.ink)) for s in seen if s.ink]
    digest = hashlib.sha256("\n".join(s.ink for s in seen if s.ink).encode()).hexdigest()
    failed = [(s.height_mm, s.tilt_deg) for s in seen if not s.ink]
    left = [cell for cell in design.cells if failed.count(cell) < GIVEN_UP]
    if not left:
        why = "no cell is left whose captures show a whole stroke"
        return Next(None, 100.0, 100.0, len(strokes), digest, why)
    grid, brush = field_grid(), FittedPress(design.radius_mm, design.length_mm)
    if strokes:
        brush = fit_presses(strokes, grid, design.radius_mm, design.length_mm, edges=False).press
    done = [(s.height_mm, s.tilt_deg) for s in strokes]
    choice = next_press(brush, done, left, grid, enough_points=design.enough_points, least=design.least)
    points, after = min(choice.points, 100.0), min(choice.points_after, 100.0)
    why = (
        f"{points:.2f} points of CSIM are left to be won, at most {design.enough_points:g} were to be"
        if choice.cell is None
        else f"{points:.2f} points of CSIM are left to be won, {after:.2f} after it"
    )
    return Next(choice.cell, points, after, len(strokes), digest, why)


def _rows() -> slice:
    middle, reach = FIELD.anchor_mm[1] / FIELD.mm_per_px, REACH_MM / FIELD.mm_per_px
    return slice(round(middle - reach), round(middle + reach))
