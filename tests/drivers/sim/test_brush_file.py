"""A brush described in a TOML file, and the frozen brushes, which press as they did when they were frozen."""

from __future__ import annotations

import itertools
import tomllib
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

import brushloop.__main__
from bench.brushes import FROZEN
from brushloop.collect.rig.config_touch import QualityConfig
from brushloop.drivers.sim.brush.brush import Brush, BrushSpec, Flaw, Waypoint
from brushloop.drivers.sim.brush.spec import PAPER, SimFileError, load_brush
from brushloop.drivers.sim.config import SimConfig
from brushloop.drivers.sim.rig import Addresses, rig_toml

PRESSED = (
    (3986.908, 3129.639, 3100.391),
    (4034.102, 3255.779, 3098.008),
    (4272.797, 3165.911, 3266.336),
    (4235.855, 3262.018, 3449.286),
    (3842.285, 2882.832, 2868.087),
    (10297.543, 8338.703, 7977.463),
)
"""Ink of a press, a drag and a split press of each frozen brush and of the paper's, as pressed when they were made."""


def written(folder: Path, text: str) -> Path:
    path = folder / "brush.toml"
    path.write_text(text)
    return path


def test_a_brush_is_read_and_what_is_left_out_is_the_default(tmp_path: Path) -> None:
    found = load_brush(written(tmp_path, 'name = "our goat-hair brush"\n[brush]\nfriction = 0.3\nseed = 4\n'))
    assert found.name == "our goat-hair brush"
    assert found.spec == BrushSpec(friction=0.3, seed=4)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("friction = 3.0", r"brush: friction = 3 is outside 0 \.\. 0\.8"),
        ("frictoin = 0.3", r"brush\.frictoin: "),
        ("friction = nan", r"brush\.friction: .*finite"),
        ("bristles = 400.5", r"brush\.bristles: .*integer"),
        ("radius_mm = 19.0\nlength_mm = 40.0", r"brush: length_mm = 40 is outside 57 \.\. 120"),
        ("friction = ", "is not TOML"),
    ],
)
def test_a_brush_out_of_range_is_refused_with_file_field_and_range(tmp_path: Path, text: str, message: str) -> None:
    path = written(tmp_path, f'name = "any"\n[brush]\n{text}\n')
    with pytest.raises(SimFileError, match=message) as refused:
        load_brush(path)
    assert str(refused.value).startswith(f"{path}: ")
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize(("depth_mm", "width_mm"), [(11.0, 8.67), (20.0, 15.77)])
def test_the_paper_s_brush_marks_nearly_as_wide_as_ccd_bsm_says_and_says_for_what_it_was_made(
    depth_mm: float, width_mm: float
) -> None:
    found = load_brush(Path(PAPER))
    assert "made to agree with the paper's Table 2: no evidence for the model" in found.name
    mark = Brush(found.spec).press(depth_mm, 5.0, ink_load=1.0, press_seed=1)
    width = (mark.density > 0.4).sum(axis=0) / mark.px_per_mm
    assert 0.8 < width.max() / width_mm < 1.2


def test_the_rig_toml_of_the_paper_s_brush_says_where_its_marks_begin() -> None:
    found = load_brush(Path(PAPER))
    assert found.head is not None
    heads_mm: list[float] = []
    for depth_mm, tilt_deg in itertools.product((11.0, 20.0), (0.0, 5.0, 10.0)):
        mark = Brush(found.spec).press(depth_mm, tilt_deg, ink_load=1.0, press_seed=1)
        columns = np.flatnonzero((mark.density > 0.5).any(axis=0))
        heads_mm.append((columns[-1] + 1 - mark.origin_px[0]) / mark.px_per_mm)
    assert max(abs(at - found.head.head_mm) for at in heads_mm) < found.head.misplaced_mm - 0.5
    assert max(abs(at - QualityConfig().head_mm) for at in heads_mm) > QualityConfig().misplaced_mm

    at = Addresses("127.0.0.1", 1, 2, 3, None, None)
    quality = tomllib.loads(rig_toml(SimConfig(brush=found.spec, head=found.head), at))["quality"]
    assert quality == {"head_mm": found.head.head_mm, "misplaced_mm": found.head.misplaced_mm}
    assert "quality" not in tomllib.loads(rig_toml(SimConfig(), at))


def test_the_rig_is_served_with_the_brush_and_records_its_name(tmp_path: Path) -> None:
    path = written(tmp_path, 'name = "our goat-hair brush"\n[brush]\nradius_mm = 5.0\nlength_mm = 45.0\n')
    rig = tmp_path / "rig.toml"
    words = ["sim", "--brush", str(path), "--write-rig", str(rig), "--idle-exit", "0.1"]
    assert CliRunner().invoke(brushloop.__main__.app, words).exit_code == 0
    brush = tomllib.loads(rig.read_text())["brush"]
    assert (brush["name"], brush["radius_mm"], brush["length_mm"]) == ("our goat-hair brush", 5.0, 45.0)


def test_the_frozen_brushes_and_the_papers_press_and_draw_what_they_always_did() -> None:
    # the bytes agreed too; another processor may round the last bit differently
    ink: list[list[float]] = []
    for spec in (*FROZEN, load_brush(Path(PAPER)).spec):
        brush = Brush(spec)
        press = brush.press(12.0, 5.0, ink_load=0.8, press_seed=3)
        split = brush.press(9.0, 0.0, ink_load=1.0, press_seed=4, flaw=Flaw.SPLIT, severity=0.7)
        path = [Waypoint(0, 0, 0), Waypoint(0, 0, 5), Waypoint(12, 4, 5)]
        drag = brush.drag(path, 0, 0, ink_load=1.0, press_seed=1)
        ink.append([float(mark.density.sum(dtype=float)) for mark in (press, drag, split)])
    assert ink == [pytest.approx(row, rel=1e-5) for row in PRESSED]
