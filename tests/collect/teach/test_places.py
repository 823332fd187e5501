"""Well, wash and park: a wipe that can be one, and an arm that can leave the camera's picture."""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from brushloop.collect.errors import CannotTeach
from brushloop.collect.operator import Prompt
from brushloop.collect.photograph.frames import Thumbnail
from brushloop.collect.teach import places
from brushloop.collect.teach.arm import ArmReader
from brushloop.collect.teach.day import Day, Target
from brushloop.collect.teach.places import PlacesStep, check_pot, check_wipe
from brushloop.collect.teach.store import Notebook, taught, touch_of
from brushloop.drivers.devices import Pose
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


class Parking(Person):
    """Brings the arm wherever it is asked for, without a hand; answers no to everything else."""

    async def ask(self, prompt: Prompt, target: Target | None = None) -> Any:
        if target is None:
            self.asked.append(prompt.default)
            return "n"
        return True


@pytest.fixture
def parked(server: ArcsServer, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[..., Day]:
    """Well and rim are touched; the arm is brought to a place, then parked, and a picture is taken with it at each."""

    def make(away_mm: Place, away: Thumbnail, parked: Thumbnail) -> Day:
        day, poses, pictures = (
            day_of(Parking(), tmp_path, server.port, tip_mm=(0.0, 0.0, 0.0)),
            [away_mm, PARK_MM],
            [away, parked],
        )
        for field in ("aside.wipe", "aside.wash"):
            day.keep("places", field, False, "answered")
        for name, place in {"well-rim 0": RIM, "well 0": WELL}.items():
            day.save(day.notebook.with_touch(name, touch_of(brush_pose(*place))))

        async def flange(_: ArmReader) -> Pose:
            return brush_pose(*poses.pop(0))

        async def still(*_: object) -> Thumbnail:
            return pictures.pop(0)

        monkeypatch.setattr(ArmReader, "flange", flange)
        monkeypatch.setattr(places, "still", still)
        monkeypatch.setattr(places, "taught_camera", lambda *_: contextlib.nullcontext())
        monkeypatch.setattr(places, "shown_live", lambda *_: contextlib.nullcontext())
        return day

    return make


async def test_two_pictures_that_agree_show_the_arm_in_neither(parked: Callable[..., Day]) -> None:
    """The light may change in between."""
    day = parked(AWAY_MM, picture(arm=False), picture(arm=False, light=0.9))
    await PlacesStep().teach(day)
    assert {"park 0", "clear-view 0"} <= set(day.notebook.touches)


@pytest.mark.parametrize(
    ("away_mm", "in_the_first", "said"),
    [
        (WELL, False, r"in one of the two pictures: 5 % .* both places are asked again"),
        ((*PARK_MM[:2], 300.0), True, r"only 40 mm apart.*150 mm or more apart"),
    ],
    ids=["an arm over the pot", "twice one place"],
)
async def test_pictures_that_say_nothing_are_taken_again_at_both_places(
    parked: Callable[..., Day], away_mm: Place, in_the_first: bool, said: str
) -> None:
    day = parked(away_mm, picture(arm=in_the_first), picture(arm=True))
    with pytest.raises(CannotTeach, match=said):
        await PlacesStep().teach(day)
    assert not {"park 0", "clear-view 0"} & set(day.notebook.touches)
    assert "well 0" in day.notebook.touches


@pytest.mark.parametrize("field", ["aside.wipe", "aside.wash"])
async def test_wipe_and_pot_are_not_left_out_by_an_empty_answer(parked: Callable[..., Day], field: str) -> None:
    day = parked(AWAY_MM, picture(arm=False), picture(arm=False))
    day.save(day.notebook.without(field))
    await PlacesStep().teach(day)
    assert isinstance(day.guide, Parking)
    assert day.guide.asked == [""]
