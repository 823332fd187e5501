"""Trajectories stay within what brush and arm can do, and refinement brings their image to the wanted one."""

from __future__ import annotations

from importlib.resources import files

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from brushloop.model.ccdbsm import Brush
from brushloop.model.characters.glyph import parse_glyph, paths_of, reference
from brushloop.model.characters.plan import Patch, Reach
from brushloop.model.characters.presses import Stamps, depth_of, refine, trajectory, written
from brushloop.model.raster import coverage
from brushloop.model.strokes import stroke_model

MODEL = stroke_model("ccd-bsm", Brush())
PATCH = Patch(60.0)
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
    widths = MODEL.profile(depth, 5.0).width_mm
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


def test_refinement_brings_a_character_to_its_image_within_reach() -> None:
    text = (files("brushloop.model.characters") / "data" / "子.json").read_text("utf-8")
    glyph = parse_glyph(text)
    wanted = reference(glyph, PATCH, 64)
    first = [trajectory(path, MODEL, REACH, PATCH, 5.0) for path in paths_of(glyph, PATCH, 2.5)]
    better = refine(MODEL, first, wanted, PATCH.side_mm, REACH, 25)
    before, after = (np.square(written(MODEL, one, PATCH.side_mm, 64) - wanted).mean() for one in (first, better))
    assert after < 0.15 * before
    for points in (*first, *better):
        assert_feasible(points, REACH)
