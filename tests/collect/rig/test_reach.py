"""The arm's reach from its dimensions, held against the solver of the loopback controller's kinematics."""

from __future__ import annotations

import math

import numpy as np
import pytest

from collect.rig.reach import reach_left_mm, upright_ring
from drivers.geometry import brush_pose
from drivers.samples import Pose
from drivers.sim.arm.kinematics import HOME, inverse, inverted, matrix_of

TOOL = Pose(5.0, -3.0, 180.0, *brush_pose(0.0, 0.0, 0.0, tilt_deg=177.0).quaternion)
"""A brush that leans 3 deg from the flange's axis."""


def reached(tip: Pose) -> bool:
    return inverse(matrix_of(tip) @ inverted(matrix_of(TOOL)), HOME) is not None


def test_what_the_controller_reaches_is_within_the_reach() -> None:
    draw = np.random.default_rng(5)
    tips = [
        brush_pose(*draw.uniform(-650.0, 650.0, 2), draw.uniform(50.0, 400.0), tilt_deg=draw.uniform(0.0, 20.0))
        for _ in range(24)
    ]
    reach = [reach_left_mm(tip, TOOL) for tip in tips if reached(tip)]
    assert len(reach) > 12
    assert min(reach) >= 0.0


@pytest.mark.parametrize("z_mm", [60.0, 260.0])
def test_the_ring_of_the_upright_tip_ends_where_the_controller_finds_no_joints(z_mm: float) -> None:
    ring = upright_ring(z_mm, 30.0, TOOL)
    assert ring is not None
    for heading in (-1.2, 0.0, 0.7):
        inside, outside = (
            brush_pose(
                ring.centre_mm[0] + (ring.most_mm + more) * math.cos(heading),
                ring.centre_mm[1] + (ring.most_mm + more) * math.sin(heading),
                z_mm,
                heading_deg=30.0,
            )
            for more in (-8.0, 8.0)
        )
        assert reached(inside)
        assert not reached(outside)


def test_nothing_is_reached_far_above_the_arm() -> None:
    assert upright_ring(1200.0, 0.0, TOOL) is None
