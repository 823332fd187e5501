"""Two pictures show that the arm can leave the camera's picture; one alone is never believed."""

from __future__ import annotations

from collections.abc import AsyncIterator
from pathlib import Path

import numpy as np
import pytest

from brushloop.collect.errors import CannotTeach
from brushloop.collect.operator import Choice
from brushloop.collect.photograph.frames import Thumbnail
from brushloop.collect.teach.day import Day
from brushloop.collect.teach.guide import Shown
from brushloop.collect.teach.steps.places import VIEW, PlacesStep, text_of
from brushloop.collect.teach.store import touch_of
from brushloop.drivers.geometry import brush_pose
from brushloop.drivers.host import HostClock
from brushloop.drivers.sim.arcs.server import ArcsServer
from brushloop.drivers.sim.config import SimConfig
from brushloop.drivers.sim.world import World

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
        async def choose(self, question: str, choices: tuple[Choice, ...], default: str) -> str:
            defaults.append(default)
            return "n"

    day = day_of(server.port, tmp_path, AWAY_MM, picture(arm=False), picture(arm=False))
    day.save(day.notebook.without(field))
    await PlacesStep().teach(Day(Asked(), tmp_path / "rig.toml", HostClock(), armed=False))  # type: ignore[arg-type]
    assert defaults == [""]


async def test_a_place_without_its_picture_is_asked_for_again(server: ArcsServer, tmp_path: Path) -> None:
    class Asked(Exception):
        pass

    class Leaving(Watching):
        async def bring(self, *_: object) -> None:
            raise Asked

    day = day_of(server.port, tmp_path, AWAY_MM, picture(arm=False), picture(arm=False))
    day.save(day.notebook.without(VIEW["park"]))
    resumed = Day(Leaving(), tmp_path / "rig.toml", HostClock(), armed=False)  # type: ignore[arg-type]
    with pytest.raises(Asked):
        await PlacesStep().teach(resumed)
    assert "park 0" in resumed.notebook.touches, "kept until it is taught again"
