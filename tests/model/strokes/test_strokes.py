"""The protocol of the stroke models, the regressed ones, and that a new file is a new model."""

import math
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from brushloop.model import strokes
from brushloop.model.brush import Brush, DomainError
from brushloop.model.ccdbsm import ccdbsm
from brushloop.model.outline import Outline
from brushloop.model.plane import fit_plane
from brushloop.model.raster.exact import coverage_at
from brushloop.model.regression import solve
from brushloop.model.strokes import UnknownModelError, stroke_model, stroke_models
from brushloop.model.sweep import swept

MODELS = stroke_models(Brush())
NAMES = ["ccd-bsm", "bezier", "circle", "ellipse", "line", "line-tapered", "qbc"]
HEIGHTS = torch.tensor([11.0, 15.0, 20.0], dtype=torch.float64)


def test_every_model_is_listed_and_describes_itself() -> None:
    assert list(MODELS) == NAMES
    for name, model in MODELS.items():
        assert model.name == name
        assert not model.fitted
        assert model.label
        assert model.definition.endswith(".")
        for spec in model.parameters:
            assert spec.low <= spec.default <= spec.high
            assert spec.unit in {"mm", "deg", "1"}
            assert spec.meaning
    assert "1.5" in stroke_models(Brush(), 1.5)["ccd-bsm"].definition
    assert all(model.fitted for model in stroke_models(Brush(), 2.2, fitted=True).values())


def test_unknown_model_names_the_known_ones() -> None:
    assert stroke_model("line", Brush()).label == "line"
    with pytest.raises(UnknownModelError, match="'spline'; known: ccd-bsm, bezier") as caught:
        stroke_model("spline", Brush())
    assert caught.value.known == tuple(NAMES)


@pytest.mark.parametrize("file", [*Path(strokes.__path__[0]).glob("[a-z]*.py")], ids=lambda file: file.stem)
def test_a_model_is_a_file_of_at_most_60_lines(file: Path) -> None:
    assert len(file.read_text().splitlines()) <= 60


def test_a_file_in_the_folder_is_a_model(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "square.py").write_text(
        "from brushloop.model import baselines\n"
        "from brushloop.model.protocol import ParameterSpec, Parametric\n"
        "def models(basis):\n"
        "    side = ParameterSpec('radius_mm', 'mm', 0, 9, 1, 'size')\n"
        "    build = lambda v: baselines.Ellipse(v['radius_mm'] * 0, v['radius_mm'], v['radius_mm'])\n"
        "    press = lambda h, a: {'radius_mm': basis.mark(h, a).o3a_mm}\n"
        "    return (Parametric('dot', 'dot', 'A dot.', (side,), build, press),)\n"
    )
    monkeypatch.setattr(strokes, "__path__", [*strokes.__path__, str(tmp_path)])
    try:
        model = stroke_models(Brush())["dot"]
        assert coverage_at(model.profile(15.0, 5.0), (5.0, 5.0)).sum().item() * 0.04 == pytest.approx(
            math.pi * 1.869**2, rel=1e-3
        )
    finally:
        sys.modules.pop("brushloop.model.strokes.square", None)


@pytest.mark.parametrize("name", NAMES)
def test_parameters_make_the_shape_of_the_press(name: str) -> None:
    model = MODELS[name]
    values = model.of_press(HEIGHTS, 5.0)
    assert tuple(values) == tuple(spec.name for spec in model.parameters)
    torch.testing.assert_close(model.shape(values).area_mm2, model.profile(HEIGHTS, 5.0).area_mm2)
    assert model.shape({}).area_mm2.shape == (1,)  # the defaults are a shape
    shape = model.profile(HEIGHTS, 5.0)
    polygon = shape.outline().polyline(64)
    turned = polygon.roll(-1, 1)
    shoelace = 0.5 * (polygon[..., 0] * turned[..., 1] - polygon[..., 1] * turned[..., 0]).sum(1)
    torch.testing.assert_close(shoelace, shape.area_mm2, rtol=1e-3, atol=0)  # positive: counter-clockwise
    outline = shape.outline()
    torch.testing.assert_close(outline.area_mm2, shape.area_mm2, rtol=1e-9, atol=0)
    torch.testing.assert_close(outline.x_min_mm, shape.x_min_mm, rtol=1e-9, atol=0)
    torch.testing.assert_close(outline.x_max_mm, shape.x_max_mm, rtol=1e-9, atol=1e-9)
    torch.testing.assert_close(outline.width_mm, shape.width_mm, rtol=1e-9, atol=0)
    torch.testing.assert_close(polygon[..., 0].amax(1), shape.x_max_mm, rtol=0, atol=2e-3)
    torch.testing.assert_close(outline.points[:, :, 2], outline.points[:, :, 0].roll(-1, 1))  # it closes


@pytest.mark.parametrize("name", NAMES)
def test_values_outside_a_range_are_refused_by_name(name: str) -> None:
    model = MODELS[name]
    for spec in model.parameters:
        for bad in (spec.low - 1, spec.high + 1, math.nan):
            with pytest.raises(DomainError) as caught:
                model.shape({spec.name: bad})
            assert caught.value.name == spec.name
            assert caught.value.value == pytest.approx(bad, nan_ok=True)
    with pytest.raises(ValueError, match="no parameter 'colour'"):
        model.shape({"colour": 1.0})
    with pytest.raises(DomainError, match="heading"):
        model.profile(15.0, -1.0)
    with pytest.raises(DomainError, match="depth_mm"):
        model.profile(49.0, 0.0)


@pytest.mark.parametrize("name", ["bezier", "qbc", "line-tapered"])
def test_regressed_strokes_have_the_size_of_the_mark(name: str) -> None:
    mark = ccdbsm(Brush(), HEIGHTS, 5.0)
    shape = MODELS[name].profile(HEIGHTS, 5.0)
    for size in ("x_min_mm", "x_max_mm", "width_mm", "area_mm2"):
        torch.testing.assert_close(getattr(shape, size), getattr(mark, size), rtol=1e-2, atol=0)


@given(st.floats(0.2, 1.5), st.floats(3, 20), st.floats(0, 1))
@settings(deadline=None, max_examples=20)
def test_the_bezier_stroke_is_the_textbook_curve(share: float, belly: float, shoulder: float) -> None:
    tip, base = 16.0, 16.0 * share
    shape = MODELS["bezier"].shape({"tip_mm": tip, "base_mm": base, "belly_mm": belly, "shoulder": shoulder})
    t = np.linspace(0, 1, 20001)
    nodes = np.array([[-tip, 0], [shoulder * (tip + base) - tip, 2 * belly / 3], [base, 2 * belly / 3], [base, 0]])
    basis = np.stack([(1 - t) ** 3, 3 * t * (1 - t) ** 2, 3 * t**2 * (1 - t), t**3])
    x, y = nodes.T @ basis
    assert shape.area_mm2.item() == pytest.approx(2 * np.trapezoid(y, x), rel=1e-5)
    assert shape.area_mm2.item() == pytest.approx(belly * (tip + base) * (4 - shoulder) / 5, rel=1e-6)
    assert shape.width_mm.item() == pytest.approx(belly)
    # Pixel by pixel, against upright lines with the ink along each taken exactly.
    fine = (np.arange(24 * 64) + 0.5) * 2.0 / 64 - 20
    half = np.interp(fine, x, y, left=0, right=0)
    rows = np.clip(20.0 - np.arange(25)[:, None] * 2.0, -half, half)
    expected = (rows[:-1] - rows[1:]).reshape(24, 24, 64).mean(-1) / 2
    ours = coverage_at(shape, (20.0, 20.0), size_px=24, px_mm=2.0)[0].numpy()
    assert abs(ours - expected).max() < 5e-3


@given(st.floats(-4, 4), st.floats(-6, 6), st.floats(0.5, 3), st.floats(0.5, 3))
@settings(deadline=None, max_examples=15)
def test_a_swept_disc_covers_the_union_of_its_discs(x1: float, y1: float, start: float, end: float) -> None:
    nodes = torch.tensor([[[-6.0, 0.5], [x1, y1], [6.0, -1.0]]], dtype=torch.float64)
    outline = swept(nodes, *(torch.tensor([v], dtype=torch.float64) for v in (start, end)))
    ours = coverage_at(outline, (8.0, 8.0), size_px=16, px_mm=1.0)[0].numpy()
    t = np.linspace(0, 1, 201)[:, None]
    centre = (1 - t) ** 2 * nodes[0, 0].numpy() + 2 * t * (1 - t) * nodes[0, 1].numpy() + t**2 * nodes[0, 2].numpy()
    radius = 0.5 * (start + (end - start) * t)
    fine = (np.arange(16 * 16) + 0.5) / 16 - 8
    inside = np.zeros((256, 256), bool)
    for (cx, cy), (r,) in zip(centre, radius, strict=True):
        inside |= (fine[None, :] - cx) ** 2 + (-fine[:, None] - cy) ** 2 <= r**2
    sampled = inside.reshape(16, 16, 16, 16).mean((1, 3))
    assert abs(ours - sampled).max() < 0.05
    assert ours.sum() == pytest.approx(sampled.sum(), rel=0.01)


def test_strokes_that_fold_over_are_refused() -> None:
    sharp = torch.tensor([[[-1.0, 0.0], [0.0, 6.0], [1.0, 0.0]]], dtype=torch.float64)
    wide = torch.tensor([4.0], dtype=torch.float64)
    with pytest.raises(DomainError, match="bends are wider"):
        swept(sharp, wide, wide)
    straight = torch.tensor([[[-1.0, 0.0], [0.0, 0.0], [1.0, 0.0]]], dtype=torch.float64)
    with pytest.raises(DomainError, match="faster than the curve runs"):
        swept(straight, 0.1 * wide, 3 * wide)


def test_a_plane_is_found_again_and_needs_three_cells() -> None:
    height, tilt = torch.cartesian_prod(HEIGHTS, torch.tensor([0.0, 10.0], dtype=torch.float64)).unbind(-1)
    plane = fit_plane(height, tilt, {"tip_mm": 0.5 + height * (1.1 - 0.002 * tilt)})
    assert plane.coefficients[0].tolist() == pytest.approx([0.5, 1.1, -0.002])
    assert plane.at(14.0, 5.0)["tip_mm"] == pytest.approx(15.76)
    with pytest.raises(ValueError, match="two depths and two tilts"):
        fit_plane(HEIGHTS, torch.zeros(3, dtype=torch.float64), {"tip_mm": HEIGHTS})


def test_bisection_stops_at_the_root_or_the_end() -> None:
    low, high = torch.zeros(2, dtype=torch.float64), torch.full((2,), 3.0, dtype=torch.float64)
    target = torch.tensor([2.0, 100.0], dtype=torch.float64)
    assert solve(lambda x: x**2, target, low, high).tolist() == pytest.approx([math.sqrt(2), 3.0])


def test_an_ellipse_arc_has_the_area_and_the_extent_of_its_ellipse() -> None:
    # One third of a circle of radius 2 as a conic, closed by its chord.
    a = math.radians(60)
    ends = [2 * math.cos(a), -2 * math.sin(a)], [2 * math.cos(a), 2 * math.sin(a)]
    arc = [ends[0], [2 / math.cos(a), 0.0], ends[1]]
    chord = [ends[1], [2 * math.cos(a), 0.0], ends[0]]
    outline = Outline(
        torch.tensor([[arc, chord]], dtype=torch.float64), torch.tensor([[0.5, 1.0]], dtype=torch.float64)
    )
    assert outline.area_mm2.item() == pytest.approx(0.5 * 4 * (2 * a - math.sin(2 * a)))
    assert outline.x_max_mm.item() == pytest.approx(2.0)
    assert outline.x_min_mm.item() == pytest.approx(1.0)
    assert outline.width_mm.item() == pytest.approx(4 * math.sin(a))
    assert torch.linalg.vector_norm(
        outline.at(torch.linspace(0, 1, 9, dtype=torch.float64))[0, 0], dim=-1
    ).tolist() == (pytest.approx([2.0] * 9))
    with pytest.raises(ValueError, match="per_arc = 0"):
        outline.polyline(0)
