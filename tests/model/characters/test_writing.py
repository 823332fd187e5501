"""Trajectories stay within what brush and arm can do, and refinement brings their image to the wanted one."""

from __future__ import annotations

from importlib.resources import files

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from brushloop.model.ccdbsm import Brush
from brushloop.model.characters.glyph import parse_glyph, paths_of, reference
from brushloop.model.characters.plan import Patch, Reach
from brushloop.model.characters.presses import depth_of, refine, stamped, trajectory, written
from brushloop.model.raster.exact import coverage_at
from brushloop.model.strokes import stroke_model

MODEL = stroke_model("ccd-bsm", Brush())
CELL = Patch(60.0)
REACH = Reach()


def apart(points: np.ndarray) -> np.ndarray:
    return np.linalg.norm(np.diff(points[:, :2], axis=0), axis=1)


def assert_feasible(points: np.ndarray, reach: Reach) -> None:
    steps = apart(points)
    assert np.all(points[:, 2] >= reach.depth_mm[0] - 1e-9)
    assert np.all(points[:, 2] <= reach.depth_mm[1] + 1e-9)
    assert np.all((points[:, 3] >= reach.tilt_deg[0]) & (points[:, 3] <= reach.tilt_deg[1]))
    assert np.all(np.abs(np.diff(points[:, 2])) <= reach.plunge * steps + 1e-9)
    assert np.all(np.abs(np.diff(points[:, 4])) <= reach.turn_deg_mm * steps + 1e-6)
    assert np.all(np.abs(points[:, 4]) <= reach.wrist_deg + 1e-9)


def test_depth_is_the_inverse_of_width() -> None:
    half = np.array([1.0, 2.0, 4.0])
    depth = depth_of(MODEL, REACH, 5.0, half)
    widths = MODEL.profile(torch.from_numpy(depth), 5.0).width_mm.numpy()
    assert np.allclose(widths, 2 * half, rtol=1e-3)
    assert depth_of(MODEL, REACH, 5.0, np.array([0.0, 50.0])).tolist() == [0.5, 20.0]


@settings(max_examples=60, deadline=None)
@given(arrays(np.float64, (8, 5), elements=st.floats(-400, 400)))
def test_whatever_comes_is_made_feasible(points: np.ndarray) -> None:
    made = REACH.within(points, 60.0)
    assert_feasible(made, REACH)
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
    point = torch.tensor([[30.0, 25.0, 12.0, 8.0, 40.0]]).double()
    ahead = 12.0 * np.tan(np.radians(8.0))
    turn = np.radians(40.0)
    origin = (30.0 + ahead * np.cos(turn), 60.0 - 25.0 - ahead * np.sin(turn))
    alone = coverage_at(MODEL.profile(12.0, 8.0), origin, 40.0, size_px=128, px_mm=60 / 128)[0]
    assert torch.allclose(stamped(MODEL, point, 60.0), alone, atol=1e-9)


def test_marks_that_overlap_are_counted_once_and_those_outside_cut() -> None:
    points = torch.tensor([[30.0, 30.0, 8.0, 0.0, 0.0], [30.0, 30.0, 8.0, 0.0, 0.0], [59.0, 1.0, 8.0, 0.0, -45.0]])
    image = stamped(MODEL, points.double(), 60.0)
    assert float(image.max()) == pytest.approx(1.0)
    once = stamped(MODEL, points[:1].double(), 60.0)
    assert float(image.sum()) > float(once.sum())
    assert torch.allclose(image[:, :40], once[:, :40])


def test_an_image_is_differentiable_in_every_number_of_a_point() -> None:
    points = torch.tensor([[20.3, 31.1, 7.0, 4.0, 30.0], [26.2, 33.4, 9.0, 6.0, 10.0]]).double().requires_grad_()
    weight = torch.rand(64, 64, generator=torch.Generator().manual_seed(0)).double()
    (slope,) = torch.autograd.grad((stamped(MODEL, points, 60.0, 64) * weight).sum(), points)
    for at in [(0, k) for k in range(5)] + [(1, 2)]:
        step = torch.zeros(2, 5).double()
        step[at] = 1e-5
        with torch.no_grad():
            both = [float((stamped(MODEL, points + s * step, 60.0, 64) * weight).sum()) for s in (1, -1)]
        assert float(slope[at]) == pytest.approx((both[0] - both[1]) / 2e-5, rel=1e-3, abs=1e-4)


def test_refinement_brings_a_character_to_its_image_within_reach() -> None:
    text = (files("brushloop.model.characters") / "data" / "子.json").read_text("utf-8")
    glyph = parse_glyph(text)
    wanted = reference(glyph, CELL, 64)
    first = [trajectory(path, MODEL, REACH, CELL, 5.0) for path in paths_of(glyph, CELL, 2.5)]
    better = refine(MODEL, first, wanted, CELL.side_mm, REACH, 25)
    before, after = (np.square(written(MODEL, one, CELL.side_mm, 64) - wanted).mean() for one in (first, better))
    assert after < 0.15 * before
    for points in (*first, *better):
        assert_feasible(points, REACH)


@pytest.mark.parametrize("options", [{"depth_mm": (3.0, 3.0)}, {"tilt_deg": (-1.0, 5.0)}])
def test_a_reach_that_makes_no_sense_is_refused(options: dict[str, object]) -> None:
    with pytest.raises(ValueError, match="expected"):
        Reach(**options)
