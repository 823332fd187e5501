"""Coverage at any heading and place, in torch and compiled, against quadrature, supersampling and each other."""

import math
from collections.abc import Callable

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.integrate import quad

from brushloop.model.brush import Brush, DomainError
from brushloop.model.ccdbsm import CcdBsm, ccdbsm
from brushloop.model.outline import cross, loop
from brushloop.model.press_images import press_images
from brushloop.model.raster.compiled import coverage_numpy
from brushloop.model.raster.exact import coverage_at
from brushloop.model.raster.frame import centred_origin
from brushloop.model.strokes import stroke_models

Array = NDArray[np.floating]
MODELS = stroke_models(Brush())
DOUBLE = {"dtype": torch.float64}
HEADINGS = (0.0, 90.0, 180.0, -90.0)
ORIGIN = (12.117, 13.743)


def half_width_of(mark: CcdBsm) -> Callable[[float], float]:
    """Eq. 1 of one mark, written independently."""
    a, w, t = mark.o3a_mm.item(), mark.half_width_mm.item(), mark.o4o3_mm.item()

    def half_width(x: float) -> float:
        if not -t < x < a:
            return -1.0
        return w * (1 - (x / t) ** 2) if x < 0 else w * math.sqrt(1 - (x / a) ** 2)

    return half_width


def pixel_by_quadrature(mark: CcdBsm, i: int, j: int, origin: tuple[float, float], heading_deg: float) -> float:
    """The share of pixel (i, j) under the mark: the pixel's square is turned into the stroke frame and integrated."""
    px, psi = 0.2, math.radians(heading_deg)
    corners = []
    for column, row in ((j, i), (j + 1, i), (j + 1, i + 1), (j, i + 1)):
        right, up = column * px - origin[0], origin[1] - row * px
        corners.append((right * math.cos(psi) + up * math.sin(psi), up * math.cos(psi) - right * math.sin(psi)))
    half_width = half_width_of(mark)

    def inked(x: float) -> float:
        cuts = []
        for (xa, ya), (xb, yb) in zip(corners, [*corners[1:], corners[0]], strict=True):
            if min(xa, xb) <= x <= max(xa, xb) and xa != xb:
                cuts.append(ya + (x - xa) / (xb - xa) * (yb - ya))
        w = half_width(x)
        return max(0.0, min(max(cuts), w) - max(min(cuts), -w)) if cuts and w > 0 else 0.0

    low, high = min(x for x, _ in corners), max(x for x, _ in corners)
    kinks = [*(x for x, _ in corners), 0.0, mark.o3a_mm.item(), -mark.o4o3_mm.item()]
    points = sorted(x for x in kinks if low < x < high)
    area, _ = quad(inked, low, high, points=points or None, limit=500, epsabs=1e-10, epsrel=1e-10)
    return area / px**2


@pytest.mark.parametrize("press", [(15.0, 7.0), (11.0, 0.0), (20.0, 10.0)])
@pytest.mark.parametrize("heading_deg", [17.0, 45.0, 133.3, -71.0])
def test_boundary_pixels_match_quadrature_at_any_heading(press: tuple[float, float], heading_deg: float) -> None:
    mark = ccdbsm(Brush(), *press)
    exact = coverage_at(mark, ORIGIN, heading_deg)[0].numpy()
    compiled = coverage_numpy(mark, ORIGIN, heading_deg, out=np.empty((1, 128, 128)))[0]
    boundary = np.argwhere((exact > 0) & (exact < 1))
    chosen = np.random.default_rng(0).choice(len(boundary), 10, replace=False)
    for i, j in boundary[chosen]:
        expected = pixel_by_quadrature(mark, i, j, ORIGIN, heading_deg)
        assert abs(exact[i, j] - expected) < 1e-6
        assert abs(compiled[i, j] - expected) < 1e-6


@pytest.mark.parametrize("name", ["ccd-bsm", "ellipse", "circle", "line"])
def test_quarter_turns_match_heading_0_in_every_pixel(name: str) -> None:
    shape = MODELS[name].profile(torch.tensor([11.0, 15.0, 20.0], **DOUBLE), 5.0)
    origin = centred_origin(shape) + torch.tensor([0.037, -0.061])
    level = coverage_at(shape, origin)
    for quarters, heading_deg in enumerate(HEADINGS[:3]):
        # Turning the picture counter-clockwise about its middle takes (x, y) to (y, side - x), from the top left.
        placed = origin
        for _ in range(quarters):
            placed = torch.stack((placed[:, 1], 25.6 - placed[:, 0]), dim=-1)
        turned = torch.rot90(level, quarters, (1, 2))
        assert (coverage_at(shape, placed, heading_deg) - turned).abs().max().item() < 1e-6
        assert abs(coverage_numpy(shape, placed, heading_deg) - turned.numpy()).max() < 1e-6


presses = st.tuples(st.floats(3, 20), st.floats(0, 60))


@given(presses, st.floats(-360, 360), st.floats(-5, 30), st.floats(-5, 30), st.sampled_from(sorted(MODELS)))
@settings(deadline=None, max_examples=60)
def test_both_exact_paths_agree_wherever_a_mark_lies(
    press: tuple[float, float], heading_deg: float, x_mm: float, y_mm: float, name: str
) -> None:
    shape = MODELS[name].profile(*press)
    exact = coverage_at(shape, (x_mm, y_mm), heading_deg, size_px=64, px_mm=0.4)[0].numpy()
    compiled = coverage_numpy(shape, (x_mm, y_mm), heading_deg, size_px=64, px_mm=0.4)[0]
    assert abs(exact - compiled).max() < 1e-6
    assert exact.min() >= 0
    assert exact.max() <= 1


def test_marks_on_pixel_edges_come_out_right() -> None:
    # Whole numbers of pixels and eighths of a turn put ends, turns and 45 degree points onto edges and corners.
    rng = np.random.default_rng(0)
    depth_mm, tilt_deg = (torch.from_numpy(rng.choice(of, 100)) for of in ((2.0, 8.0, 10.3125, 16.0), (0.0, 5.0, 20.0)))
    heading_deg = torch.from_numpy(45.0 * rng.integers(-4, 5, 100))
    mark = ccdbsm(Brush(), depth_mm, tilt_deg)
    origin = torch.from_numpy(0.25 * rng.integers(24, 104, (100, 2)))
    image = coverage_numpy(mark, origin, heading_deg, px_mm=0.25, out=np.empty((100, 128, 128)))
    assert abs(image - coverage_at(mark, origin, heading_deg, px_mm=0.25).numpy()).max() < 1e-6
    assert image.min() >= 0
    assert image.max() <= 1


@pytest.mark.parametrize("weight", [0.05, 0.2, 0.45, 0.6, 0.95])
def test_arcs_of_any_span_and_shear_come_out_right(weight: float) -> None:
    start, middle, end = torch.from_numpy(np.random.default_rng(0).uniform(2, 24, (20, 3, 2))).unbind(1)
    flipped = cross(middle - start, end - start)[:, None] < 0
    start, end = torch.where(flipped, end, start), torch.where(flipped, start, end)
    chord = 0.5 * (start + end)
    shape = loop(((*start.T, *middle.T, *end.T), weight), ((*end.T, *chord.T, *start.T), 1.0))
    image = coverage_numpy(shape, (0.0, 25.6), out=np.empty((20, 128, 128)))
    assert abs(image - coverage_at(shape, (0.0, 25.6)).numpy()).max() < 1e-6


@pytest.mark.parametrize(("size_px", "px_mm"), [(128, 0.2), (64, 0.05), (200, 0.1), (1, 30.0)])
@pytest.mark.parametrize("grid", ["nowhere", "on corners", "beside corners"])
def test_images_straight_from_presses_match_the_closed_form(size_px: int, px_mm: float, grid: str) -> None:
    # Marks that end on pixel edges, lie on row edges and in the middle of rows, and reach beyond the image or miss it.
    rng = np.random.default_rng(size_px)
    tilt_deg = rng.uniform(0, 60, 150)
    depth_mm = np.minimum(rng.uniform(0.01, 40, 150), 47 * np.cos(np.radians(tilt_deg)))
    mark = ccdbsm(Brush(), torch.from_numpy(depth_mm), torch.from_numpy(tilt_deg))
    side_mm = size_px * px_mm
    origin = rng.uniform(-0.6 * side_mm - 10, 1.6 * side_mm + 10, (150, 2))
    if grid != "nowhere":
        origin = np.round(2 * origin / px_mm) / 2 * px_mm
        origin[:, 0] = np.round(origin[:, 0] / px_mm) * px_mm - rng.choice([0.0, 1.0], 150) * mark.o3a_mm.numpy()
    if grid == "beside corners":
        origin += rng.choice([1e-6, -1e-7, 1e-12], (150, 2))
    level = coverage_at(mark, torch.from_numpy(origin), size_px=size_px, px_mm=px_mm).numpy()
    dirty = np.full(level.shape, 7, np.float32)
    images = press_images(Brush(), depth_mm, tilt_deg, origin_mm=origin, size_px=size_px, px_mm=px_mm, out=dirty)
    assert abs(images - level).max() < 1e-6
    assert images.min() >= 0
    assert images.max() <= 1


def test_presses_of_many_brushes_are_centred_and_checked() -> None:
    radius_mm, lam = torch.tensor([5.0, 6.0, 7.0], **DOUBLE), np.array([1.0, 2.0, 3.0])
    mark = ccdbsm(Brush(radius_mm, 44.0), 15.0, 7.0, torch.from_numpy(lam))
    expected = coverage_at(mark, centred_origin(mark)).numpy()
    np.testing.assert_allclose(press_images(Brush(radius_mm, 44.0), 15.0, 7.0, lam), expected, rtol=0, atol=1e-6)
    np.testing.assert_array_equal(*(press_images(Brush(), np.full(130, 15.0), 7.0, threads=n) for n in (1, 2)))
    with pytest.raises(DomainError, match=r"tilt_deg = -1 is outside \[0, 82.875\) deg"):
        press_images(Brush(), np.array([15.0, 15.0]), np.array([7.0, -1.0]))
    with pytest.raises(DomainError, match=r"depth_mm = nan is outside \(0, 47.6"):
        press_images(Brush(), math.nan, 7.0)
    with pytest.raises(ValueError, match="a shape is not finite"):
        press_images(Brush(), np.full(2, 15.0), 7.0, origin_mm=np.array([[1.0, 1.0], [math.nan, 1.0]]))
    with pytest.raises(ValueError, match=r"origin_mm has shape \(2, 2\)"):
        press_images(Brush(), 15.0, 7.0, origin_mm=np.ones((2, 2)))
    with pytest.raises(ValueError, match="out is float64"):
        press_images(Brush(), 15.0, 7.0, out=np.empty((1, 128, 128)))  # pyright: ignore[reportArgumentType]


@given(presses, st.floats(-180, 180), st.sampled_from(sorted(MODELS)))
@settings(deadline=None, max_examples=40)
def test_the_ink_of_a_whole_mark_is_its_area(press: tuple[float, float], heading_deg: float, name: str) -> None:
    shape = MODELS[name].profile(*press)
    side = 1.2 * float(2 * (shape.x_max_mm - shape.x_min_mm) + 2 * shape.width_mm)
    px_mm = side / 128
    image = coverage_at(shape, (side / 2, side / 2), heading_deg, px_mm=px_mm)
    assert image.sum().item() * px_mm**2 == pytest.approx(shape.area_mm2.item(), rel=1e-6)


@pytest.mark.parametrize("heading_deg", [30.0, -100.0])
def test_supersampling_agrees_at_a_heading(heading_deg: float) -> None:
    # A point is counted whole, so single pixels differ by up to half a line of 32 points; see test_coverage.py.
    # The pixels are twice as large as usual, which leaves a quarter of the points.
    raster = {"size_px": 64, "px_mm": 0.4}
    mark = ccdbsm(Brush(), 15.0, 7.0)
    fine = (np.arange(32 * 64) + 0.5) * 0.4 / 32
    right, up, psi = fine - ORIGIN[0], ORIGIN[1] - fine, math.radians(heading_deg)
    x = right[None, :] * math.cos(psi) + up[:, None] * math.sin(psi)
    y = up[:, None] * math.cos(psi) - right[None, :] * math.sin(psi)
    a, w, t = mark.o3a_mm.item(), mark.half_width_mm.item(), mark.o4o3_mm.item()
    inside = abs(y) <= np.where(x < 0, w * (1 - (x / t) ** 2), w * np.sqrt(np.maximum(0, 1 - (x / a) ** 2)))
    inside &= (x > -t) & (x < a)
    sampled = inside.reshape(64, 32, 64, 32).mean((1, 3))
    for image in (
        coverage_at(mark, ORIGIN, heading_deg, **raster)[0].numpy(),
        coverage_at(ccdbsm(Brush(), 15.0, 7.0, dtype=torch.float32), ORIGIN, heading_deg, **raster)[0].numpy(),
        coverage_numpy(mark, ORIGIN, heading_deg, **raster)[0],
    ):
        boundary = (image > 0) & (image < 1)
        assert abs(image - sampled)[boundary].mean() < 1e-3
        assert abs(image - sampled).max() <= 1 / 32
        assert image.sum() == pytest.approx(sampled.sum(), rel=1e-4)


@given(presses, st.floats(-180, 180))
@settings(deadline=None, max_examples=30)
def test_single_precision_is_good_to_a_thousandth(press: tuple[float, float], heading_deg: float) -> None:
    double, single = (ccdbsm(Brush(), *press, dtype=dtype) for dtype in (torch.float64, torch.float32))
    image = coverage_at(single, ORIGIN, heading_deg)
    assert image.dtype == torch.float32
    assert (image - coverage_at(double, ORIGIN, heading_deg)).abs().max().item() < 1e-3


def parameters() -> list[torch.Tensor]:
    """H, alpha, R, L, lambda, (x0, y0), heading: no boundary runs along a pixel edge."""
    values = ([13.0], [6.0], [6.0], [48.0], [3.0], [[14.3, 8.0]], [25.0])
    return [torch.tensor(v, **DOUBLE, requires_grad=True) for v in values]


# torch itself compiles its forward-mode rules with torch.jit.script on first use, and warns about it.
@pytest.mark.filterwarnings("ignore:.torch.jit.script. is deprecated:DeprecationWarning")
def test_gradients_are_exact_in_every_parameter() -> None:
    def image(h, tilt, radius, length, lam, origin, heading) -> torch.Tensor:
        mark = ccdbsm(Brush(radius, length), h, tilt, lam)
        return coverage_at(mark, origin, heading, size_px=9, px_mm=2.0)

    assert torch.autograd.gradcheck(image, parameters(), check_forward_ad=True)


@pytest.mark.parametrize("name", sorted(MODELS))
def test_every_model_has_exact_gradients_in_its_own_parameters(name: str) -> None:
    model = MODELS[name]
    start = {key: value.detach() for key, value in model.of_press(13.0, 6.0).items()}
    if name == "qbc":  # bent, so that no derivative vanishes
        start["y1_mm"] = start["y1_mm"] + 2.3
    names = [key for key in start if not (name == "line" and key == "reach_y_mm")]  # 0 is its lower end

    def image(*values: torch.Tensor) -> torch.Tensor:
        return coverage_at(
            model.shape(start | dict(zip(names, values, strict=True))), (14.3, 8.1), 25.0, size_px=9, px_mm=2.0
        )

    assert torch.autograd.gradcheck(image, [start[key].clone().requires_grad_() for key in names])


def test_large_batches_run_on_threads_and_come_out_the_same() -> None:
    depths_mm = torch.linspace(11, 20, 150, **DOUBLE)
    mark = ccdbsm(Brush(), depths_mm, 5.0)
    one, two = (coverage_numpy(mark, centred_origin(mark), depths_mm, threads=n) for n in (1, 2))
    assert one.dtype == np.float32
    np.testing.assert_array_equal(one, two)
    assert coverage_numpy(ccdbsm(Brush(), depths_mm[:0], 5.0), (1.0, 1.0)).shape == (0, 128, 128)
    assert coverage_at(ccdbsm(Brush(), depths_mm[:0], 5.0), (1.0, 1.0)).shape == (0, 128, 128)


def test_what_makes_no_image_is_refused() -> None:
    mark = ccdbsm(Brush(), torch.tensor([11.0, 13.0, 15.0]), 5.0)
    for draw in (coverage_at, coverage_numpy):
        with pytest.raises(ValueError, match="size_px = 0"):
            draw(mark, (1.0, 1.0), size_px=0)
        with pytest.raises(ValueError, match=r"heading_deg has shape \(2,\)"):
            draw(mark, (1.0, 1.0), torch.zeros(2))
        with pytest.raises(ValueError, match=r"origin_mm has shape \(2, 2\)"):
            draw(mark, torch.zeros(2, 2))
    with pytest.raises(ValueError, match=r"out is int64 \(3, 128, 128\)"):
        coverage_numpy(mark, (1.0, 1.0), out=np.zeros((3, 128, 128), np.int64))
    for nowhere in (math.nan, math.inf, 1e30):
        with pytest.raises(ValueError, match="a shape is not finite, or lies more than 1e"):
            coverage_numpy(mark, (nowhere, 1.0))
