"""The simulated brush: its marks and forces, its drags and its flaws, and the TOML file that describes one."""

from __future__ import annotations

import itertools
import subprocess
import sys
import tomllib
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

import brushloop.__main__
from bench.brushes import FROZEN
from brushloop.collect.rig.config import QualityConfig
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
PUSHED_N = (0.122442, 0.140344, 0.128596, 0.257277, 0.080573, 0.036874)
"""Force of that press."""

FLAWED = {
    None: 7146.251,
    Flaw.SPLIT: 7618.547,
    Flaw.BENT: 7289.363,
    Flaw.DRY: 4110.589,
    Flaw.BLANK: 0.0,
    Flaw.FAINT: 3394.469,
}
"""Ink of a press of the default brush with each flaw."""
EMPTYING = {0.7: 5663.099, 0.4: 3673.846, 0.2: 1883.439, 0.0: 0.0}
"""Ink of a press of the default brush by ink load."""


def test_the_frozen_brushes_and_the_papers_press_and_draw_what_they_always_did() -> None:
    # the bytes agreed too; another processor may round the last bit differently
    ink: list[list[float]] = []
    force_n: list[float] = []
    for spec in (*FROZEN, load_brush(Path(PAPER)).spec):
        brush = Brush(spec)
        press = brush.press(12.0, 5.0, ink_load=0.8, press_seed=3)
        split = brush.press(9.0, 0.0, ink_load=1.0, press_seed=4, flaw=Flaw.SPLIT, severity=0.7)
        path = [Waypoint(0, 0, 0), Waypoint(0, 0, 5), Waypoint(12, 4, 5)]
        drag = brush.drag(path, 0, 0, ink_load=1.0, press_seed=1)
        force_n.append(float(brush.push_n(12.0, 5.0)[-1]))
        ink.append([float(mark.density.sum(dtype=float)) for mark in (press, drag, split)])
    assert ink == [pytest.approx(row, rel=1e-5) for row in PRESSED]
    assert force_n == pytest.approx(PUSHED_N, rel=1e-4)


def test_a_flaw_and_an_emptying_brush_take_the_ink_that_they_always_took(brush: Brush) -> None:
    flawed = {flaw: brush.press(15.0, 5.0, ink_load=1.0, press_seed=1, flaw=flaw, severity=0.7) for flaw in FLAWED}
    assert {flaw: float(mark.density.sum(dtype=float)) for flaw, mark in flawed.items()} == pytest.approx(
        FLAWED, rel=1e-5
    )
    marks = {load: brush.press(15.0, 5.0, ink_load=load, press_seed=1) for load in EMPTYING}
    assert {load: float(mark.density.sum(dtype=float)) for load, mark in marks.items()} == pytest.approx(
        EMPTYING, rel=1e-5
    )


@pytest.fixture(scope="module")
def brush() -> Brush:
    return Brush(BrushSpec())


@pytest.mark.parametrize("depth_mm", [0.0, -3.0])
def test_no_touch_no_ink(brush, depth_mm):
    blank = brush.press(depth_mm, 5.0, ink_load=1.0, press_seed=1)
    assert not blank.density.any()
    assert max(blank.density.shape) <= 100


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"depth_mm": 45.0}, r"depth_mm = 45 is outside -inf \.\. 43\.2"),
        ({"depth_mm": float("nan")}, "depth_mm = nan is outside"),
        ({"tilt_deg": -1.0}, r"tilt_deg = -1 is outside 0 \.\. 30"),
        ({"ink_load": 1.2}, r"ink_load = 1\.2 is outside 0 \.\. 1"),
        ({"px_per_mm": 0.0}, r"px_per_mm = 0 is outside 2 \.\. 40"),
    ],
)
def test_a_press_out_of_range_is_refused_with_the_range(brush, change, message):
    press = {"depth_mm": 15.0, "tilt_deg": 0.0, "ink_load": 1.0, "press_seed": 1} | change
    with pytest.raises(ValueError, match=message):
        brush.press(**press)


def test_the_brush_knows_neither_model_nor_torch():
    unwanted = {"brushloop.model", "torch", "brushloop.collect"}
    probe = f"import sys, brushloop.drivers.sim.world; print(sorted({unwanted} & set(sys.modules)))"
    done = subprocess.run([sys.executable, "-c", probe], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def written(folder: Path, text: str) -> Path:
    path = folder / "brush.toml"
    path.write_text(text)
    return path


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("friction = 3.0", r"brush: friction = 3 is outside 0 \.\. 0\.8"),
        ("friction = nan", r"brush\.friction: .*finite"),
        ("bristles = 400.5", r"brush\.bristles: .*integer"),
        ("radius_mm = 19.0\nlength_mm = 40.0", r"brush: length_mm = 40 is outside 57 \.\. 120"),
        ("friction = ", "is not TOML"),
        ("# " + 300_000 * "x", "is larger than 262144 bytes"),
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
    paper = load_brush(Path(PAPER))
    assert "made to agree with the paper's Table 2: no evidence for the model" in paper.name
    mark = Brush(paper.spec).press(depth_mm, 5.0, ink_load=1.0, press_seed=1)
    width = (mark.density > 0.4).sum(axis=0) / mark.px_per_mm
    assert 0.8 < width.max() / width_mm < 1.2


def test_the_rig_toml_of_the_paper_s_brush_says_where_its_marks_begin() -> None:
    paper = load_brush(Path(PAPER))
    assert paper.head is not None
    heads_mm: list[float] = []
    for depth_mm, tilt_deg in itertools.product((11.0, 20.0), (0.0, 5.0, 10.0)):
        mark = Brush(paper.spec).press(depth_mm, tilt_deg, ink_load=1.0, press_seed=1)
        columns = np.flatnonzero((mark.density > 0.5).any(axis=0))
        heads_mm.append((columns[-1] + 1 - mark.origin_px[0]) / mark.px_per_mm)
    assert max(abs(at - paper.head.head_mm) for at in heads_mm) < paper.head.misplaced_mm - 0.5
    assert max(abs(at - QualityConfig().head_mm) for at in heads_mm) > QualityConfig().misplaced_mm

    at = Addresses("127.0.0.1", 1, 2, 3, None, None)
    quality = tomllib.loads(rig_toml(SimConfig(brush=paper.spec, head=paper.head), at))["quality"]
    assert quality == {"head_mm": paper.head.head_mm, "misplaced_mm": paper.head.misplaced_mm}
    assert "quality" not in tomllib.loads(rig_toml(SimConfig(), at))


def test_the_rig_is_served_with_the_brush_and_records_its_name(tmp_path: Path) -> None:
    path = written(tmp_path, 'name = "our goat-hair brush"\n[brush]\nradius_mm = 5.0\nlength_mm = 45.0\n')
    rig = tmp_path / "rig.toml"
    words = ["sim", "--brush", str(path), "--write-rig", str(rig), "--idle-exit", "0.1"]
    assert CliRunner().invoke(brushloop.__main__.app, words).exit_code == 0
    brush = tomllib.loads(rig.read_text())["brush"]
    assert (brush["name"], brush["radius_mm"], brush["length_mm"]) == ("our goat-hair brush", 5.0, 45.0)
