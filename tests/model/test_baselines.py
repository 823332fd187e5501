"""The baseline shapes against their formulae."""

import math
from collections.abc import Callable

import pytest
import torch

from brushloop.model.baselines import Capsule, Ellipse, circle, ellipse, line
from brushloop.model.brush import Brush, DomainError
from brushloop.model.ccdbsm import CcdBsm, ccdbsm
from brushloop.model.raster.exact import coverage_at
from brushloop.model.raster.frame import centred_origin
from brushloop.model.strokes import stroke_models

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


@pytest.mark.parametrize("name", ["ccd-bsm", "ellipse", "circle", "line"])
def test_every_model_paints_its_area(name: str) -> None:
    model = stroke_models(Brush())[name]
    profile = model.profile(GRID_MM, 5.0)
    painted = coverage_at(profile, centred_origin(profile)).sum((1, 2)) * 0.2**2
    torch.testing.assert_close(painted, profile.area_mm2, rtol=1e-6, atol=0)


def test_models_share_the_domain_of_the_mark() -> None:
    with pytest.raises(DomainError, match="heading"):
        stroke_models(Brush())["circle"].profile(15, -1)
