import itertools
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from brushloop.drivers.sim.brush.brush import Brush, BrushSpec
from brushloop.drivers.sim.brush.footprint import grow_bristles
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


def centroid_mm(mark: Footprint) -> tuple[float, float]:
    rows, columns = np.nonzero(mark.density > 0.3)
    x, y = mark.origin_px
    return (columns.mean() + 0.5 - x) / mark.px_per_mm, (y - rows.mean() - 0.5) / mark.px_per_mm


def binary(mark: Footprint) -> np.ndarray:
    """The mark at 0.2 mm per pixel on a sheet of 51.2 x 25.6 mm, zero touch at 40 mm from the left."""
    sheet = np.zeros((256, 512), np.float32)
    x, y = int(400 - mark.origin_px[0]), int(128 - mark.origin_px[1])
    h, w = mark.density.shape
    sheet[y : y + h, x : x + w] = mark.density
    return sheet.reshape(128, 2, 256, 2).mean(axis=(1, 3)) > 0.5


def csim(a: np.ndarray, b: np.ndarray) -> float:
    return float((a & b).sum() / np.sqrt(float(a.sum()) * float(b.sum())))


def test_equal_presses_are_equal_bytes(brush):
    again = Brush(BrushSpec())
    assert wet(brush, 15, 5, 7).density.tobytes() == wet(again, 15, 5, 7).density.tobytes()


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


@pytest.mark.parametrize(("depth_mm", "tilt_deg"), [(11, 0), (15, 5), (20, 10)])
def test_repeats_are_alike_but_not_identical(brush, depth_mm, tilt_deg):
    marks = [binary(wet(brush, depth_mm, tilt_deg, seed)) for seed in range(6)]
    scores = [csim(a, b) for a, b in itertools.combinations(marks, 2)]
    assert 0.94 < min(scores) <= max(scores) < 0.999
    assert 0.95 < np.mean(scores) < 0.99


def test_the_place_of_a_press_wanders_and_its_mark_stays_as_it_is(brush):
    elsewhere = Brush(BrushSpec(place_wander_mm=1.0))
    here, there = (
        np.array([centroid_mm(wet(one, 11.0, 5.0, seed)) for seed in range(8)]) for one in (brush, elsewhere)
    )
    assert (there - here).std(axis=0, ddof=1) == pytest.approx([1.0, 1.0], rel=0.6)
    assert extent_mm(wet(elsewhere, 11.0, 5.0, 3)) == pytest.approx(extent_mm(wet(brush, 11.0, 5.0, 3)), abs=0.4)


def test_two_brushes_of_one_make_differ_more_than_repeats(brush):
    assert (
        grow_bristles(BrushSpec(), np.random.default_rng(1)).clump
        != grow_bristles(BrushSpec(), np.random.default_rng(2)).clump
    ).any()
    other = Brush(replace(brush.spec, seed=2))
    assert wet(brush, 15, 5).density.tobytes() != wet(other, 15, 5).density.tobytes()


def test_without_a_trail_a_press_leaves_ink_only_where_its_hairs_come_to_rest(brush):
    still = wet(Brush(replace(brush.spec, trail_share=0.0)), 17, 0)
    slid = wet(brush, 17, 0)
    assert extent_mm(still)[0] < extent_mm(slid)[0] - 3.0  # the tip touched beside the place where the heel rests
    assert np.all(still.density <= slid.density + 1e-6)


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


@pytest.mark.parametrize("tilt_deg", TILTS_DEG)
def test_mark_lies_on_the_side_of_the_tip(brush, tilt_deg):
    mark = wet(brush, 15, tilt_deg)
    x, y = centroid_mm(mark)
    assert -15 < x < -5
    assert abs(y) < 1


def test_a_tip_that_sticks_throws_the_mark_to_the_other_side():
    sticky = Brush(BrushSpec(friction=0.6))
    assert centroid_mm(wet(sticky, 11, 0))[0] > 0


def test_heel_of_a_tilted_press_is_broader_than_its_tip(brush):
    mark = wet(brush, 20, 10)
    columns = np.flatnonzero((mark.density > 0.3).any(axis=0))
    fifth = len(columns) // 5
    width = (mark.density > 0.3).sum(axis=0)
    assert width[columns[-fifth:]].mean() > 1.5 * width[columns[:fifth]].mean()


@settings(max_examples=25, deadline=None)
@given(
    depth_mm=st.floats(0.1, 30),
    tilt_deg=st.floats(0, 30),
    ink_load=st.floats(0, 1),
    press_seed=st.integers(0, 2**32),
    px_per_mm=st.sampled_from([2.0, 5.0, 10.0]),
)
def test_raster_holds_the_whole_mark(brush, depth_mm, tilt_deg, ink_load, press_seed, px_per_mm):
    mark = brush.press(depth_mm, tilt_deg, ink_load=ink_load, press_seed=press_seed, px_per_mm=px_per_mm)
    d = mark.density
    assert d.dtype == np.float32
    assert np.isfinite(d).all()
    assert 0 <= d.min() <= d.max() <= 1
    border = np.concatenate([d[0], d[-1], d[:, 0], d[:, -1]])
    assert not border.any()
    x, y = mark.origin_px
    assert 0 <= x <= d.shape[1]
    assert 0 <= y <= d.shape[0]


def test_raster_scale_does_not_change_the_ink(brush):
    areas = []
    for px_per_mm in (5.0, 10.0, 20.0):
        mark = brush.press(15, 5, ink_load=1.0, press_seed=1, px_per_mm=px_per_mm)
        areas.append(float(mark.density.sum()) / px_per_mm**2)
    assert areas == pytest.approx([areas[1]] * 3, rel=0.02)


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
