"""Marks of the simulated brush as photographs on white paper, and a session that is imported from them."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Literal

import cv2
import numpy as np

from brushloop.drivers.sim.brush.brush import Brush, BrushSpec
from brushloop.drivers.sim.brush.footprint import Footprint
from brushloop.sessions.imports import ImportOptions, import_photographs

PAPER_GRAY, INK_GRAY = 235, 200
"""Gray of the paper, and how much of it full ink takes away."""


def photograph(path: Path, mark: Footprint, size_px: tuple[int, int], touch_px: tuple[int, int]) -> None:
    """Write the mark on a page of (height, width) pixels; `touch_px` (x, y) is where the tip touched."""
    page = np.full(size_px, PAPER_GRAY, np.uint8)
    rows, columns = mark.density.shape
    left, top = touch_px[0] - round(mark.origin_px[0]), touch_px[1] - round(mark.origin_px[1])
    ink = np.rint(INK_GRAY * np.clip(mark.density, 0, 1)).astype(np.uint8)
    page[top : top + rows, left : left + columns] -= ink
    cv2.imwrite(str(path), page)


def imported(
    photos: Path,
    lines: Sequence[str],
    out: Path,
    kind: Literal["press", "drag"],
    *,
    simulated: bool = False,
    origin: str = "",
) -> Path:
    """The session of these photographs; `lines` are those of their table, its head first."""
    table = photos / "strokes.csv"
    table.write_text("\n".join(lines) + "\n")
    options = ImportOptions(kind=kind, simulated=simulated, origin=origin)
    import_photographs(photos, table, out, options, "test", lambda: 1)
    return out


def imported_presses(
    under: Path,
    at: Sequence[tuple[float, float]],
    size_px: tuple[int, int] = (300, 480),
    touch_px: tuple[int, int] = (380, 150),
    *,
    name: str = "presses",
    seed: int = 0,
    blank: bool = False,
    origin: str = "",
) -> Path:
    """`under / name`: the session of one press of the default brush for each (H, alpha), taken at 10 px/mm.

    The presses differ with `seed`; the last photograph, called "blank", shows nothing if wanted.
    """
    photos = under / f"{name}-photos"
    photos.mkdir(parents=True)
    lines = ["file,depth_mm,tilt_deg,px_per_mm,start_x_px,start_y_px"]
    for k, (height, tilt) in enumerate(at):
        mark = Brush(BrushSpec()).press(height, tilt, ink_load=1.0, press_seed=seed + k)
        photograph(photos / f"{k}.png", mark, size_px, touch_px)
        lines.append(f"{k}.png,{height},{tilt},10.0,{touch_px[0]:.1f},{touch_px[1]:.1f}")
    if blank:
        cv2.imwrite(str(photos / "blank.png"), np.full(size_px, PAPER_GRAY, np.uint8))
        lines.append(f"blank.png,11.0,0.0,10.0,{touch_px[0]:.1f},{touch_px[1]:.1f}")
    return imported(photos, lines, under / name, "press", origin=origin)
