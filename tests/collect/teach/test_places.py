"""Well, wash and park: a wipe that can be one, and an arm that can leave the camera's picture."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from brushloop.collect.errors import CannotTeach
from brushloop.collect.operator import Prompt
from brushloop.collect.photograph.frames import Thumbnail
from brushloop.collect.teach.day import Day, Target
from brushloop.collect.teach.places import VIEW, PlacesStep, check_pot, check_wipe, text_of
from brushloop.collect.teach.store import Notebook, taught, touch_of
from brushloop.drivers.geometry import brush_pose
from brushloop.drivers.sim.arcs_server import ArcsServer
from tests.collect.teach.conftest import Person, day_of

Place = tuple[float, float, float]
WELL, RIM, SIDE = (300.0, 40.0, 121.0), (300.0, 56.0, 132.0), (316.0, 40.0, 133.0)
PARK_MM, AWAY_MM = (250.0, -230.0, 260.0), (420.0, -260.0, 260.0)
SHEET = {
    "robot.tcp_offset_mm": [0.0, 0.0, 0.0],
    "paper.origin_mm": [0.0, 0.0],
    "paper.yaw_deg": 0.0,
    "paper.size_mm": [240.0, 160.0],
    "paper.touch_z_mm": 120.0,
    "paper.touch_point_mm": [4.0, 4.0],
    "aside.plane": [120.0, 0.0, 0.0],
}


def touched(**places: Place) -> Notebook:
    """A well right of a level sheet of 240 x 160 mm at the origin of the base frame, and what was touched there."""
    notebook = Notebook().with_values({field: taught("tip", value, "typed") for field, value in SHEET.items()})
    for name, place in {"well_0": WELL, "well-rim_0": RIM, "park_0": (200.0, -300.0, 300.0), **places}.items():
        notebook = notebook.with_touch(name.replace("_", " "), touch_of(brush_pose(*place)))
    return notebook


def test_a_wipe_goes_from_the_well_over_the_touched_rim_a_little_below_it() -> None:
    notebook = touched(**{"well-rim_1": SIDE})
    check_wipe(notebook)
    values = PlacesStep().derived(notebook)
    assert values["ink.wipe.rim_mm"].value == pytest.approx([322.0, 40.0])
    assert values["ink.wipe.z_mm"].value == pytest.approx(131.5)
    assert not any(field.startswith("ink.wipe") for field in PlacesStep().derived(touched()))


def test_the_arm_travels_above_the_rim_of_the_pot_of_water_too() -> None:
    for rim_z_mm, safe_mm in ((150.0, 180.0), (210.0, 230.0)):  # 60 mm above the sheet, 20 mm above the highest rim
        pot = {"wash-rim_0": (120.0, 216.0, rim_z_mm), "wash-pot_0": (120.0, 200.0, 125.0)}
        assert "of radius 16 mm" in check_pot(touched(**pot), "wash-rim 0", "wash-pot 0", "pot of water")
        values = PlacesStep().derived(touched(**pot))
        assert (values["ink.wash.dip_z_mm"].value, values["motion.safe_z_mm"].value) == pytest.approx((125.0, safe_mm))
    drowned = touched(**pot | {"wash-pot_0": (120.0, 200.0, 220.0)})
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
def test_a_wipe_that_cannot_be_one_is_refused_with_the_way_out(rim: Place, said: str) -> None:
    with pytest.raises(CannotTeach, match=f"{said}.*only this place is asked again"):
        check_wipe(touched(**{"well-rim_1": rim}))


def picture(*, arm: bool, light: float = 1.0) -> Thumbnail:
    scene = np.full((120, 160), 200.0 * light, np.float32)
    if arm:
        scene[40:70, 60:90] = 60.0
    return scene


def ready(port: int, folder: Path, away_mm: Place, parked: Thumbnail, away: Thumbnail, person: Person) -> Day:
    """Everything of the step is taught, and the two pictures are taken."""
    day = day_of(person, folder, port, tip_mm=(0.0, 0.0, 0.0))
    for field in ("aside.wipe", "aside.wash"):
        day.keep("places", field, False, "answered")
    day.keep("places", VIEW["park"], text_of(parked), "a picture")
    day.keep("places", VIEW["clear-view"], text_of(away), "a picture")
    for name, place in {"well-rim 0": RIM, "well 0": WELL, "park 0": PARK_MM, "clear-view 0": away_mm}.items():
        day.save(day.notebook.with_touch(name, touch_of(brush_pose(*place))))
    return day


async def test_two_pictures_that_agree_show_the_arm_in_neither(server: ArcsServer, tmp_path: Path) -> None:
    """The light may change in between."""
    pictures = picture(arm=False), picture(arm=False, light=0.9)
    await PlacesStep().teach(ready(server.port, tmp_path, AWAY_MM, *pictures, Person()))


@pytest.mark.parametrize(
    ("away_mm", "in_the_first", "said"),
    [
        (WELL, False, r"in one of the two pictures: 5 % .* both places are asked again"),
        ((*PARK_MM[:2], 300.0), True, r"only 40 mm apart.*150 mm or more apart"),
    ],
    ids=["an arm over the pot", "twice one place"],
)
async def test_pictures_that_say_nothing_are_taken_again_at_both_places(
    server: ArcsServer, tmp_path: Path, away_mm: Place, in_the_first: bool, said: str
) -> None:
    pictures = picture(arm=in_the_first), picture(arm=True)
    day = ready(server.port, tmp_path, away_mm, *pictures, Person())
    with pytest.raises(CannotTeach, match=said):
        await PlacesStep().teach(day)
    assert not {"park 0", "clear-view 0"} & set(day.notebook.touches)
    assert not set(VIEW.values()) & set(day.notebook.values)
    assert "well 0" in day.notebook.touches


@pytest.mark.parametrize("field", ["aside.wipe", "aside.wash"])
async def test_wipe_and_pot_are_not_left_out_by_an_empty_answer(server: ArcsServer, tmp_path: Path, field: str) -> None:
    defaults: list[str] = []

    class Declining(Person):
        async def ask(self, prompt: Prompt, target: Target | None = None) -> Any:
            defaults.append(prompt.default)
            return "n"

    day = ready(server.port, tmp_path, AWAY_MM, picture(arm=False), picture(arm=False), Declining())
    day.save(day.notebook.without(field))
    await PlacesStep().teach(day)
    assert defaults == [""]
