"""The baseline shapes against their formulae."""

import math
from collections.abc import Callable

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from scipy.integrate import quad

from model.baselines import Capsule, Ellipse, circle, ellipse, line
from model.brush import Brush, DomainError
from model.ccdbsm import CcdBsm, ccdbsm
from model.coverage import centred_origin, coverage
from model.registry import stroke_models

GRID_MM = torch.tensor([11.0, 15.0, 20.0], dtype=torch.float64)
MARK = ccdbsm(Brush(), GRID_MM, 5)
STUBBY = ccdbsm(Brush(radius_mm=15, length_mm=40), GRID_MM, 5)  # wider than long


@pytest.mark.parametrize("mark", [MARK, STUBBY])
@pytest.mark.parametrize("make", [ellipse, line])
def test_ellipse_and_line_fill_the_bounding_box_of_the_mark(
    make: Callable[[CcdBsm], Ellipse | Capsule], mark: CcdBsm
) -> None:
    shape = make(mark)
    torch.testing.assert_close(shape.x_min_mm, mark.x_min_mm)
    torch.testing.assert_close(shape.x_max_mm, mark.x_max_mm)
    torch.testing.assert_close(shape.width_mm, mark.width_mm)


def test_the_circle_is_as_wide_as_the_mark_is_long() -> None:
    torch.testing.assert_close(circle(MARK).width_mm, MARK.length_mm)
    torch.testing.assert_close(circle(MARK).x_min_mm, MARK.x_min_mm)


@pytest.mark.parametrize("mark", [MARK, STUBBY])
def test_areas_are_those_of_the_textbook(mark: CcdBsm) -> None:
    length, width = mark.length_mm, mark.width_mm
    short, long = torch.minimum(length, width), torch.maximum(length, width)
    torch.testing.assert_close(ellipse(mark).area_mm2, math.pi / 4 * length * width)
    torch.testing.assert_close(circle(mark).area_mm2, math.pi / 4 * length**2)
    torch.testing.assert_close(line(mark).area_mm2, math.pi / 4 * short**2 + (long - short) * short)


SIZE = st.floats(0.2, 15)


@given(SIZE, SIZE, st.floats(-10, 10), st.floats(0.01, 1))
def test_closed_forms_agree_with_their_own_half_width(length: float, width: float, centre: float, share: float) -> None:
    radius = min(length, width)
    values = [torch.tensor([v], dtype=torch.float64) for v in (centre, radius, length - radius, width - radius)]
    axes = [torch.tensor([v], dtype=torch.float64) for v in (centre, length, width)]
    for shape in (Ellipse(*axes), Capsule(*values)):
        assert shape.x_max_mm.item() - shape.x_min_mm.item() == pytest.approx(2 * length)

        def half_width(x: float, shape: Ellipse | Capsule = shape) -> float:
            return shape.half_width(torch.tensor([[x]], dtype=torch.float64)).item()

        stop = centre + (2 * share - 1) * length
        kinks = [x for x in (centre - length + radius, centre + length - radius) if x < stop]
        expected, _ = quad(half_width, centre - length, stop, points=kinks or None, limit=200)
        area = shape.area_to(torch.tensor([[stop, centre + 2 * length]], dtype=torch.float64))[0]
        assert area[0].item() == pytest.approx(expected, rel=1e-6, abs=1e-6)
        assert 2 * area[1].item() == pytest.approx(shape.area_mm2.item(), rel=1e-12)

        level = share * 0.999 * width
        left, right = shape.level(torch.tensor([[level]], dtype=torch.float64))
        inner = 1e-6 * length
        assert half_width(left.item() + inner) >= level - 1e-9
        assert half_width(right.item() - inner) >= level - 1e-9
        assert half_width(left.item() - inner) <= level + 1e-9
        assert half_width(right.item() + inner) <= level + 1e-9


@pytest.mark.parametrize("name", ["ccd-bsm", "ellipse", "circle", "line"])
def test_every_model_paints_its_area(name: str) -> None:
    model = stroke_models(Brush())[name]
    profile = model.profile(GRID_MM, 5.0)
    painted = coverage(profile, centred_origin(profile)).sum((1, 2)) * 0.2**2
    torch.testing.assert_close(painted, profile.area_mm2, rtol=1e-10, atol=0)


def test_models_share_the_domain_of_the_mark() -> None:
    with pytest.raises(DomainError, match="heading"):
        stroke_models(Brush())["circle"].profile(15, -1)
