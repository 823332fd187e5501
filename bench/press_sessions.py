"""Sessions of presses by the simulated brush (loopback rig), imported from photographs that are drawn for a bench."""

from __future__ import annotations

import tempfile
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from brushloop.calibrate.compare.place import Field
from brushloop.calibrate.validate.jobs import PrepareJob, Press, prepare_job
from brushloop.drivers.sim.brush.brush import Brush, BrushSpec
from brushloop.sessions.imports import ImportOptions, import_photographs
from brushloop.sessions.recording import Recording

CELLS = tuple((height, tilt) for height in (11.0, 13.0, 15.0, 17.0, 20.0) for tilt in (0.0, 5.0, 10.0))
PX_MM = 10.0
PHOTOGRAPHS = 30


@dataclass(frozen=True, slots=True)
class View:
    """A photograph's size, where the tip touches on it, and the standard deviation of its noise in gray levels."""

    width_px: int = 480
    height_px: int = 300
    touch_px: tuple[int, int] = (380, 150)
    noise: float = 0.0


CLOSE = View()
"""The stroke and its surroundings, without noise: where only the score counts."""
STILL = View(2048, 1536, (1100, 768), 2.0)
"""As the loopback camera takes it: where time and memory count."""


@dataclass(frozen=True, slots=True)
class Presses:
    """Which presses are photographed, and how."""

    strokes: int
    seed: int
    spec: BrushSpec | None = None
    """The brush; by default one that the seed chooses."""
    distinct: int = PHOTOGRAPHS
    """How many photographs are drawn; after them they repeat, which no cache here can notice."""
    view: View = CLOSE


def session(under: Path, name: str, presses: Presses) -> Path:
    """A session of these presses."""
    photos = photographs(under / f"{name}-photos", presses)
    out = under / name
    import_photographs(photos, photos / "strokes.csv", out, ImportOptions(kind="press"), "bench", lambda: 1)
    return out


def photographs(photos: Path, presses: Presses) -> Path:
    """A new folder of these photographs, with the table for an import, `strokes.csv`; files that repeat are links."""
    photos.mkdir()
    view, seed = presses.view, presses.seed
    drawn = min(presses.distinct, presses.strokes)
    brush = Brush(presses.spec or BrushSpec(seed=1 + seed))
    for k in range(drawn):
        cv2.imwrite(str(photos / f"{k:06d}.png"), photograph(brush, *CELLS[k % len(CELLS)], seed + k, view))
    for k in range(drawn, presses.strokes):
        (photos / f"{k:06d}.png").hardlink_to(photos / f"{k % drawn:06d}.png")
    write_table(photos, presses)
    return photos


def write_table(photos: Path, presses: Presses) -> None:
    """Write `strokes.csv`, the table for an import of the first `presses.strokes` photographs."""
    lines = ["file,depth_mm,tilt_deg,px_per_mm,start_x_px,start_y_px"]
    for k in range(presses.strokes):
        height, tilt = CELLS[k % presses.distinct % len(CELLS)]
        lines.append(f"{k:06d}.png,{height},{tilt},{PX_MM},{presses.view.touch_px[0]},{presses.view.touch_px[1]}")
    (photos / "strokes.csv").write_text("\n".join(lines) + "\n")


def pressed(cell: tuple[float, float], repeats: int, seed: int) -> list[Press]:
    """Presses of one cell, found on their photographs."""
    with tempfile.TemporaryDirectory() as folder:
        photos = Path(folder) / "photos"
        photos.mkdir()
        brush = Brush(BrushSpec(seed=1 + seed))
        lines = ["file,depth_mm,tilt_deg,px_per_mm,start_x_px,start_y_px"]
        for k in range(repeats):
            cv2.imwrite(str(photos / f"{k:03d}.png"), photograph(brush, *cell, seed + k))
            lines.append(f"{k:03d}.png,{cell[0]},{cell[1]},{PX_MM},{CLOSE.touch_px[0]},{CLOSE.touch_px[1]}")
        (photos / "strokes.csv").write_text("\n".join(lines) + "\n")
        out = Path(folder) / "presses"
        import_photographs(photos, photos / "strokes.csv", out, ImportOptions(kind="press"), "bench", lambda: 1)
        return [prepare_job(PrepareJob(capture, None, Field())) for capture in Recording(out).captures()]


def photograph(brush: Brush, depth_mm: float, tilt_deg: float, seed: int, view: View = CLOSE) -> NDArray[np.uint8]:
    """A press on white paper, its tip touching at the view's place."""
    mark = brush.press(depth_mm, tilt_deg, ink_load=1.0, press_seed=seed)
    page = np.full((view.height_px, view.width_px), 235, np.uint8)
    rows, columns = mark.density.shape
    left, top = view.touch_px[0] - round(mark.origin_px[0]), view.touch_px[1] - round(mark.origin_px[1])
    page[top : top + rows, left : left + columns] = 235 - np.rint(200 * np.clip(mark.density, 0, 1)).astype(np.uint8)
    if view.noise == 0.0:
        return page
    noisy = page + np.random.default_rng(seed).normal(0.0, view.noise, page.shape)
    return np.rint(np.clip(noisy, 0, 255)).astype(np.uint8)
