"""The data of a fit: the presses of a recorded session as images around the point of touch."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import astuple, dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from brushloop.calibrate import presses
from brushloop.calibrate.calibration import Calibration
from brushloop.calibrate.compare.place import SIZE_PX, Field, brush_of
from brushloop.calibrate.errors import CalibrationError
from brushloop.calibrate.presses import Refused, cut, uncommanded
from brushloop.calibrate.session import open_session
from brushloop.calibrate.store import Store
from brushloop.sessions.records import Header
from brushloop.sessions.terminal import Progress, unseen

Floats = NDArray[np.float64]
Cell = tuple[float, float]
"""H and alpha."""

SPREAD_MM = 0.15
"""Variation of an edge from press to press (scale of a logistic)."""
MARGIN_MM = 2.0


@dataclass(frozen=True, slots=True)
class Grid:
    """Pixel centres of an image around the point of touch, mm: x toward the heel, y upward."""

    x_mm: Floats
    y_mm: Floats

    @property
    def px_mm(self) -> float:
        """The pixel's side."""
        return float(self.x_mm[1] - self.x_mm[0])


@dataclass(frozen=True, slots=True)
class Pressed:
    """One captured press: its command and its ink, (len(y_mm), len(x_mm)) from 0 to 1."""

    depth_mm: float
    tilt_deg: float
    ink: NDArray[np.floating]


def by_cell(strokes: Sequence[Pressed]) -> dict[Cell, list[Pressed]]:
    """The strokes of each (H, alpha)."""
    cells: dict[Cell, list[Pressed]] = {}
    for stroke in strokes:
        cells.setdefault((stroke.depth_mm, stroke.tilt_deg), []).append(stroke)
    return dict(sorted(cells.items()))


@dataclass(frozen=True, slots=True)
class Captures:
    """The presses that a fit uses, and where they come from."""

    header: Header
    recording_sha256: str
    calibration: Calibration | None
    radius_mm: float
    length_mm: float
    rows: slice
    """Rows of the field that ink reaches, and 2 mm more; the grid and the strokes are cut to them."""
    grid: Grid
    strokes: list[Pressed]
    stroke_ids: list[str]
    refused: list[tuple[str, str]]
    """(stroke, reason) of captures that cannot be used or are cut by the edge of their photograph."""
    store: Store
    """Finished work of the session."""


def grid_of(view: Field) -> Grid:
    """The pixel centres of the millimetre field around the point of touch."""
    left, top = view.anchor_mm
    centres = np.asarray((np.arange(SIZE_PX) + 0.5) * view.mm_per_px, np.float64)
    return Grid(np.asarray(centres - left), np.asarray(top - centres))


def read_presses(
    session: Path, view: Field, calibration_path: Path | None = None, progress: Progress = unseen
) -> Captures:
    """Read every usable press of a session. Raises `CalibrationError` where it holds none, or was not calibrated."""
    opened = open_session(session, calibration_path, "press")
    pressed: list[Pressed] = []
    names: list[str] = []
    refused: list[Refused] = []
    for press in presses.read_presses(opened, view, refused, uncommanded, cut, progress=progress):
        depth_mm, tilt_deg, _ = astuple(press.condition)
        pressed.append(Pressed(depth_mm, tilt_deg, np.asarray(press.coverage, np.float64)))
        names.append(press.stroke.stroke_id)
    if not pressed:
        raise CalibrationError(str(opened.recording.path), "holds no press that can be used for a fit")
    brush = brush_of(opened.header)
    radius, length = float(brush.radius_mm), float(brush.length_mm)
    grid, rows = grid_of(view), inked_rows([one.ink for one in pressed], view.mm_per_px)
    grid = Grid(grid.x_mm, grid.y_mm[rows])
    pressed = [Pressed(one.depth_mm, one.tilt_deg, one.ink[rows]) for one in pressed]
    about = opened.header, opened.sha256, opened.calibration, radius, length
    return Captures(*about, rows, grid, pressed, names, refused, opened.store)


def inked_rows(images: Sequence[NDArray[np.floating]], px_mm: float) -> slice:
    """Rows that the ink of any of these (rows, columns) images reaches, and 2 mm more."""
    inked = np.flatnonzero(np.any([image.any(axis=1) for image in images], axis=0))
    margin = round(MARGIN_MM / px_mm)
    return slice(max(0, int(inked[0]) - margin), min(len(images[0]), int(inked[-1]) + 1 + margin))
