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
from brushloop.drivers.sim.brush.footprint import COHESIVE_LOAD, flaw_of_load, natural_split
from brushloop.drivers.sim.brush.paper import Footprint
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
    for spec in (*FROZEN, load_brush(Path(PAPER)).spec):
        brush = Brush(spec)
        press = brush.press(12.0, 5.0, ink_load=0.8, press_seed=3)
        split = brush.press(9.0, 0.0, ink_load=1.0, press_seed=4, flaw=Flaw.SPLIT, severity=0.7)
        path = [Waypoint(0, 0, 0), Waypoint(0, 0, 5), Waypoint(12, 4, 5)]
        drag = brush.drag(path, 0, 0, ink_load=1.0, press_seed=1)
        ink.append([float(mark.density.sum(dtype=float)) for mark in (press, drag, split)])
    assert ink == [pytest.approx(row, rel=1e-5) for row in PRESSED]


def test_a_flaw_and_an_emptying_brush_take_the_ink_that_they_always_took(brush: Brush) -> None:
    ink = {flaw: float(flawed(brush, flaw, 0.7).density.sum(dtype=float)) for flaw in FLAWED}
    assert ink == pytest.approx(FLAWED, rel=1e-5)
    marks = {load: brush.press(15.0, 5.0, ink_load=load, press_seed=1) for load in EMPTYING}
    assert {load: float(mark.density.sum(dtype=float)) for load, mark in marks.items()} == pytest.approx(
        EMPTYING, rel=1e-5
    )


@pytest.fixture(scope="module")
def brush() -> Brush:
    return Brush(BrushSpec())


def wet(brush: Brush, depth_mm: float, tilt_deg: float, press_seed: int = 1) -> Footprint:
    return brush.press(depth_mm, tilt_deg, ink_load=1.0, press_seed=press_seed)


def extent_mm(mark: Footprint) -> tuple[float, float]:
    """Length along x and width along y of the ink."""
    rows, columns = np.nonzero(mark.density > 0.3)
    return (np.ptp(columns) + 1) / mark.px_per_mm, (np.ptp(rows) + 1) / mark.px_per_mm


@pytest.mark.parametrize("tilt_deg", [0.0, 10.0])
def test_mark_and_force_grow_with_depth(brush, tilt_deg):
    depths_mm = (5.0, 11.0, 15.0, 20.0)
    marks = [wet(brush, depth, tilt_deg) for depth in depths_mm]
    lengths, widths = zip(*(extent_mm(m) for m in marks), strict=True)
    forces = [float(brush.push_n(depth, tilt_deg)[-1]) for depth in depths_mm]
    for series in (lengths, widths, forces):
        assert all(a < b for a, b in itertools.pairwise(series)), series
    assert 10 < lengths[1] < lengths[-1] < 30
    assert 3 < widths[1] < widths[-1] < 14
    assert 0.05 < forces[1] < forces[-1] < 1.0


@pytest.mark.parametrize("depth_mm", [0.0, -3.0])
def test_no_touch_no_ink(brush, depth_mm):
    blank = wet(brush, depth_mm, 5)
    assert not blank.density.any()
    assert max(blank.density.shape) <= 100


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"depth_mm": 45.0}, r"depth_mm = 45 is outside -inf \.\. 43\.2"),
        ({"depth_mm": 43.0, "tilt_deg": 10.0}, r"depth_mm = 43 is outside -inf \.\. 42\.5"),
        ({"depth_mm": float("nan")}, "depth_mm = nan is outside"),
        ({"tilt_deg": -1.0}, r"tilt_deg = -1 is outside 0 \.\. 30"),
        ({"ink_load": 1.2}, r"ink_load = 1\.2 is outside 0 \.\. 1"),
        ({"press_seed": -1}, "press_seed = -1 is outside"),
        ({"severity": 1.5}, r"severity = 1\.5 is outside 0 \.\. 1"),
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


def down_along_up(corners: list[tuple[float, float]], depth_mm: float) -> list[Waypoint]:
    """Straight down, along the corners at one depth, straight up."""
    points = [Waypoint(x, y, depth_mm) for x, y in corners]
    return [Waypoint(*corners[0], 0.0), *points, Waypoint(*corners[-1], 0.0)]


def ink_mm(mark: Footprint) -> tuple[np.ndarray, np.ndarray]:
    """x and y of the inked pixels relative to the first waypoint."""
    rows, columns = np.nonzero(mark.density > 0.3)
    return (columns + 0.5 - mark.origin_px[0]) / mark.px_per_mm, (mark.origin_px[1] - rows - 0.5) / mark.px_per_mm


def test_the_ink_trails_behind_the_tip_by_a_leash_that_grows_with_depth(brush: Brush):
    short = []
    for depth_mm in (3.0, 6.0, 9.0):
        path = down_along_up([(0.0, 0.0), (40.0, 0.0)], depth_mm)[:-1]  # still down: no lifting to close the gap
        short.append(40.0 - float(ink_mm(brush.drag(path, 0.0, 0.0, ink_load=1.0, press_seed=1))[0].max()))
    assert all(b > a + 0.5 for a, b in itertools.pairwise(short)), short
    assert 0.5 < short[0] < short[-1] < 9.0


def flawed(brush: Brush, flaw: Flaw | None, severity: float = 1.0, *, cell=(15.0, 5.0), seed: int = 1) -> Footprint:
    return brush.press(*cell, ink_load=1.0, press_seed=seed, flaw=flaw, severity=severity)


def gap_mm(mark: Footprint) -> float:
    """Widest run of bare paper between ink of one column, in the half of the mark toward the tip."""
    ink = mark.density > 0.3
    columns = np.flatnonzero(ink.any(axis=0))
    widest = 0
    for column in columns[: columns.size // 2]:
        rows = np.flatnonzero(ink[:, column])
        widest = max(widest, int(np.diff(rows).max(initial=1)) - 1)
    return widest / mark.px_per_mm


def aside_mm(mark: Footprint) -> float:
    """Distance of the tip third's centroid from the axis of the brush."""
    rows, columns = np.nonzero(mark.density > 0.3)
    third = columns < columns.min() + np.ptp(columns) / 3
    return abs(mark.origin_px[1] - rows[third].mean() - 0.5) / mark.px_per_mm


@pytest.mark.parametrize("cell", [(11.0, 0.0), (15.0, 5.0), (20.0, 10.0)])
def test_a_split_opens_toward_the_tip_and_a_bent_tip_lies_off_the_axis(brush: Brush, cell: tuple[float, float]):
    sound, split, bent = (flawed(brush, flaw, cell=cell) for flaw in (None, Flaw.SPLIT, Flaw.BENT))
    assert gap_mm(sound) < 0.3
    assert gap_mm(split) > 1.0
    assert aside_mm(sound) < 0.5
    assert aside_mm(bent) > 1.0


@pytest.mark.parametrize("flaw", list(Flaw))
def test_a_flaw_is_the_same_for_the_same_seed_and_severity_0_is_none(brush: Brush, flaw: Flaw):
    again = Brush(BrushSpec())
    assert flawed(brush, flaw, 0.7).density.tobytes() == flawed(again, flaw, 0.7).density.tobytes()
    assert flawed(brush, flaw, 0.0).density.tobytes() == flawed(brush, None).density.tobytes()
    if flaw is not Flaw.BLANK:
        assert flawed(brush, flaw, 0.7, seed=2).density.tobytes() != flawed(brush, flaw, 0.7).density.tobytes()


def test_an_emptying_brush_leaves_faint_then_dry_then_blank_marks():
    named = [flaw_of_load(load) for load in [*(1.0 - 0.12 * n for n in range(9)), 0.0]]
    assert [flaw for flaw, _ in itertools.groupby(named)] == [None, Flaw.FAINT, Flaw.DRY, Flaw.BLANK]


def test_a_brush_splits_by_itself_the_more_often_the_emptier_it_is():
    def chance(load: float, depth_mm: float = 15.0) -> float:
        return float(np.mean([natural_split(load, depth_mm, np.random.default_rng(n)) > 0.0 for n in range(400)]))

    assert chance(1.0) == chance(COHESIVE_LOAD) == 0.0
    assert 0.0 < chance(0.64) < chance(0.4) < chance(0.16)
    assert chance(0.1, depth_mm=1.0) == 0.0
    assert chance(0.0) == 0.0, "nothing shows"


def written(folder: Path, text: str) -> Path:
    path = folder / "brush.toml"
    path.write_text(text)
    return path


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
