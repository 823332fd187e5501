from __future__ import annotations

import math

import numpy as np
import pytest

from brushloop.drivers.sim.brush.paper import PX_PER_MM, Footprint, Paper

REACH_MM = (6.0, 2.0)
"""Where the middle of the test mark lies in the footprint's own frame."""


def mark(px_per_mm: float = 10.0) -> Footprint:
    """A small disc of ink off the zero-touch point, so that a wrong turn or flip moves it."""
    height, width = round(20 * px_per_mm), round(30 * px_per_mm)
    origin = (10.0 * px_per_mm, 12.0 * px_per_mm)
    x = (np.arange(width) + 0.5 - origin[0]) / px_per_mm
    y = (origin[1] - np.arange(height) - 0.5) / px_per_mm
    inside = (x[None, :] - REACH_MM[0]) ** 2 + (y[:, None] - REACH_MM[1]) ** 2 <= 2.0**2
    return Footprint(inside.astype(np.float32), px_per_mm, origin)


def centroid_mm(paper: Paper) -> tuple[float, float]:
    """In the paper frame, y up."""
    rows, columns = np.indices(paper.density.shape)
    weight = paper.density / paper.density.sum()
    column, row = float((weight * columns).sum()), float((weight * rows).sum())
    return (column + 0.5) / PX_PER_MM, paper.size_y_mm - (row + 0.5) / PX_PER_MM


@pytest.mark.parametrize("heading_deg", [0.0, 33.0, 90.0, 180.0, -90.0])
@pytest.mark.parametrize("px_per_mm", [10.0, 16.0, 5.0])
def test_a_footprint_lands_where_the_brush_touched_turned_to_its_heading(heading_deg: float, px_per_mm: float):
    paper = Paper(80.0, 60.0)
    paper.lay(mark(px_per_mm), 35.0, 25.0, heading_deg)
    cos, sin = math.cos(math.radians(heading_deg)), math.sin(math.radians(heading_deg))
    u, v = REACH_MM
    expected = 35.0 + cos * u - sin * v, 25.0 + sin * u + cos * v
    assert math.dist(centroid_mm(paper), expected) < 0.1


@pytest.mark.parametrize("px_per_mm", [10.0, 16.0, 5.0])
def test_a_footprint_keeps_its_size_on_any_raster(px_per_mm: float):
    paper = Paper(80.0, 60.0)
    paper.lay(mark(px_per_mm), 35.0, 25.0, 33.0)
    assert paper.density.sum() / PX_PER_MM**2 == pytest.approx(math.pi * 2.0**2, rel=0.03)


def test_ink_only_adds_up_and_never_beyond_full():
    paper = Paper(60.0, 40.0)
    half = mark()
    half = Footprint(0.5 * half.density, half.px_per_mm, half.origin_px)
    before = paper.density
    for x_mm in (20.0, 20.0, 22.0):
        paper.lay(half, x_mm, 20.0, 0.0)
        assert (paper.density >= before - 1e-6).all()
        assert paper.density.max() <= 1.0
        before = paper.density
    assert before.max() == pytest.approx(0.875)
    assert paper.presses == 3


def test_a_footprint_over_the_edge_is_cut_off_there():
    paper = Paper(40.0, 30.0)
    paper.lay(mark(), 34.0, 28.0, 0.0)
    assert 0.0 < paper.density.sum() / PX_PER_MM**2 < math.pi * 2.0**2
