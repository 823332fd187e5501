"""Trajectories within reach, stamps and their slopes; plans that lead the brush by its footprint; and the lag."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from brushloop.model.ccdbsm import Brush
from brushloop.model.characters.plan import (
    Phase,
    Reach,
    StrokePath,
    covered,
    drawn,
    first_lead,
    grid,
    lead,
    phases_of,
    resampled,
)
from brushloop.model.characters.presses import Stamps, depth_of
from brushloop.model.drag import NAMES, START, DragModel, Drawings, Footprint, fit_each, inked, lagging, marks, sampled
from brushloop.model.raster import coverage
from brushloop.model.strokes import stroke_model

MODEL = stroke_model("ccd-bsm", Brush())
REACH = Reach()


def test_depth_is_the_inverse_of_width() -> None:
    half = np.array([1.0, 2.0, 4.0])
    depth = depth_of(MODEL, REACH, 5.0, half)
    widths = MODEL.profile(depth, 5.0).width_mm
    assert np.allclose(widths, 2 * half, rtol=1e-3)
    assert depth_of(MODEL, REACH, 5.0, np.array([0.0, 50.0])).tolist() == [0.5, 20.0]


@settings(max_examples=60, deadline=None)
@given(arrays(np.float64, (8, 5), elements=st.floats(-400, 400)))
def test_whatever_comes_is_made_feasible(points: np.ndarray) -> None:
    made = REACH.within(points, 60.0)
    steps = np.linalg.norm(np.diff(made[:, :2], axis=0), axis=1)
    assert np.all(made[:, 2] >= REACH.depth_mm[0] - 1e-9)
    assert np.all(made[:, 2] <= REACH.depth_mm[1] + 1e-9)
    assert np.all((made[:, 3] >= REACH.tilt_deg[0]) & (made[:, 3] <= REACH.tilt_deg[1]))
    assert np.all(np.abs(np.diff(made[:, 2])) <= REACH.plunge * steps + 1e-9)
    assert np.all(np.abs(np.diff(made[:, 4])) <= REACH.turn_deg_mm * steps + 1e-6)
    assert np.all(np.abs(made[:, 4]) <= REACH.wrist_deg + 1e-9)
    assert np.all((made[:, :2] >= 0) & (made[:, :2] <= 60))
    assert np.allclose(REACH.within(made, 60.0), made)


@settings(max_examples=60, deadline=None)
@given(arrays(np.float64, (12, 5), elements=st.floats(0, 5)))
def test_neighbouring_points_lie_apart_and_the_last_stays(points: np.ndarray) -> None:
    kept = REACH.spaced(points)
    assert np.array_equal(kept[0], points[0])
    if len(kept) > 2:
        assert np.linalg.norm(np.diff(kept[:, :3], axis=0), axis=1).min() >= 1.0
    if len(kept) > 1:
        assert np.array_equal(kept[-1], points[-1])


def test_one_stamp_is_the_press_at_its_anchor() -> None:
    ahead, turn = 12.0 * np.tan(np.radians(8.0)), np.radians(40.0)
    origin = (30.0 + ahead * np.cos(turn), 60.0 - 25.0 - ahead * np.sin(turn))
    alone = coverage(MODEL.profile(12.0, 8.0), origin, 40.0, size_px=128, px_mm=60 / 128)[0]
    assert Stamps(MODEL, np.array([[30.0, 25.0, 12.0, 8.0, 40.0]]), 60.0).image == pytest.approx(alone, abs=1e-6)


def test_marks_that_overlap_are_counted_once_and_those_outside_cut() -> None:
    points = np.array([[30.0, 30.0, 8.0, 0.0, 0.0], [30.0, 30.0, 8.0, 0.0, 0.0], [59.0, 1.0, 8.0, 0.0, -45.0]])
    image, once = (Stamps(MODEL, part, 60.0).image for part in (points, points[:1]))
    assert image.max() == pytest.approx(1.0)
    assert image.sum() > once.sum()
    assert image[:, :40] == pytest.approx(once[:, :40], abs=1e-6)


def test_the_slopes_of_an_image_are_those_of_every_number_of_a_press() -> None:
    points = np.array([[20.3, 31.1, 7.0, 4.0, 30.0], [26.2, 33.4, 9.0, 0.0, 10.0]])
    weights = np.random.default_rng(0).random((64, 64))
    slopes = Stamps(MODEL, points, 60.0, 64).slopes(weights)
    for press, number in np.ndindex(2, 5):
        step = np.zeros((2, 5))
        step[press, number] = 0.01  # forward only: no press leans backwards
        before, after = ((Stamps(MODEL, points + by, 60.0, 64).image * weights).sum() for by in (0.0, step))
        assert slopes[press, number] == pytest.approx((after - before) / 0.01, rel=0.05, abs=0.05)


# The tip runs ahead, and the ink lands where it is wanted

SIDE_MM, SIZE_PX = 48.0, 96
HOOK = np.array([[12.0, 36.0], [20.0, 36.0], [28.0, 36.0], [34.0, 34.0], [34.0, 26.0], [33.0, 18.0], [30.0, 21.0]])


def brush_of(**changed: float) -> Footprint:
    return Footprint(tuple({**dict(zip(NAMES, START, strict=True)), **changed}.values()))


def hook() -> StrokePath:
    points = resampled(HOOK, 2.0)
    half = np.full(len(points), 2.0)
    half[-2:] = 1.0, 0.3
    return StrokePath(points, half)


def test_leading_the_brush_puts_the_ink_on_the_corner() -> None:
    path, brush, reach = hook(), Footprint(), Reach()
    x, y = (each[..., None] for each in np.meshgrid(*grid(SIDE_MM, SIZE_PX)))
    along = np.linspace(0.0, len(path.points) - 1.0, 200)
    discs = (np.interp(along, np.arange(len(path.points)), each) for each in (*path.points.T, path.half_width_mm))
    wanted = np.any(np.hypot(x - next(discs), y - next(discs)) < next(discs), axis=-1).astype(np.float32)

    def wrong(strokes: list[np.ndarray]) -> int:
        seen = covered(drawn([brush] * len(strokes), strokes, SIDE_MM, SIZE_PX), SIDE_MM)
        return np.count_nonzero((seen > 0.5) != (wanted > 0.5))

    first = first_lead([path], brush, reach, SIDE_MM, 5.0)
    led = lead([brush], first, wanted, SIDE_MM, reach)
    assert wrong(led) < 0.5 * wrong(first)
    assert led[0][:, 0].max() > HOOK[:, 0].max() + 0.5  # the tip goes on beyond the corner
    assert np.all(np.linalg.norm(np.diff(led[0][:, :3], axis=0), axis=1) >= reach.apart_mm)
    assert led[0][:, 2].max() <= reach.depth_mm[1]


def test_pressing_deeper_on_the_spot_marks_like_landing_as_deep() -> None:
    lands = np.array([[24.0, 24.0, 8.0, 30.0], [24.01, 24.0, 8.0, 30.0]])
    deepens = np.array([[24.0, 24.0, 2.0, 30.0], [24.01, 24.0, 8.0, 30.0]])
    ink, slid = (inked([Footprint()], [path], *grid(SIDE_MM, 64)) for path in (lands, deepens))
    deep = ink > 0.3
    assert deep.sum() > 30
    assert np.all(slid[deep] > 0.0)
    nodes = sampled(lands)
    middle_disc = marks([nodes], np.array(START)).discs[1::3]
    behind = np.hypot(*(middle_disc[:, :2] - (24.0, 24.0)).T)
    assert behind[nodes[:, 2] == 8.0][0] == pytest.approx(4.5, abs=0.1)  # it slid there while the brush went down


def test_each_stroke_has_a_footprint_of_its_own() -> None:
    wide, narrow = brush_of(half_mm_2=1.2), brush_of(half_mm_2=0.4)
    x_mm, y_mm = grid(SIDE_MM, 64)
    paths = [np.array([[12.0, y, 5.0, 0.0], [36.0, y, 5.0, 0.0]]) for y in (16.0, 32.0)]
    ink = (inked([wide, narrow], paths, x_mm, y_mm) > 0.0).astype(np.float32)[None]
    upper, lower = fit_each(Drawings(paths, np.array([0, 2]), ink, x_mm, y_mm), Footprint())
    depth = np.array([5.0])
    assert upper.half_width_mm(depth) > lower.half_width_mm(depth) + 0.4
    assert np.count_nonzero((inked([upper, lower], paths, x_mm, y_mm) > 0.0) != (ink[0] > 0.5)) < 40
    with pytest.raises(ValueError, match="a footprint has 28 finite values, got 2"):
        Footprint((1.0, 2.0))


def test_a_path_is_sampled_densely_from_its_landing_to_its_lift() -> None:
    path = np.array([[0.0, 0.0, 1.0, 0.0], [3.0, 0.0, 1.0, 0.0], [3.0, 4.0, 2.0, 90.0]])
    dense = sampled(path)
    assert np.linalg.norm(np.diff(dense[:, :3], axis=0), axis=1).max() <= 0.5
    assert all((dense == corner).all(axis=1).any() for corner in path)
    assert dense[0].tolist() == [0.0, 0.0, 0.0, 0.0]
    assert dense[-1].tolist() == [3.0, 4.0, 0.0, 90.0]


def test_a_brush_that_lifts_marks_ahead_of_where_it_was_dragged_to() -> None:
    path = np.array([[14.0, 24.0, 8.0, 0.0], [34.0, 24.0, 8.0, 0.0]])
    dragged, lifted = (marks([nodes], np.array(START)).discs for nodes in (path, sampled(path)))
    assert dragged[-2, 0] == pytest.approx(34.0 - float(Footprint().lag_mm(np.array([8.0]))[0]))
    assert lifted[-2, 0] == pytest.approx(34.0 - float(Footprint().lag_mm(np.array([0.0]))[0]))


def test_a_stroke_is_divided_into_phases() -> None:
    phases = phases_of(hook())
    assert phases[0] is Phase.INITIATION_HIDDEN
    assert phases[-1] is Phase.TERMINATION_EXPOSED
    corner = int(np.argmin(np.linalg.norm(hook().points - (34.0, 34.0), axis=1)))
    assert phases[corner] is Phase.TURNING
    assert Phase.EXECUTION in phases
    back = StrokePath(np.array([[x, 0.0] for x in range(10)] + [[8.0 - x, 1.0] for x in range(8)]), np.full(18, 1.0))
    assert Phase.FOLDING in phases_of(back)


# A brush drawn along the paper: the lag has closed forms on a straight line and on a corner

STIFF = DragModel(half_mm=2.0, half_per_mm=0.0, leash_mm=0.0, leash_per_mm=0.0, settle_mm=0.0, front=0.0)
X_MM, Y_MM = np.linspace(-10.0, 50.0, 121), np.linspace(-20.0, 20.0, 81)


def away(model: DragModel, path: np.ndarray, x_mm: np.ndarray, y_mm: np.ndarray) -> np.ndarray:
    """Signed distance in mm to the edge of one path's mark."""
    return lagging([path], model.vector()).distances(x_mm, y_mm)[0]


def line(length_mm: float, depth_mm: float = 5.0, nodes: int = 21) -> np.ndarray:
    x = np.linspace(0.0, length_mm, nodes)
    return np.column_stack([x, np.zeros(nodes), np.full(nodes, depth_mm)])


def test_without_a_leash_the_mark_is_discs_along_the_path() -> None:
    seen = away(STIFF, line(30.0), X_MM, Y_MM)
    along = np.clip(X_MM, 0.0, 30.0)
    wanted = 2.0 - np.hypot(X_MM[None] - along[None], Y_MM[:, None])
    assert np.abs(seen - wanted).max() < 0.06  # a leash is never shorter than 0.05 mm


@pytest.mark.parametrize("nodes", [2, 9, 200])
def test_the_lag_is_that_of_first_order_however_the_path_is_cut(nodes: int) -> None:
    model = DragModel(leash_mm=4.0, leash_per_mm=0.0, front=0.0)
    trail = lagging([line(20.0, nodes=nodes)], model.vector()).discs
    assert trail[-2, 0] == pytest.approx(20.0 - 4.0 * (1.0 - np.exp(-20.0 / 4.0)), abs=1e-9)


def test_a_corner_is_cut_and_more_so_at_depth() -> None:
    model = DragModel(leash_mm=1.0, leash_per_mm=0.5, half_per_mm=0.0)
    leg = np.linspace(0.0, 25.0, 26)
    cut = []
    for depth in (2.0, 8.0):
        corner = np.concatenate([np.column_stack([leg, 0 * leg]), np.column_stack([0 * leg[1:] + 25.0, -leg[1:]])])
        trail = lagging([np.column_stack([corner, np.full(len(corner), depth)])], model.vector()).discs
        cut.append(np.hypot(trail[:, 0] - 25.0, trail[:, 1]).min())
    assert 0.2 < cut[0] < cut[1]


def test_lifting_below_no_width_leaves_no_ink() -> None:
    model = DragModel(half_mm=-1.0, half_per_mm=0.5, settle_mm=0.05)
    path = line(30.0)
    path[8:13, 2] = 1.0  # half width -0.5 mm in the middle
    middle = away(model, path, np.array([15.0]), Y_MM)
    assert middle.max() < 0.0
    assert away(model, path, np.array([2.0]), np.array([0.0])).item() > 0.0
