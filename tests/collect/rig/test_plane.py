"""The plane of the paper: fitted through touches, and the poses above and below it."""

from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from brushloop.collect.errors import StepError
from brushloop.collect.rig.config import PaperConfig
from brushloop.collect.rig.paper import PaperPlane, fit_plane, to_base, to_paper
from brushloop.drivers.geometry import distance, lean

CORNERS = [(5.0, 5.0), (235.0, 5.0), (5.0, 165.0), (235.0, 165.0)]
slopes = st.floats(-0.017, 0.017)  # 1 deg


def paper(yaw_deg: float = 90.0) -> PaperConfig:
    return PaperConfig(origin_mm=(460.0, -110.0), yaw_deg=yaw_deg, touch_z_mm=120.0, size_mm=(244.0, 172.0))


def touches(plane: PaperPlane, at: list[tuple[float, float]]) -> list[tuple[float, float, float]]:
    return [(x, y, plane.touch_z_mm(x, y)) for x, y in at]


@given(z0_mm=st.floats(50.0, 200.0), slope_x=slopes, slope_y=slopes)
def test_three_points_give_their_plane(z0_mm: float, slope_x: float, slope_y: float) -> None:
    plane = PaperPlane(z0_mm, slope_x, slope_y)
    fitted, residuals_mm = fit_plane(touches(plane, CORNERS[:3]))
    for x, y in CORNERS:
        assert fitted.touch_z_mm(x, y) == pytest.approx(plane.touch_z_mm(x, y), abs=1e-9)
    assert residuals_mm == pytest.approx((0.0, 0.0, 0.0), abs=1e-9)


def test_the_fourth_point_leaves_residuals_that_show_a_bump() -> None:
    points = touches(PaperPlane(120.0, 0.01, -0.005), CORNERS)
    x, y, z = points[3]
    _plane, residuals_mm = fit_plane([*points[:3], (x, y, z + 0.4)])
    assert residuals_mm == pytest.approx((0.1, -0.1, -0.1, 0.1))


def test_one_or_two_points_give_a_level_sheet() -> None:
    assert fit_plane([(5.0, 5.0, 120.1)]) == (PaperPlane(120.1), (0.0,))
    plane, residuals_mm = fit_plane([(5.0, 5.0, 120.0), (205.0, 5.0, 120.4)])
    assert plane == PaperPlane(120.2)
    assert residuals_mm == pytest.approx((-0.2, 0.2))


STEEP = touches(PaperPlane(120.0, math.tan(math.radians(5.0))), CORNERS[:3])


@pytest.mark.parametrize(
    ("points_mm", "why"),
    [
        ([(5.0, 5.0, 120.0), (120.0, 10.0, 120.0), (235.0, 5.0, 120.0)], "of a line"),
        (STEEP, r"lean by 5\.0 deg"),
    ],
)
def test_points_on_a_line_or_on_no_sheet_give_no_plane(points_mm: list[tuple[float, float, float]], why: str) -> None:
    with pytest.raises(StepError, match=why):
        fit_plane(points_mm)


@given(yaw_deg=st.floats(-180.0, 180.0), x_mm=st.floats(0.0, 244.0), y_mm=st.floats(0.0, 172.0))
def test_paper_and_base_frame_are_each_others_inverse(yaw_deg: float, x_mm: float, y_mm: float) -> None:
    assert to_paper(paper(yaw_deg), *to_base(paper(yaw_deg), x_mm, y_mm)) == pytest.approx((x_mm, y_mm), abs=1e-9)


@given(slope_x=slopes, slope_y=slopes, above_mm=st.floats(-20.0, 20.0), yaw_deg=st.floats(-180.0, 180.0))
def test_a_pose_lies_its_distance_along_the_normal_and_leans_with_the_sheet(
    slope_x: float, slope_y: float, above_mm: float, yaw_deg: float
) -> None:
    plane, at = PaperPlane(120.0, slope_x, slope_y), paper(yaw_deg)
    touch, pose = plane.pose(at, 80.0, 60.0, 0.0), plane.pose(at, 80.0, 60.0, above_mm)
    moved_mm, turned_deg = distance(touch, pose)
    assert moved_mm == pytest.approx(abs(above_mm), abs=1e-9)
    assert turned_deg == pytest.approx(0.0, abs=1e-5)
    assert plane.above_mm(at, pose) == pytest.approx(above_mm, abs=1e-9)
    # upright on the paper is a lean by the paper's slope in the base frame
    assert lean(pose)[0] == pytest.approx(plane.slope_deg, abs=1e-5)


@given(slope_x=slopes, slope_y=slopes, tilt_deg=st.floats(0.0, 15.0), turn_deg=st.floats(-180.0, 180.0))
def test_tilt_is_counted_from_the_normal(slope_x: float, slope_y: float, tilt_deg: float, turn_deg: float) -> None:
    plane = PaperPlane(120.0, slope_x, slope_y)
    upright = plane.pose(paper(), 80.0, 60.0, -5.0, turn_deg=turn_deg)
    tilted = plane.pose(paper(), 80.0, 60.0, -5.0, tilt_deg=tilt_deg, turn_deg=turn_deg)
    assert distance(upright, tilted)[1] == pytest.approx(tilt_deg, abs=1e-5)
    assert upright.position_mm == tilted.position_mm
