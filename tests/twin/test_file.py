"""`twin.toml`, and the file of an interrupted run."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from brushloop.calibrate.errors import CalibrationError
from brushloop.calibrate.fit.heldout import HeldOut
from brushloop.drivers.sim.brush.spec import BrushSpec
from brushloop.drivers.sim.brush_file import load_brush
from brushloop.drivers.sim.config import SoundHead
from brushloop.twin.constants import SHAPE
from brushloop.twin.file import Notes, notes_path, resumed, save_notes, twin_toml
from brushloop.twin.run import Estimate, Twin
from brushloop.twin.shape import Found

SPEC = BrushSpec(radius_mm=5.0, length_mm=42.0, friction=0.3, set_deg=9.0, seed=7)
TWIN = Twin(
    SPEC,
    tuple(Estimate(one, float(getattr(SPEC, one.name)), 0.1, 0.4, one.name != "set_deg") for one in SHAPE),
    None,
    (HeldOut("twin", 95.1, 90.2, 45),),
    SoundHead(2.2, 4.0),
)
FRESH = Notes(recording_sha256="a" * 64, calibration="", mm_per_px=0.3, software="brushloop 0.1.0")
FOUND = Found(np.linspace(-1.0, 1.0, len(SHAPE) + 3), 4)


def test_a_twin_is_read_back_as_the_brush_that_was_fitted(tmp_path: Path) -> None:
    path = tmp_path / "twin.toml"
    path.write_text(twin_toml(TWIN, 'session "1"\n', 1.234))
    found = load_brush(path)
    assert found.spec == SPEC
    assert found.noise_gray == 1.23
    assert found.head == SoundHead(2.2, 4.0)
    assert found.name == "simulated bristle bundle (twin of session ?1??, simulated)"
    lines = {line.split(" = ")[0]: line for line in path.read_text().splitlines()}
    assert lines["friction"].endswith("# 0.1 to 0.4")
    assert "not determined by these presses" in lines["set_deg"]


def test_a_run_that_was_broken_off_goes_on_with_its_steps(tmp_path: Path) -> None:
    path = notes_path(tmp_path / "twin.toml")
    assert resumed(path, FRESH) == FRESH
    save_notes(path, FRESH.with_step("all cells, blur 1.2 mm", FOUND))
    known = resumed(path, FRESH).found()
    assert known["all cells, blur 1.2 mm"].seed == 4
    assert known["all cells, blur 1.2 mm"].point == pytest.approx(FOUND.point)


def test_notes_of_other_captures_are_not_used_and_foreign_ones_are_refused(tmp_path: Path) -> None:
    path = notes_path(tmp_path / "twin.toml")
    save_notes(path, FRESH.with_step("all cells, blur 1.2 mm", FOUND))
    other = FRESH.model_copy(update={"recording_sha256": "b" * 64})
    assert resumed(path, other) == other
    path.write_text('{"steps": 3}')
    with pytest.raises(CalibrationError, match=r"twin\.toml\.unfinished\.json: is not the file of an interrupted"):
        resumed(path, FRESH)
