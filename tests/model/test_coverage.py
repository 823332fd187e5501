"""Exact coverage at heading 0 is exact: against quadrature, supersampling, symmetries and its own derivatives."""

from collections.abc import Callable
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from brushloop.model.baselines import circle, ellipse, line
from brushloop.model.brush import Brush
from brushloop.model.ccdbsm import CcdBsm, ccdbsm
from brushloop.model.outline import Shape
from brushloop.model.raster.exact import coverage_at
from brushloop.model.raster.frame import PX_MM, SIZE_PX, centred_origin

Array = NDArray[np.floating[Any]]
Curve = Callable[[Array], Array]
SHAPES = {"ccd-bsm": lambda mark: mark, "ellipse": ellipse, "circle": circle, "line": line}
OFF_GRID_MM = (22.117, 12.743)  # an origin on no pixel edge
PRESS = (15.0, 7.0)


def curve_of(name: str, mark: CcdBsm) -> tuple[Curve, list[float]]:
    """The half width of one mark in numpy, written independently from the definitions, and where it is not smooth."""
    a, b, t = mark.o3a_mm.item(), mark.half_width_mm.item(), mark.o4o3_mm.item()
    centre, half = (a - t) / 2, (a + t) / 2
    reach = half - b

    def root(z: Array) -> Array:
        return np.sqrt(np.maximum(z, 0))

    curves: dict[str, tuple[Curve, list[float]]] = {
        "ccd-bsm": (
            lambda x: np.where(x < 0, b * np.maximum(1 - (x / t) ** 2, 0), b * root(1 - (x / a) ** 2)),
            [-t, 0.0, a],
        ),
        "ellipse": (lambda x: b * root(1 - ((x - centre) / half) ** 2), [-t, centre, a]),
        "circle": (lambda x: root(half**2 - (x - centre) ** 2), [-t, centre, a]),
        "line": (
            lambda x: root(b**2 - np.maximum(abs(x - centre) - reach, 0) ** 2),
            [-t, centre - reach, centre, centre + reach, a],
        ),
    }
    return curves[name]


def ink(curve: Curve, x: Array, edges_mm: Array) -> Array:
    """How much of each row of pixels is inked along the vertical line at x: (N,), (V + 1,) -> (V, N)."""
    w = curve(x)
    clipped = np.clip(edges_mm[:, None], -w, w)
    return clipped[:-1] - clipped[1:]


def level_ends(curve: Curve, kinks: list[float], levels: Array) -> tuple[Array, Array]:
    """Where the curve passes each level on both sides of its peak, by bisection; the peak if above."""
    ends = []
    for end in (kinks[0], kinks[-1]):
        outer, inner = np.full_like(levels, end), np.full_like(levels, kinks[len(kinks) // 2])
        for _ in range(60):
            middle = (outer + inner) / 2
            above = curve(middle) >= levels
            outer, inner = np.where(above, outer, middle), np.where(above, middle, inner)
        ends.append(inner)
    return ends[0], ends[1]


def quadrature(curve: Curve, kinks: list[float], origin_mm: tuple[float, float]) -> Array:
    """Coverage by Gauss-Legendre on each smooth piece of each column, independent of the closed forms."""
    x_edges = np.arange(SIZE_PX + 1) * PX_MM - origin_mm[0]
    y_edges = origin_mm[1] - np.arange(SIZE_PX + 1) * PX_MM
    cuts = np.concatenate((kinks, *level_ends(curve, kinks, abs(y_edges))))
    nodes, weights = np.polynomial.legendre.leggauss(16)
    # x = sin(pi u / 2) removes the square-root ends of a piece, for which Gauss-Legendre converges slowly.
    place, weight = np.sin(np.pi * nodes / 2), weights * np.pi / 2 * np.cos(np.pi * nodes / 2)
    image = np.zeros((SIZE_PX, SIZE_PX))
    for j, (start, stop) in enumerate(pairwise(x_edges)):
        pieces = [start, *sorted(x for x in cuts if start < x < stop), stop]
        for low, high in pairwise(pieces):
            middle, half = (low + high) / 2, (high - low) / 2
            image[:, j] += half * ink(curve, middle + half * place, y_edges) @ weight
    return image / PX_MM**2


def one(profile: Shape, origin_mm: tuple[float, float]) -> Array:
    return coverage_at(profile, origin_mm)[0].numpy()


@pytest.mark.parametrize("origin_mm", [OFF_GRID_MM, (22.0, 12.8), (9.3, 3.05)])
@pytest.mark.parametrize("press", [(11.0, 0.0), (15.0, 7.0), (20.0, 10.0), (6.0, 60.0)])
@pytest.mark.parametrize("name", SHAPES)
def test_every_pixel_matches_quadrature(name: str, press: tuple[float, float], origin_mm: tuple[float, float]) -> None:
    mark = ccdbsm(Brush(), *press)
    expected = quadrature(*curve_of(name, mark), origin_mm)
    assert abs(one(SHAPES[name](mark), origin_mm) - expected).max() < 1e-6


@pytest.mark.parametrize("name", SHAPES)
def test_supersampling_agrees_on_average_and_in_total(name: str) -> None:
    # 32 x 32 points per pixel count an edge that runs along a row or column in whole lines of 32 points: up
    # to half a line, 1/64 = .016 of the pixel, is lost or won there however exact the shape is. So the
    # largest difference cannot come under 1e-3; the mean over the boundary and the total can.
    mark = ccdbsm(Brush(), *PRESS)
    curve, _ = curve_of(name, mark)
    fine = (np.arange(32 * SIZE_PX) + 0.5) * PX_MM / 32
    inside = abs(OFF_GRID_MM[1] - fine)[:, None] <= curve(fine - OFF_GRID_MM[0])[None, :]
    inside[:, curve(fine - OFF_GRID_MM[0]) <= 0] = False
    sampled = inside.reshape(SIZE_PX, 32, SIZE_PX, 32).mean((1, 3))
    ours = one(SHAPES[name](mark), OFF_GRID_MM)
    boundary = (ours > 0) & (ours < 1)
    difference = abs(ours - sampled)
    assert difference[boundary].mean() <= 1e-3
    assert difference.max() <= 1 / 32
    assert ours.sum() == pytest.approx(sampled.sum(), rel=1e-3)


@pytest.mark.parametrize("name", SHAPES)
def test_exact_lines_agree_in_every_pixel(name: str) -> None:
    # 32 lines per pixel with the ink along each taken exactly, upright where the edge is flat and level where
    # it is steep, so that the edge never runs along the lines: what is left is far below the 1/64 of points.
    mark = ccdbsm(Brush(), *PRESS)
    curve, kinks = curve_of(name, mark)
    fine = (np.arange(32 * SIZE_PX) + 0.5) * PX_MM / 32
    edges = np.arange(SIZE_PX + 1) * PX_MM
    x, x_edges = fine - OFF_GRID_MM[0], edges - OFF_GRID_MM[0]
    upright = ink(curve, x, OFF_GRID_MM[1] - edges).reshape(SIZE_PX, SIZE_PX, 32).mean(2) / PX_MM

    left, right = level_ends(curve, kinks, abs(OFF_GRID_MM[1] - fine))
    covered = np.clip(x_edges[None, :], left[:, None], right[:, None])
    level = np.diff(covered, axis=1).reshape(SIZE_PX, 32, SIZE_PX).mean(1) / PX_MM

    steep = abs(np.diff(curve(x_edges))) > PX_MM
    expected = np.where(steep[None, :], level, upright)
    difference = abs(one(SHAPES[name](mark), OFF_GRID_MM) - expected)
    assert difference.max() <= 1e-3


presses = st.tuples(st.floats(0.5, 19.9), st.floats(0, 12))
origins = st.tuples(st.floats(-5, 30), st.floats(-5, 30))


@given(presses, origins, st.sampled_from(sorted(SHAPES)))
@settings(deadline=None)
def test_coverage_is_a_share_and_mirrors_in_y(
    press: tuple[float, float], origin_mm: tuple[float, float], name: str
) -> None:
    profile = SHAPES[name](ccdbsm(Brush(), *press))
    image = coverage_at(profile, origin_mm)
    assert image.shape == (1, SIZE_PX, SIZE_PX)
    assert 0 <= image.min() <= image.max() <= 1
    mirrored = coverage_at(profile, (origin_mm[0], SIZE_PX * PX_MM - origin_mm[1]))
    torch.testing.assert_close(image.flip(1), mirrored, rtol=0, atol=1e-9)


@given(presses, st.floats(-0.1, 0.1), st.floats(-0.1, 0.1), st.sampled_from(sorted(SHAPES)))
@settings(deadline=None)
def test_ink_sums_to_the_area(press: tuple[float, float], dx: float, dy: float, name: str) -> None:
    profile = SHAPES[name](ccdbsm(Brush(), *press))
    image = coverage_at(profile, centred_origin(profile) + torch.tensor([dx, dy], dtype=torch.float64))
    assert image.sum().item() * PX_MM**2 == pytest.approx(profile.area_mm2.item(), rel=1e-6)


@given(presses, st.floats(0.1, 1.0))
@settings(deadline=None)
def test_a_smaller_press_is_the_same_picture_in_smaller_pixels(press: tuple[float, float], factor: float) -> None:
    mark = ccdbsm(Brush(), *press)
    smaller = ccdbsm(Brush(), factor * press[0], press[1])
    image = coverage_at(mark, centred_origin(mark))
    small = coverage_at(smaller, centred_origin(smaller, px_mm=factor * PX_MM), px_mm=factor * PX_MM)
    torch.testing.assert_close(image, small, rtol=0, atol=1e-8)


@given(presses, st.sampled_from(sorted(SHAPES)))
@settings(deadline=None)
def test_single_precision_is_good_to_a_thousandth(press: tuple[float, float], name: str) -> None:
    double, single = (SHAPES[name](ccdbsm(Brush(), *press, dtype=dtype)) for dtype in (torch.float64, torch.float32))
    image = coverage_at(single, centred_origin(single))
    assert image.dtype == torch.float32
    assert (image - coverage_at(double, centred_origin(double))).abs().max().item() < 1e-3


def test_the_tip_points_left_and_rows_grow_downwards() -> None:
    mark = ccdbsm(Brush(), 11.0, 5.0)
    image = one(mark, (18.0, 5.1))
    rows, columns = np.nonzero(image > 1e-6)
    assert columns.min() == int((18.0 - mark.o4o3_mm.item()) / PX_MM)
    assert columns.max() == int((18.0 + mark.o3a_mm.item()) / PX_MM)
    assert (rows.min() + rows.max() + 1) / 2 * PX_MM == pytest.approx(5.1)
    assert image.sum(0).argmax() * PX_MM == pytest.approx(18.0, abs=PX_MM)


def test_images_of_a_batch_do_not_depend_on_each_other() -> None:
    depths_mm = torch.linspace(11, 20, 19, dtype=torch.float64)
    mark = ccdbsm(Brush(), depths_mm, 5.0)
    origins_mm = centred_origin(mark)
    batch = coverage_at(mark, origins_mm)
    for k in (0, 7, 8, 18):
        alone = coverage_at(ccdbsm(Brush(), depths_mm[k], 5.0), origins_mm[k])
        torch.testing.assert_close(batch[k], alone[0], rtol=0, atol=1e-6)


def test_other_rasters_and_the_empty_batch() -> None:
    mark = ccdbsm(Brush(), 20.0, 10.0)
    image = coverage_at(mark, centred_origin(mark, size_px=40, px_mm=0.7), size_px=40, px_mm=0.7)
    assert image.shape == (1, 40, 40)
    assert image.sum().item() * 0.7**2 == pytest.approx(mark.area_mm2.item())
    empty = ccdbsm(Brush(), torch.empty(0, dtype=torch.float64), 5.0)
    assert coverage_at(empty, (12.8, 12.8)).shape == (0, SIZE_PX, SIZE_PX)


def test_gradients_are_exact_even_with_the_axis_on_a_row_edge() -> None:
    def small_image(h: torch.Tensor, tilt: torch.Tensor, lam: torch.Tensor, origin: torch.Tensor) -> torch.Tensor:
        return coverage_at(ccdbsm(Brush(), h, tilt, lam), origin, size_px=9, px_mm=2.0)

    point = [torch.tensor(v, dtype=torch.float64, requires_grad=True) for v in ([13.0], [6.0], [3.0], [14.3, 8.0])]
    assert torch.autograd.gradcheck(small_image, point)


@pytest.mark.parametrize("name", SHAPES)
def test_gradients_stay_finite_at_the_ends_and_the_peak(name: str) -> None:
    # The axis lies on a row edge, and rows beyond the peak meet square roots that have no derivative.
    depth_mm = torch.tensor([15.0], dtype=torch.float64, requires_grad=True)
    profile = SHAPES[name](ccdbsm(Brush(), depth_mm, 5.0))
    (slope,) = torch.autograd.grad(coverage_at(profile, (20.0, 12.8)).sum() * PX_MM**2, depth_mm)
    assert slope.item() == pytest.approx(2 * profile.area_mm2.item() / 15.0, rel=1e-9)


# torch itself compiles its forward-mode rules with torch.jit.script on first use, and warns about it.
@pytest.mark.filterwarnings("ignore:.torch.jit.script. is deprecated:DeprecationWarning")
def test_forward_derivatives_match_differences() -> None:
    def image(depth_mm: torch.Tensor) -> torch.Tensor:
        return coverage_at(ccdbsm(Brush(), depth_mm, 0.0), (20.0, 12.8))

    # No height ends the heel on a column edge: the derivative jumps there.
    depths_mm = torch.tensor([11.1, 13.3, 17.7, 19.9, 20.3], dtype=torch.float64)
    slope = torch.func.jvp(image, (depths_mm,), (torch.ones_like(depths_mm),))[1]
    step = 1e-6
    expected = (image(depths_mm + step) - image(depths_mm - step)) / (2 * step)
    torch.testing.assert_close(slope, expected, rtol=0, atol=1e-5)


def test_rasters_that_make_no_image_are_refused() -> None:
    mark = ccdbsm(Brush(), torch.tensor([11.0, 13.0, 15.0]), 5.0)
    with pytest.raises(ValueError, match="size_px = 0"):
        coverage_at(mark, (1.0, 1.0), size_px=0)
    with pytest.raises(ValueError, match="px_mm = -1"):
        centred_origin(mark, px_mm=-1.0)
    with pytest.raises(ValueError, match=r"\(2, 2\), expected \(2,\) or \(3, 2\)"):
        coverage_at(mark, torch.zeros(2, 2))
