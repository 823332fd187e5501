"""Coverage of outlines and straight from presses: against areas and each other."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from brushloop.model.ccdbsm import Brush, CcdBsm, ccdbsm
from brushloop.model.outline import Outline, cross
from brushloop.model.raster import PX_MM, centred_origin, coverage
from brushloop.model.raster.centred import press_images
from brushloop.model.strokes import stroke_models

MODELS = stroke_models(Brush())
ORIGIN = (12.117, 13.743)
presses = st.tuples(st.floats(3, 20), st.floats(0, 60))


def half_width(mark: CcdBsm, x: np.ndarray) -> np.ndarray:
    """Eq. 1 of one mark, written independently; negative beyond its ends."""
    heel, wide, tip = mark.o3a_mm.item(), mark.half_width_mm.item(), mark.o4o3_mm.item()
    inside = (-tip < x) & (x < heel)
    toward_tip, toward_heel = 1 - (x / tip) ** 2, np.sqrt(np.maximum(0.0, 1 - (x / heel) ** 2))
    return np.where(inside, wide * np.where(x < 0, toward_tip, toward_heel), -1.0)


def pixel_by_strips(mark: CcdBsm, i: int, j: int, origin: tuple[float, float], heading_deg: float) -> float:
    """The share of pixel (i, j) under the mark: its square is turned into the stroke frame and cut into strips."""
    psi = math.radians(heading_deg)
    corners = []
    for column, row in ((j, i), (j + 1, i), (j + 1, i + 1), (j, i + 1)):
        right, up = column * PX_MM - origin[0], origin[1] - row * PX_MM
        corners.append((right * math.cos(psi) + up * math.sin(psi), up * math.cos(psi) - right * math.sin(psi)))
    x = np.linspace(min(x for x, _ in corners), max(x for x, _ in corners), 40_001)
    sides = []
    for (xa, ya), (xb, yb) in zip(corners, [*corners[1:], corners[0]], strict=True):
        if xa != xb:
            beside = (x < min(xa, xb)) | (x > max(xa, xb))
            sides.append(np.where(beside, np.nan, ya + (x - xa) / (xb - xa) * (yb - ya)))
    wide = half_width(mark, x)
    inked = np.minimum(np.nanmax(sides, axis=0), wide) - np.maximum(np.nanmin(sides, axis=0), -wide)
    return float(np.trapezoid(np.maximum(inked, 0.0), x)) / PX_MM**2


@pytest.mark.parametrize("press", [(15.0, 7.0), (11.0, 0.0), (6.0, 60.0)])
@pytest.mark.parametrize("heading_deg", [0.0, 45.0, 133.3, -71.0])
def test_boundary_pixels_match_their_area_at_any_heading(press: tuple[float, float], heading_deg: float) -> None:
    mark = ccdbsm(Brush(), *press)
    image = coverage(mark.outline(), ORIGIN, heading_deg)[0]
    boundary = np.argwhere((image > 1e-6) & (image < 1 - 1e-6))
    for i, j in boundary[np.random.default_rng(0).choice(len(boundary), 10, replace=False)]:
        assert abs(image[i, j] - pixel_by_strips(mark, i, j, ORIGIN, heading_deg)) < 1e-6


@given(presses, st.floats(-360, 360), st.floats(-5, 30), st.floats(-5, 30), st.sampled_from(sorted(MODELS)))
@settings(deadline=None, max_examples=60)
def test_an_image_is_cut_out_of_a_larger_one_wherever_a_mark_lies(
    press: tuple[float, float], heading_deg: float, x_mm: float, y_mm: float, name: str
) -> None:
    outline = MODELS[name].profile(*press)
    image = coverage(outline, (x_mm, y_mm), heading_deg, size_px=64, px_mm=0.4)[0]
    larger = coverage(outline, (x_mm + 64 * 0.4, y_mm + 64 * 0.4), heading_deg, size_px=192, px_mm=0.4)[0]
    assert abs(image - larger[64:128, 64:128]).max() < 1e-6


def test_marks_on_pixel_edges_come_out_right() -> None:
    # Whole numbers of pixels and eighths of a turn put ends, turns and 45 degree points onto edges and corners.
    rng = np.random.default_rng(0)
    depth_mm, tilt_deg = (rng.choice(of, 100) for of in ((2.0, 8.0, 10.3125, 16.0), (0.0, 5.0, 20.0)))
    heading_deg, origin = 45.0 * rng.integers(-4, 5, 100), 0.25 * rng.integers(96, 160, (100, 2))
    outline = ccdbsm(Brush(), depth_mm, tilt_deg).outline()
    assert_whole(outline, coverage(outline, origin, heading_deg, size_px=256, px_mm=0.25), 0.25)
    # A place that is off an edge by less than can be seen makes the same image.
    image, beside = (coverage(outline, origin + off, heading_deg, px_mm=0.25) for off in (0.0, 1e-9))
    assert abs(image - beside).max() < 1e-6


def assert_whole(outline: Outline, images: np.ndarray, px_mm: float) -> None:
    """The ink of marks that lie within their images is their area, and no pixel holds more than itself."""
    assert images.sum(axis=(1, 2)) * px_mm**2 == pytest.approx(outline.area_mm2, rel=1e-5)
    assert images.min() >= 0
    assert images.max() <= 1


@pytest.mark.parametrize("weight", [0.05, 0.2, 0.45, 0.6, 0.95])
def test_arcs_of_any_span_and_shear_come_out_right(weight: float) -> None:
    arcs = np.random.default_rng(0).uniform(2, 24, (20, 3, 2))
    start, middle, end = np.moveaxis(arcs, 1, 0)
    backwards = cross(middle - start, end - start) < 0
    arcs[backwards] = arcs[backwards, ::-1]
    chords = np.stack((arcs[:, 2], 0.5 * (arcs[:, 0] + arcs[:, 2]), arcs[:, 0]), axis=1)
    outline = Outline(np.stack((arcs, chords), axis=1), np.tile([weight, 1.0], (20, 1)))
    assert_whole(outline, coverage(outline, (0.0, 25.6)), PX_MM)


@pytest.mark.parametrize(("size_px", "px_mm"), [(128, 0.2), (64, 0.05), (200, 0.1), (2, 30.0)])
def test_images_straight_from_presses_match_the_outline_s(size_px: int, px_mm: float) -> None:
    # Marks of any size, and others that end on pixel edges; some reach beyond the image.
    rng = np.random.default_rng(size_px)
    tilt_deg = rng.uniform(0, 60, 150)
    anywhere = ccdbsm(Brush(), np.minimum(rng.uniform(0.01, 40, 150), 47 * np.cos(np.radians(tilt_deg))), tilt_deg)
    on_edges = CcdBsm(*(px_mm * rng.integers(1, 90, (3, 150))), lam=np.ones(150))
    for mark in (anywhere, on_edges):
        outline = mark.outline()
        level = coverage(outline, centred_origin(outline, size_px=size_px, px_mm=px_mm), size_px=size_px, px_mm=px_mm)
        images = press_images(mark, size_px=size_px, px_mm=px_mm, out=np.full(level.shape, 7, np.float32))
        assert abs(images - level).max() < 1e-6
        assert images.min() >= 0
        assert images.max() <= 1
    with pytest.raises(ValueError, match=r"out is float64 \(150, "):
        press_images(anywhere, size_px=size_px, px_mm=px_mm, out=np.zeros(level.shape))


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"size_px": 0}, "size_px = 0"),
        ({"px_mm": -1.0}, "px_mm = -1"),
        ({"heading_deg": np.zeros(2)}, r"heading_deg has shape \(2,\)"),
        ({"origin_mm": np.zeros((2, 2))}, r"origin_mm has shape \(2, 2\), expected \(2,\) or \(3, 2\)"),
        *(({"origin_mm": (x_mm, 1.0)}, "not finite or lie more than 1e") for x_mm in (math.nan, math.inf, 1e30)),
    ],
)
def test_what_makes_no_image_is_refused(options: dict, words: str) -> None:
    outline = ccdbsm(Brush(), np.array([11.0, 13.0, 15.0]), 5.0).outline()
    with pytest.raises(ValueError, match=words):
        coverage(outline, **{"origin_mm": (1.0, 1.0)} | options)
    nothing = Outline(outline.points[:0], outline.weights[:0])
    assert coverage(nothing, (1.0, 1.0)).shape == (0, 128, 128)
