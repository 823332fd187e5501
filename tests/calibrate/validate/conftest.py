"""Sessions of presses by the simulated brush, imported from photographs: small, quick, and with one blank capture."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from brushloop.drivers.sim.brush.brush import Brush, BrushSpec
from tests.photographed import imported, photograph

CONDITIONS = [(11.0, 0.0), (11.0, 10.0), (15.0, 5.0), (20.0, 0.0), (20.0, 10.0)]
TOUCH = (380, 150)
MakeSession = Callable[..., Path]


@pytest.fixture(scope="session")
def make_session() -> MakeSession:
    """Make a session of `repeats` presses of each condition under a folder, its last photograph blank if wanted."""

    def make(under: Path, name: str = "presses", *, repeats: int = 2, blank: bool = True, seed: int = 0) -> Path:
        photos = under / f"{name}-photos"
        photos.mkdir(parents=True)
        brush = Brush(BrushSpec())
        lines = ["file,depth_mm,tilt_deg,px_per_mm,start_x_px,start_y_px"]
        for k, (depth_mm, tilt_deg) in enumerate(CONDITIONS * repeats):
            mark = brush.press(depth_mm, tilt_deg, ink_load=1.0, press_seed=seed + k)
            photograph(photos / f"{k:03d}.png", mark, (300, 480), TOUCH)
            lines.append(f"{k:03d}.png,{depth_mm},{tilt_deg},10.0,{TOUCH[0]},{TOUCH[1]}")
        if blank:
            cv2.imwrite(str(photos / "blank.png"), np.full((300, 480), 235, np.uint8))
            lines.append(f"blank.png,11.0,0.0,10.0,{TOUCH[0]},{TOUCH[1]}")
        return imported(photos, lines, under / name, "press", origin="<script>alert(1)</script>")

    return make


@pytest.fixture(scope="session")
def session(make_session: MakeSession, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Ten presses of five conditions, and a blank capture. Nobody writes into it."""
    return make_session(tmp_path_factory.mktemp("sessions"))
