"""Which patches zero touch uses up."""

from __future__ import annotations

from typing import Any

import pytest

from brushloop.collect.rig.config import PaperConfig
from brushloop.collect.rig.config_touch import TouchConfig
from brushloop.collect.rig.paper import Sheet
from brushloop.collect.touch.places import used_patches

PAPER = PaperConfig(origin_mm=(0.0, 0.0), touch_z_mm=120.0, size_mm=(244.0, 172.0), touch_point_mm=(2.0, 2.0))
SHEET = Sheet(PAPER)


def used(**config: Any) -> set[int]:
    return used_patches(SHEET, PAPER, TouchConfig(**config))


def test_the_taught_height_and_touches_in_the_margin_cost_no_cell() -> None:
    assert used() == set()
    assert used(method="force") == set()
    assert used(method="force", points_mm=[(2.0, 2.0), (242.0, 2.0), (122.0, 170.0)]) == set()


def test_a_touch_in_the_middle_of_a_cell_costs_it() -> None:
    patch = SHEET.patch(8)
    assert used(method="jog", points_mm=[patch.anchor_mm]) == {8}


def test_a_patch_costs_every_cell_that_it_may_reach() -> None:
    corner = SHEET.patch(36)
    patches = used(method="camera", points_mm=[(corner.x_mm + 4.0, corner.y_mm + 9.0), (124.0, 6.0), (6.0, 100.0)])
    assert 36 in patches
    assert 30 in patches, "it grows into the patch above"
    assert len(patches) < SHEET.capacity / 3


def test_a_point_beside_the_sheet_is_refused() -> None:
    with pytest.raises(ValueError, match=r"touch.points_mm: \[250, 4\]"):
        TouchConfig(method="force", points_mm=[(4.0, 4.0), (250.0, 4.0)]).check_points(PAPER.size_mm)
