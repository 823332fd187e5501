"""The wipe at the well's rim: taught by going there, and refused where it cannot be one."""

from __future__ import annotations

import pytest

from brushloop.collect.errors import CannotTeach
from brushloop.collect.teach.steps.places import PlacesStep, check_pot, check_wipe
from brushloop.collect.teach.store import Notebook, Taught, now_utc, touch_of
from brushloop.drivers.geometry import brush_pose

WELL = (300.0, 40.0, 121.0)


def taught(rim: tuple[float, float, float]) -> Notebook:
    """A well right of a level sheet of 240 x 160 mm at the origin of the base frame, and a side of its rim."""
    values = {
        "robot.tcp_offset_mm": [0.0, 0.0, 0.0],
        "paper.origin_mm": [0.0, 0.0],
        "paper.yaw_deg": 0.0,
        "paper.size_mm": [240.0, 160.0],
        "paper.touch_z_mm": 120.0,
        "paper.touch_point_mm": [4.0, 4.0],
        "aside.plane": [120.0, 0.0, 0.0],
    }
    notebook = Notebook().with_values(
        {k: Taught(value=v, how="typed", at=now_utc(), step="tip") for k, v in values.items()}
    )
    touched = {"well 0": WELL, "well-rim 0": (300.0, 56.0, 132.0), "well-rim 1": rim, "park 0": (200.0, -300.0, 300.0)}
    for name, place in touched.items():
        notebook = notebook.with_touch(name, touch_of(brush_pose(*place)))
    return notebook


def test_a_wipe_goes_from_the_well_over_the_touched_rim_a_little_below_it() -> None:
    notebook = taught((316.0, 40.0, 133.0))
    check_wipe(notebook)
    found = PlacesStep().derived(notebook)
    assert found["ink.wipe.rim_mm"].value == pytest.approx([322.0, 40.0])
    assert found["ink.wipe.z_mm"].value == pytest.approx(131.5)
    assert "touched there by hand" in found["ink.wipe.rim_mm"].how
    safe_mm = found["motion.safe_z_mm"].value
    assert isinstance(safe_mm, float)
    assert safe_mm >= 133.0 + 15.0


def test_without_a_second_touch_of_the_rim_there_is_no_wipe() -> None:
    notebook = taught((316.0, 40.0, 133.0))
    touches = {name: touch for name, touch in notebook.touches.items() if name != "well-rim 1"}
    found = PlacesStep().derived(notebook.model_copy(update={"touches": touches}))
    assert not any(field.startswith("ink.wipe") for field in found)


def test_the_arm_travels_above_the_rim_of_the_pot_of_water_too() -> None:
    notebook, safe_mm = taught((316.0, 40.0, 133.0)), []
    for rim_z_mm in (150.0, 210.0):
        for name, place in {"wash-rim 0": (120.0, 216.0, rim_z_mm), "wash-pot 0": (120.0, 200.0, 125.0)}.items():
            notebook = notebook.with_touch(name, touch_of(brush_pose(*place)))
        assert check_pot(notebook, "wash-rim 0", "wash-pot 0", "pot of water").startswith(
            "pot of water of radius 16 mm"
        )
        found = PlacesStep().derived(notebook)
        assert found["ink.wash.dip_z_mm"].value == pytest.approx(125.0)
        safe_mm.append(found["motion.safe_z_mm"].value)
    assert safe_mm == pytest.approx([180.0, 230.0]), "60 mm above the sheet, 20 mm above the highest rim"
    drowned = notebook.with_touch("wash-pot 0", touch_of(brush_pose(120.0, 200.0, 220.0)))
    with pytest.raises(CannotTeach, match="no deeper than the rim of the pot of water"):
        check_pot(drowned, "wash-rim 0", "wash-pot 0", "pot of water")


@pytest.mark.parametrize(
    ("rim", "said"),
    [
        ((236.0, 40.0, 133.0), "would end over the sheet"),
        ((420.0, 40.0, 133.0), "120 mm from the middle of the well"),
        ((316.0, 40.0, 121.0), "no rim can be there"),
    ],
)
def test_a_wipe_that_cannot_be_one_is_refused_with_the_way_out(rim: tuple[float, float, float], said: str) -> None:
    with pytest.raises(CannotTeach, match=said) as refused:
        check_wipe(taught(rim))
    assert "only this place is asked again" in refused.value.way_out
