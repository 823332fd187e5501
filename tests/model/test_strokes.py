"""The stroke models, the regressed ones, and CCD-BSM against published numbers, its cone and integration."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import quad
from scipy.optimize import brentq

from brushloop.model.ccdbsm import Brush, CcdBsm, DomainError, basic_lengths, ccdbsm
from brushloop.model.outline import Outline, as_batch
from brushloop.model.raster import coverage
from brushloop.model.strokes import UnknownModelError, fit_plane, stroke_model, stroke_models
from brushloop.model.strokes.peers import bezier, bounding_ellipse, circle, line, qbc

MODELS = stroke_models(Brush())
NAMES = ["ccd-bsm", "bezier", "circle", "ellipse", "line", "qbc"]
DEPTHS = np.array([11.0, 15.0, 20.0])
MARK = ccdbsm(Brush(), DEPTHS, 5.0)
STUBBY = ccdbsm(Brush(radius_mm=15, length_mm=40), DEPTHS, 5.0)  # wider than long


def test_every_model_is_listed_and_describes_itself() -> None:
    assert list(MODELS) == NAMES
    for name, model in MODELS.items():
        assert model.name == name
        assert not model.fitted
        assert model.label
        assert model.definition.endswith(".")
    assert "1.5" in stroke_models(Brush(), 1.5)["ccd-bsm"].definition
    assert all(model.fitted for model in stroke_models(Brush(), 2.2, fitted=True).values())
    with pytest.raises(UnknownModelError, match="'spline'; known: ccd-bsm, bezier"):
        stroke_model("spline", Brush())


@pytest.mark.parametrize("name", NAMES)
def test_an_outline_closes_counter_clockwise_and_knows_its_sizes(name: str) -> None:
    outline = MODELS[name].profile(DEPTHS, 5.0)
    np.testing.assert_allclose(outline.points[:, :, 2], np.roll(outline.points[:, :, 0], -1, axis=1), atol=1e-12)
    x, y = np.moveaxis(outline.polyline(64), -1, 0)
    shoelace = 0.5 * (x * np.roll(y, -1, axis=1) - y * np.roll(x, -1, axis=1)).sum(1)
    np.testing.assert_allclose(outline.area_mm2, shoelace, rtol=1e-3)
    np.testing.assert_allclose(outline.x_min_mm, x.min(1), atol=2e-3)
    np.testing.assert_allclose(outline.x_max_mm, x.max(1), atol=2e-3)
    np.testing.assert_allclose(outline.width_mm, np.ptp(y, axis=1), atol=2e-3)


@pytest.mark.parametrize("name", ["bezier", "qbc"])
def test_regressed_strokes_have_the_size_of_the_mark(name: str) -> None:
    outline = MODELS[name].profile(DEPTHS, 5.0)
    for size in ("x_min_mm", "x_max_mm", "width_mm", "area_mm2"):
        np.testing.assert_allclose(getattr(outline, size), getattr(MARK, size), rtol=1e-2)
    with pytest.raises(DomainError, match="depth_mm"):  # the domain is the mark's
        MODELS[name].profile(49.0, 0.0)


@pytest.mark.parametrize("mark", [MARK, STUBBY])
def test_simple_shapes_fill_the_box_of_the_mark_and_have_the_areas_of_the_textbook(mark: CcdBsm) -> None:
    length, width = mark.length_mm, mark.width_mm
    short, long = np.minimum(length, width), np.maximum(length, width)
    for outline, across, area in (
        (mark.outline(), width, mark.area_mm2),
        (bounding_ellipse(mark), width, math.pi / 4 * length * width),
        (line(mark), width, math.pi / 4 * short**2 + (long - short) * short),
        (circle(mark), length, math.pi / 4 * length**2),
    ):
        np.testing.assert_allclose(outline.x_min_mm, mark.x_min_mm)
        np.testing.assert_allclose(outline.x_max_mm, mark.x_max_mm)
        np.testing.assert_allclose(outline.width_mm, across)
        np.testing.assert_allclose(outline.area_mm2, area)


@given(st.floats(0.2, 1.5), st.floats(3, 20), st.floats(0, 1))
@settings(deadline=None, max_examples=20)
def test_the_bezier_stroke_is_the_textbook_curve(share: float, belly: float, shoulder: float) -> None:
    tip, base = 16.0, 16.0 * share
    outline = bezier(*as_batch(tip, base, belly, shoulder))
    t = np.linspace(0, 1, 20001)
    nodes = np.array([[-tip, 0], [shoulder * (tip + base) - tip, 2 * belly / 3], [base, 2 * belly / 3], [base, 0]])
    x, y = nodes.T @ np.stack([(1 - t) ** 3, 3 * t * (1 - t) ** 2, 3 * t**2 * (1 - t), t**3])
    assert outline.area_mm2.item() == pytest.approx(2 * np.trapezoid(y, x), rel=1e-5)
    assert outline.area_mm2.item() == pytest.approx(belly * (tip + base) * (4 - shoulder) / 5, rel=1e-6)
    assert outline.width_mm.item() == pytest.approx(belly)


def swept(nodes: list[tuple[float, float]], start_mm: float, end_mm: float) -> Outline:
    control = {
        f"{axis}{k}_mm": np.array([value])
        for k, node in enumerate(nodes)
        for axis, value in zip("xy", node, strict=True)
    }
    return qbc(np.array([start_mm]), np.array([end_mm]), **control)


@given(st.floats(-4, 4), st.floats(-6, 6), st.floats(0.5, 3), st.floats(0.5, 3))
@settings(deadline=None, max_examples=15)
def test_a_swept_disc_covers_the_union_of_its_discs(x1: float, y1: float, start: float, end: float) -> None:
    nodes = np.array([(-6.0, 0.5), (x1, y1), (6.0, -1.0)])
    ours = coverage(swept(nodes.tolist(), start, end), (8.0, 8.0), size_px=16, px_mm=1.0)[0]
    t = np.linspace(0, 1, 201)[:, None]
    centre = (1 - t) ** 2 * nodes[0] + 2 * t * (1 - t) * nodes[1] + t**2 * nodes[2]
    radius = 0.5 * (start + (end - start) * t)
    fine = (np.arange(16 * 16) + 0.5) / 16 - 8
    inside = np.zeros((256, 256), bool)
    for (cx, cy), (r,) in zip(centre, radius, strict=True):
        inside |= (fine[None, :] - cx) ** 2 + (-fine[:, None] - cy) ** 2 <= r**2
    sampled = inside.reshape(16, 16, 16, 16).mean((1, 3))
    assert abs(ours - sampled).max() < 0.05
    assert ours.sum() == pytest.approx(sampled.sum(), rel=0.01)


def test_strokes_that_fold_over_are_refused() -> None:
    with pytest.raises(DomainError, match="bends are wider"):
        swept([(-1.0, 0.0), (0.0, 6.0), (1.0, 0.0)], 4.0, 4.0)
    with pytest.raises(DomainError, match="changes too much for the length"):
        swept([(-1.0, 0.0), (0.0, 0.0), (1.0, 0.0)], 0.4, 12.0)


def test_a_plane_is_fitted_and_needs_three_conditions() -> None:
    depth, tilt = (part.ravel() for part in np.meshgrid(DEPTHS, [0.0, 10.0]))
    plane = fit_plane(depth, tilt, {"tip_mm": 0.5 + depth * (1.1 - 0.002 * tilt)})
    assert plane.coefficients[0].tolist() == pytest.approx([0.5, 1.1, -0.002])
    assert plane.at(14.0, 5.0)["tip_mm"] == pytest.approx(15.76)
    with pytest.raises(ValueError, match="two depths and two tilts"):
        fit_plane(DEPTHS, np.zeros(3), {"tip_mm": DEPTHS})


# CCD-BSM against published numbers, the cone it is cut from, and numerical integration

TABLE = {
    (11, 0): (1.375, 1.375, 12.461, 13.836, 8.639),
    (11, 10): (1.387, 1.396, 12.401, 13.788, 8.773),
    (15, 5): (1.869, 1.882, 16.879, 18.748, 11.826),
    (20, 0): (2.500, 2.500, 22.656, 25.156, 15.708),
    (20, 10): (2.522, 2.539, 22.547, 25.070, 15.950),
}
"""(H, alpha): O3A, O3C, O4O3, length, width, all mm, for R = 6, L = 48 and lambda = pi."""
BRUSH = Brush()


@st.composite
def presses(draw: st.DrawFn) -> tuple[Brush, float, float]:
    """A brush, H and alpha in the domain, away from the last degree, where the mark becomes endless."""
    brush = Brush(radius_mm=draw(st.floats(1, 15)), length_mm=draw(st.floats(20, 80)))
    limit_deg = 89 - math.degrees(math.atan(float(brush.radius_mm) / float(brush.length_mm)))
    tilt_deg = draw(st.floats(0, limit_deg))
    deepest_mm = float(brush.length_mm) * math.cos(math.radians(tilt_deg))
    return brush, draw(st.floats(0.01, 0.999)) * deepest_mm, tilt_deg


@pytest.mark.parametrize("condition", TABLE)
def test_lengths_match_the_published_grid(condition: tuple[int, int]) -> None:
    mark = ccdbsm(BRUSH, *condition)
    ours = [mark.o3a_mm, mark.o3c_mm, mark.o4o3_mm, mark.length_mm, mark.width_mm]
    assert [value.item() for value in ours] == pytest.approx(TABLE[condition], abs=1e-3)


@given(presses())
def test_lengths_are_distances_in_a_cone_cut_by_the_paper(press: tuple[Brush, float, float]) -> None:
    brush, h, tilt_deg = press
    a = math.radians(tilt_deg)
    axis = np.array([math.sin(a), 0.0, math.cos(a)])
    apex = np.array([0.0, 0.0, -h])  # the tip, H below the paper z = 0
    o3 = apex + axis * (h / math.cos(a))
    slope = float(brush.radius_mm) / float(brush.length_mm)

    def outside(point: np.ndarray) -> float:
        """Positive outside the cone: distance to the axis less the cone's radius there."""
        along = float((point - apex) @ axis)
        return float(np.linalg.norm(point - apex - along * axis)) - slope * along

    def wall(direction: list[float]) -> float:
        """The distance on the paper from O3 to the cone's wall."""
        return brentq(lambda s: outside(o3 + s * np.array(direction)), 0.0, 50 * h, xtol=1e-13)

    mark = ccdbsm(brush, h, tilt_deg)
    toward_tip = wall([-1.0, 0.0, 0.0])
    assert mark.o3a_mm.item() == pytest.approx(toward_tip, rel=1e-7)
    assert mark.o3c_mm.item() == pytest.approx(wall([0.0, 1.0, 0.0]), rel=1e-7)
    # The tip hinges about the wall point A: the wall below the paper is laid down on it.
    hinge = o3 - np.array([toward_tip, 0.0, 0.0])
    below = float(np.linalg.norm(hinge - apex))
    assert mark.o4o3_mm.item() == pytest.approx(toward_tip + below, rel=1e-7)


@given(presses(), st.floats(0.5, 4.0))
def test_the_area_matches_quadrature(press: tuple[Brush, float, float], lam: float) -> None:
    mark = ccdbsm(*press, lam)
    a, b, t = mark.o3a_mm.item(), lam * mark.o3c_mm.item(), mark.o4o3_mm.item()
    tip, _ = quad(lambda x: b * (1 - (x / t) ** 2), -t, 0)
    heel, _ = quad(lambda x: b * math.sqrt(max(0.0, 1 - (x / a) ** 2)), 0, a)
    assert mark.area_mm2.item() == pytest.approx(2 * (tip + heel), rel=1e-6)


def test_a_batch_is_its_presses_one_by_one_also_in_scalars() -> None:
    mark = ccdbsm(BRUSH, np.array([11.0, 20.0]), 5)
    assert mark.o3a_mm.shape == mark.lam.shape == (2,)
    scalar = basic_lengths(11.0, math.radians(5), 6.0, 48.0, math)
    assert scalar == pytest.approx((mark.o3a_mm[0], mark.o3c_mm[0], mark.o4o3_mm[0]), rel=1e-12)


@pytest.mark.parametrize(
    ("name", "value", "says"),
    [
        ("tilt_deg", -5.0, "heading + 180"),
        ("tilt_deg", 82.9, "[0, 82.875) deg"),
        ("tilt_deg", math.nan, "[0, 82.875) deg"),
        ("depth_mm", 0.0, "(0, 47.8173] mm"),
        ("depth_mm", 48.0, "(0, 47.8173] mm"),
        ("depth_mm", math.nan, "(0, 47.8173] mm"),
    ],
)
def test_presses_outside_the_domain_are_refused(name: str, value: float, says: str) -> None:
    press = {"depth_mm": 15.0, "tilt_deg": 5.0} | {name: value}
    with pytest.raises(DomainError) as caught:
        ccdbsm(BRUSH, np.array([15.0, press["depth_mm"]]), press["tilt_deg"])
    assert caught.value.name == name
    assert caught.value.value == pytest.approx(value, nan_ok=True)
    assert says in str(caught.value)
    assert ccdbsm(BRUSH, 48, 0).o3c_mm.item() == pytest.approx(6.0)  # the deepest press is inside


def test_impossible_brush_dilation_and_shape_are_refused() -> None:
    with pytest.raises(DomainError, match=r"radius_mm = 0 is outside \(0, inf\)"):
        Brush(radius_mm=0)
    with pytest.raises(DomainError, match="length_mm = -1"):
        Brush(length_mm=-1)
    with pytest.raises(DomainError, match="lam = 0"):
        ccdbsm(BRUSH, 15, 5, 0)
    with pytest.raises(ValueError, match=r"\(2, 2\)"):
        ccdbsm(BRUSH, np.ones((2, 2)), 5)
