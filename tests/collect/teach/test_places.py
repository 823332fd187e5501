"""Well, wash and park: a wipe that can be one, and an arm that can leave the camera's picture."""

from __future__ import annotations

from collections.abc import AsyncIterator
from pathlib import Path

import numpy as np
import pytest

from brushloop.collect.errors import CannotTeach
from brushloop.collect.photograph.frames import Thumbnail
from brushloop.collect.teach.day import Day
from brushloop.collect.teach.guide import Question, Shown
from brushloop.collect.teach.places import VIEW, PlacesStep, check_pot, check_wipe, text_of
from brushloop.collect.teach.store import Notebook, Taught, now_utc, touch_of
from brushloop.drivers.geometry import brush_pose
from brushloop.drivers.host import HostClock
from brushloop.drivers.sim.arcs.server import ArcsServer
from brushloop.drivers.sim.config import SimConfig
from brushloop.drivers.sim.world import World

WELL = (300.0, 40.0, 121.0)


def taught_rim(rim: tuple[float, float, float]) -> Notebook:
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
    notebook = taught_rim((316.0, 40.0, 133.0))
    check_wipe(notebook)
    found = PlacesStep().derived(notebook)
    assert found["ink.wipe.rim_mm"].value == pytest.approx([322.0, 40.0])
    assert found["ink.wipe.z_mm"].value == pytest.approx(131.5)
    assert "touched there by hand" in found["ink.wipe.rim_mm"].how
    safe_mm = found["motion.safe_z_mm"].value
    assert isinstance(safe_mm, float)
    assert safe_mm >= 133.0 + 15.0


def test_without_a_second_touch_of_the_rim_there_is_no_wipe() -> None:
    notebook = taught_rim((316.0, 40.0, 133.0))
    touches = {name: touch for name, touch in notebook.touches.items() if name != "well-rim 1"}
    found = PlacesStep().derived(notebook.model_copy(update={"touches": touches}))
    assert not any(field.startswith("ink.wipe") for field in found)


def test_the_arm_travels_above_the_rim_of_the_pot_of_water_too() -> None:
    notebook, safe_mm = taught_rim((316.0, 40.0, 133.0)), []
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
        check_wipe(taught_rim(rim))
    assert "only this place is asked again" in refused.value.way_out


PARK_MM, AWAY_MM, POT_MM = (250.0, -230.0, 260.0), (420.0, -260.0, 260.0), (300.0, 40.0, 121.0)


class Watching:
    """A person who is asked nothing."""

    async def show(self, what: Shown) -> None:
        pass


@pytest.fixture
async def server() -> AsyncIterator[ArcsServer]:
    server = ArcsServer(World(SimConfig()))
    await server.start("127.0.0.1", 0)
    yield server
    await server.stop()


def picture(*, arm: bool, light: float = 1.0) -> Thumbnail:
    scene = np.full((120, 160), 200.0 * light, np.float32)
    if arm:
        scene[40:70, 60:90] = 60.0
    return scene


def day_of(port: int, folder: Path, away_mm: tuple[float, float, float], parked: Thumbnail, away: Thumbnail) -> Day:
    """Everything of the step is taught, and the two pictures are taken."""
    day = Day(Watching(), folder / "rig.toml", HostClock(), armed=False)  # type: ignore[arg-type]
    for name, value in (("host", "127.0.0.1"), ("port", port), ("framing", "sof")):
        day.keep("arm", f"robot.{name}", value, "typed")
    day.keep("tip", "robot.tcp_offset_mm", [0.0, 0.0, 0.0], "typed", unit="mm")
    for field in ("aside.wipe", "aside.wash"):
        day.keep("places", field, False, "answered")
    day.keep("places", VIEW["park"], text_of(parked), "a picture")
    day.keep("places", VIEW["clear-view"], text_of(away), "a picture")
    places = {"well-rim 0": (300.0, 56.0, 132.0), "well 0": POT_MM, "park 0": PARK_MM, "clear-view 0": away_mm}
    for name, place in places.items():
        day.save(day.notebook.with_touch(name, touch_of(brush_pose(*place))))
    return day


async def test_two_pictures_that_agree_show_the_arm_in_neither(server: ArcsServer, tmp_path: Path) -> None:
    """The light may change in between."""
    day = day_of(server.port, tmp_path, AWAY_MM, picture(arm=False), picture(arm=False, light=0.9))
    await PlacesStep().teach(day)


async def test_an_arm_over_the_pot_is_named_and_both_places_are_asked_for_again(
    server: ArcsServer, tmp_path: Path
) -> None:
    day = day_of(server.port, tmp_path, POT_MM, picture(arm=False), picture(arm=True))
    with pytest.raises(CannotTeach, match=r"in one of the two pictures: 5 % .* both places are asked again"):
        await PlacesStep().teach(day)
    assert not {"park 0", "clear-view 0"} & set(day.notebook.touches)
    assert not set(VIEW.values()) & set(day.notebook.values)
    assert "well 0" in day.notebook.touches


async def test_two_pictures_from_one_place_show_nothing(server: ArcsServer, tmp_path: Path) -> None:
    day = day_of(server.port, tmp_path, (*PARK_MM[:2], 300.0), picture(arm=True), picture(arm=True))
    with pytest.raises(CannotTeach, match=r"only 40 mm apart.*150 mm or more apart"):
        await PlacesStep().teach(day)
    assert not {"park 0", "clear-view 0"} & set(day.notebook.touches)


@pytest.mark.parametrize("field", ["aside.wipe", "aside.wash"])
async def test_wipe_and_pot_are_not_left_out_by_an_empty_answer(server: ArcsServer, tmp_path: Path, field: str) -> None:
    defaults: list[str] = []

    class Asked(Watching):
        async def ask(self, question: Question) -> str:
            defaults.append(question.default)
            return "n"

    day = day_of(server.port, tmp_path, AWAY_MM, picture(arm=False), picture(arm=False))
    day.save(day.notebook.without(field))
    await PlacesStep().teach(Day(Asked(), tmp_path / "rig.toml", HostClock(), armed=False))  # type: ignore[arg-type]
    assert defaults == [""]
