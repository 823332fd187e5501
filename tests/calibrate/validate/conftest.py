"""Sessions of presses by the simulated brush, imported from photographs: small, quick, and with one blank capture."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from brushloop.drivers.sim.brush.brush import Brush, BrushSpec
from brushloop.sessions.imports import ImportOptions, import_photographs

CELLS = [(11.0, 0.0), (11.0, 10.0), (15.0, 5.0), (20.0, 0.0), (20.0, 10.0)]
PX_MM = 10.0
TOUCH = (380, 150)
MakeSession = Callable[..., Path]


def photograph(depth_mm: float, tilt_deg: float, seed: int, brush: Brush) -> np.ndarray:
    """A press on white paper at 10 px/mm, its tip touching at TOUCH."""
    mark = brush.press(depth_mm, tilt_deg, ink_load=1.0, press_seed=seed)
    page = np.full((300, 480), 235, np.uint8)
    rows, columns = mark.density.shape
    left, top = TOUCH[0] - round(mark.origin_px[0]), TOUCH[1] - round(mark.origin_px[1])
    page[top : top + rows, left : left + columns] = 235 - np.rint(200 * np.clip(mark.density, 0, 1)).astype(np.uint8)
    return page


@pytest.fixture(scope="session")
def make_session() -> MakeSession:
    """Make a session of `repeats` presses of each cell under a folder, its last photograph blank if wanted."""

    def make(under: Path, name: str = "presses", *, repeats: int = 2, blank: bool = True, seed: int = 0) -> Path:
        photos = under / f"{name}-photos"
        photos.mkdir(parents=True)
        brush = Brush(BrushSpec())
        lines = ["file,depth_mm,tilt_deg,px_per_mm,start_x_px,start_y_px"]
        for k, (height, tilt) in enumerate(CELLS * repeats):
            file = f"{k:03d}.png"
            cv2.imwrite(str(photos / file), photograph(height, tilt, seed + k, brush))
            lines.append(f"{file},{height},{tilt},{PX_MM},{TOUCH[0]},{TOUCH[1]}")
        if blank:
            cv2.imwrite(str(photos / "blank.png"), np.full((300, 480), 235, np.uint8))
            lines.append(f"blank.png,11.0,0.0,{PX_MM},{TOUCH[0]},{TOUCH[1]}")
        table = photos / "strokes.csv"
        table.write_text("\n".join(lines) + "\n")
        out = under / name
        origin = "<script>alert(1)</script>"
        import_photographs(photos, table, out, ImportOptions(kind="press", origin=origin), "test", lambda: 1)
        return out

    return make


@pytest.fixture(scope="session")
def session(make_session: MakeSession, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Ten presses of five cells, and a blank capture. Nobody writes into it."""
    return make_session(tmp_path_factory.mktemp("sessions"))
