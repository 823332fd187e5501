"""The simulated brush: its marks and forces, its drags and its flaws."""

from __future__ import annotations

import itertools
import subprocess
import sys

import cv2
import numpy as np
import pytest

from brushloop.drivers.sim.brush.brush import Brush, BrushSpec, Flaw, Waypoint
from brushloop.drivers.sim.brush.footprint import COHESIVE_LOAD, flaw_of_load, natural_split
from brushloop.drivers.sim.brush.paper import Footprint

DEPTHS_MM = (5.0, 11.0, 13.0, 15.0, 17.0, 20.0)
TILTS_DEG = (0.0, 5.0, 10.0)


@pytest.fixture(scope="module")
def brush() -> Brush:
    return Brush(BrushSpec())


def wet(brush: Brush, depth_mm: float, tilt_deg: float, press_seed: int = 1) -> Footprint:
    return brush.press(depth_mm, tilt_deg, ink_load=1.0, press_seed=press_seed)


def extent_mm(mark: Footprint) -> tuple[float, float]:
    """Length along x and width along y of the ink."""
    rows, columns = np.nonzero(mark.density > 0.3)
    return (np.ptp(columns) + 1) / mark.px_per_mm, (np.ptp(rows) + 1) / mark.px_per_mm


@pytest.mark.parametrize("tilt_deg", TILTS_DEG)
def test_mark_and_force_grow_with_depth(brush, tilt_deg):
    marks = [wet(brush, depth, tilt_deg) for depth in DEPTHS_MM]
    lengths, widths = zip(*(extent_mm(m) for m in marks), strict=True)
    forces = [float(brush.push_n(depth, tilt_deg)[-1]) for depth in DEPTHS_MM]
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


def test_a_dry_brush_leaves_less_ink_and_streaks(brush):
    loads = (1.0, 0.7, 0.4, 0.2, 0.0)
    marks = {load: brush.press(17, 5, ink_load=load, press_seed=3) for load in loads}
    ink = [float(marks[load].density.sum()) for load in loads]
    assert all(a > b for a, b in itertools.pairwise(ink)), ink
    assert not marks[0.0].density.any()

    def gaps(mark: Footprint) -> float:
        """Share of paper left bare between the outermost ink of each column."""
        inked = mark.density > 0.3
        inside = np.maximum.accumulate(inked, axis=0) & np.maximum.accumulate(inked[::-1], axis=0)[::-1]
        return 1.0 - inked.sum() / inside.sum()

    assert gaps(marks[1.0]) < 0.01
    assert gaps(marks[0.2]) > 0.1


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"depth_mm": 45.0}, r"depth_mm = 45 is outside -inf \.\. 43\.2"),
        ({"depth_mm": 43.0, "tilt_deg": 10.0}, r"depth_mm = 43 is outside -inf \.\. 42\.5"),
        ({"depth_mm": float("nan")}, "depth_mm = nan is outside"),
        ({"tilt_deg": -1.0}, r"tilt_deg = -1 is outside 0 \.\. 30"),
        ({"ink_load": 1.2}, r"ink_load = 1\.2 is outside 0 \.\. 1"),
        ({"press_seed": -1}, "press_seed = -1 is outside"),
        ({"px_per_mm": 0.0}, r"px_per_mm = 0 is outside 2 \.\. 40"),
    ],
)
def test_a_press_out_of_range_is_refused_with_the_range(brush, change, message):
    press = {"depth_mm": 15.0, "tilt_deg": 0.0, "ink_load": 1.0, "press_seed": 1} | change
    with pytest.raises(ValueError, match=message):
        brush.press(**press)


def test_an_impossible_brush_is_refused():
    with pytest.raises(ValueError, match=r"length_mm = 10 is outside 18 \.\. 120"):
        BrushSpec(length_mm=10.0)


def test_the_brush_knows_neither_model_nor_torch():
    unwanted = {"brushloop.model", "torch", "brushloop.collect"}
    probe = f"import sys, brushloop.drivers.sim.world; print(sorted({unwanted} & set(sys.modules)))"
    done = subprocess.run([sys.executable, "-c", probe], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def down_along_up(corners: list[tuple[float, float]], depth_mm: float) -> list[Waypoint]:
    """Straight down, along the corners at one depth, straight up."""
    points = [Waypoint(x, y, depth_mm) for x, y in corners]
    return [Waypoint(*corners[0], 0.0), *points, Waypoint(*corners[-1], 0.0)]


def ramp(depth_mm: float, length_mm: float = 50.0) -> list[Waypoint]:
    """Comes down and lifts on the way."""
    x = (0.0, 0.2 * length_mm, 0.8 * length_mm, length_mm)
    return [Waypoint(a, 0.0, d) for a, d in zip(x, (0.0, depth_mm, depth_mm, 0.0), strict=True)]


def draw(
    brush: Brush, path: list[Waypoint], heading_deg: float = 0.0, ink_load: float = 1.0, seed: int = 1
) -> Footprint:
    return brush.drag(path, 0.0, heading_deg, ink_load=ink_load, press_seed=seed)


def ink_mm(mark: Footprint) -> tuple[np.ndarray, np.ndarray]:
    """x and y of the inked pixels relative to the first waypoint."""
    rows, columns = np.nonzero(mark.density > 0.3)
    return (columns + 0.5 - mark.origin_px[0]) / mark.px_per_mm, (mark.origin_px[1] - rows - 0.5) / mark.px_per_mm


def test_the_ink_trails_behind_the_tip_by_a_leash_that_grows_with_depth(brush: Brush):
    short = []
    for depth_mm in (3.0, 6.0, 9.0):
        path = down_along_up([(0.0, 0.0), (40.0, 0.0)], depth_mm)[:-1]  # still down: no lifting to close the gap
        short.append(40.0 - float(ink_mm(draw(brush, path))[0].max()))
    assert all(b > a + 0.5 for a, b in itertools.pairwise(short)), short
    assert 0.5 < short[0] < short[-1] < 9.0


def test_the_ink_cuts_a_corner_and_cuts_it_more_when_deep(brush: Brush):
    cut = []
    for depth_mm in (3.0, 8.0, 14.0):
        x, y = ink_mm(draw(brush, down_along_up([(0.0, 0.0), (40.0, 0.0), (40.0, -40.0)], depth_mm)))
        cut.append(float(np.hypot(x - 40.0, y).min()))
    assert all(b > a + 0.3 for a, b in itertools.pairwise(cut)), cut
    assert cut[0] > 0.2


def test_no_depth_no_ink(brush: Brush):
    for depth_mm in (0.0, -2.0):
        assert not draw(brush, down_along_up([(0.0, 0.0), (40.0, 0.0)], depth_mm)).density.any()


def test_a_drag_out_of_range_is_refused_with_the_range(brush: Brush):
    with pytest.raises(ValueError, match=r"depth_mm = 45 is outside -inf \.\. 43\.2"):
        draw(brush, ramp(45.0))
    with pytest.raises(ValueError, match="at least one waypoint"):
        draw(brush, [])


SEVERITIES = (0.0, 0.25, 0.5, 0.75, 1.0)
CELLS = [(11.0, 0.0), (15.0, 5.0), (20.0, 10.0)]
SEEDS = range(4)


def flawed(brush: Brush, flaw: Flaw | None, severity: float = 1.0, *, cell=(15.0, 5.0), seed: int = 1) -> Footprint:
    return brush.press(*cell, ink_load=1.0, press_seed=seed, flaw=flaw, severity=severity)


def inked(mark: Footprint) -> np.ndarray:
    return mark.density > 0.3


def gap_mm(mark: Footprint) -> float:
    """Widest run of bare paper between ink of one column, in the half of the mark toward the tip."""
    ink = inked(mark)
    columns = np.flatnonzero(ink.any(axis=0))
    widest = 0
    for column in columns[: columns.size // 2]:
        rows = np.flatnonzero(ink[:, column])
        widest = max(widest, int(np.diff(rows).max(initial=1)) - 1)
    return widest / mark.px_per_mm


def aside_mm(mark: Footprint) -> float:
    """Distance of the tip third's centroid from the axis of the brush."""
    rows, columns = np.nonzero(inked(mark))
    third = columns < columns.min() + np.ptp(columns) / 3
    return abs(mark.origin_px[1] - rows[third].mean() - 0.5) / mark.px_per_mm


def cover(mark: Footprint, sound: Footprint) -> float:
    """Share of the outline of a sound press of the same seed that carries ink; frames differ, origins do not."""
    placed = np.zeros(sound.density.shape, bool)
    dx, dy = (int(a - b) for a, b in zip(sound.origin_px, mark.origin_px, strict=True))
    rows, columns = np.nonzero(inked(mark))
    rows, columns = rows + dy, columns + dx
    kept = (rows >= 0) & (columns >= 0) & (rows < placed.shape[0]) & (columns < placed.shape[1])
    placed[rows[kept], columns[kept]] = True
    outline = inked(sound)
    return (placed & outline).sum() / outline.sum()


def grows(series: list[float], least: float = 0.0) -> bool:
    return all(b - a >= least for a, b in itertools.pairwise(series))


@pytest.mark.parametrize("cell", CELLS)
@pytest.mark.parametrize("seed", SEEDS)
def test_a_split_opens_toward_the_tip(brush: Brush, cell, seed: int):
    assert gap_mm(flawed(brush, None, cell=cell, seed=seed)) < 0.3
    mark = flawed(brush, Flaw.SPLIT, cell=cell, seed=seed)
    assert gap_mm(mark) > 1.0
    ink = inked(mark).astype(np.uint8)
    columns = np.flatnonzero(ink.any(axis=0))
    prongs, _ = cv2.connectedComponents(np.ascontiguousarray(ink[:, : columns[0] + columns.size // 4]))
    whole, _ = cv2.connectedComponents(ink)
    assert (prongs - 1, whole - 1) == (2, 1), "two tips, one heel"


@pytest.mark.parametrize("cell", CELLS)
@pytest.mark.parametrize("seed", SEEDS)
def test_a_bent_tip_lies_off_the_axis(brush: Brush, cell, seed: int):
    assert aside_mm(flawed(brush, None, cell=cell, seed=seed)) < 0.5
    assert aside_mm(flawed(brush, Flaw.BENT, cell=cell, seed=seed)) > 1.0


@pytest.mark.parametrize("cell", CELLS)
@pytest.mark.parametrize("seed", SEEDS)
def test_a_dry_brush_inks_less_than_its_outline(brush: Brush, cell, seed: int):
    assert cover(flawed(brush, Flaw.DRY, cell=cell, seed=seed), flawed(brush, None, cell=cell, seed=seed)) < 0.6


def test_a_faint_mark_keeps_its_outline_and_loses_its_tone(brush: Brush):
    marks = [flawed(brush, Flaw.FAINT, s) for s in SEVERITIES]
    assert grows([-float(m.density.max()) for m in marks], 0.1)
    areas = [np.count_nonzero(m.density > 0.5 * m.density.max()) for m in marks]
    assert areas == pytest.approx([areas[0]] * len(areas), rel=0.01)
    assert marks[-1].density.max() < 0.3


@pytest.mark.parametrize("flaw", list(Flaw))
def test_a_flaw_is_the_same_for_the_same_seed_and_severity_0_is_none(brush: Brush, flaw: Flaw):
    again = Brush(BrushSpec())
    assert flawed(brush, flaw, 0.7).density.tobytes() == flawed(again, flaw, 0.7).density.tobytes()
    assert flawed(brush, flaw, 0.0).density.tobytes() == flawed(brush, None).density.tobytes()
    if flaw is not Flaw.BLANK:
        assert flawed(brush, flaw, 0.7, seed=2).density.tobytes() != flawed(brush, flaw, 0.7).density.tobytes()


def test_a_severity_out_of_range_is_refused(brush: Brush):
    with pytest.raises(ValueError, match=r"severity = 1\.5 is outside 0 \.\. 1"):
        flawed(brush, Flaw.SPLIT, 1.5)


def test_an_emptying_brush_leaves_faint_then_dry_then_blank_marks(brush: Brush):
    loads = [1.0 - 0.12 * n for n in range(9)]
    named = [flaw_of_load(load) for load in [*loads, 0.0]]
    assert [flaw for flaw, _ in itertools.groupby(named)] == [None, Flaw.FAINT, Flaw.DRY, Flaw.BLANK]

    def seen(load: float) -> tuple[float, float]:
        """(tone, share of the outline inked), as a share of the fresh brush's."""
        mark, fresh = (brush.press(15, 5, ink_load=v, press_seed=1) for v in (load, 1.0))
        tone = np.median(mark.density[inked(mark)]) / np.median(fresh.density[inked(fresh)])
        return float(tone), cover(mark, fresh)

    for load, flaw in zip(loads, named, strict=False):
        tone, share = seen(load)
        assert (tone < 0.75) == (flaw is not None), (load, tone)
        assert (share < 0.7) == (flaw is Flaw.DRY), (load, share)


def test_a_brush_splits_by_itself_the_more_often_the_emptier_it_is():
    def chance(load: float, depth_mm: float = 15.0) -> float:
        return float(np.mean([natural_split(load, depth_mm, np.random.default_rng(n)) > 0.0 for n in range(400)]))

    assert chance(1.0) == chance(COHESIVE_LOAD) == 0.0
    assert grows([chance(load) for load in (0.64, 0.4, 0.16)], 0.05)
    assert chance(0.1, depth_mm=1.0) == 0.0
    assert chance(0.0) == 0.0, "nothing shows"
