"""Going back, teaching a step again, leaving off: what was answered before is as it was."""

from __future__ import annotations

import re
from pathlib import Path
from types import SimpleNamespace
from unittest.mock import AsyncMock

import pytest

from brushloop.collect.commission.arm import ASK_ADDRESS
from brushloop.collect.commission.brush import ASK_BUS, ASK_PORT, RADIUS, BrushStep, ForceStep, ask_depth, ask_length
from brushloop.collect.commission.camera import ASK_SQUARES
from brushloop.collect.commission.visit import Taught, Visit
from brushloop.collect.commission.wizard import Wizard
from brushloop.collect.errors import CollectAborted
from brushloop.collect.operator import Prompt
from brushloop.drivers.errors import DeviceTimeout
from brushloop.drivers.ink.station import InkStationConfig
from tests.collect.commission.conftest import BACK, Answering, Person

HOW, GIVE, LINE = "How do you want to go on?", "Give 0.5 ml", "Its serial line"
R, L, DEEPEST, NAME = "R", "L", "Deepest press that this brush can take; 45% of L is cautious", "Name of the brush"
WELL, INK, CAN = "What keeps the ink well filled?", "Name of the ink", "CAN bus of the force sensor"


async def led(person: Answering, folder: Path) -> Visit:
    """The tip is known; the person is led through brush and force."""
    visit = person.visit(folder / "rig.toml")
    visit.keep({"robot.tcp_offset_mm": Taught([0.0, 0.0, 180.0], "measured")})
    with pytest.raises(CollectAborted):
        await Wizard(visit, (BrushStep(), ForceStep())).run()
    return visit


@pytest.fixture
def station(monkeypatch: pytest.MonkeyPatch) -> AsyncMock:
    """The ink station that is connected to, whatever line is named."""
    station = AsyncMock()
    station.connect.return_value = SimpleNamespace(model="station", firmware="1")
    station.level.return_value = None
    monkeypatch.setattr(InkStationConfig, "device", lambda *_: station)
    return station


@pytest.mark.parametrize(
    ("answers", "asked"),
    [
        (("6", "48", BACK, "47", "20", "", BACK, "wolf"), [R, L, DEEPEST, L, DEEPEST, NAME, WELL, NAME, WELL]),
        (
            ("6", "48", "20", "", "n", "", *[BACK] * 6),
            [R, L, DEEPEST, NAME, WELL, INK, CAN, INK, WELL, NAME, DEEPEST, L, R],
        ),
        (
            ("6", "48", "20", "", "i", "/dev/ttyUSB0", "y", "y", "n", BACK),
            [R, L, DEEPEST, NAME, WELL, LINE, GIVE, GIVE, GIVE, INK, GIVE],
        ),
    ],
    ids=["one question", "into the step before", "no dose again"],
)
async def test_back_asks_the_question_before_and_no_other(
    answers: tuple[str, ...], asked: list[str], tmp_path: Path, station: AsyncMock
) -> None:
    person = Answering(*answers)
    visit = await led(person, tmp_path)
    assert person.asked == asked
    assert station.dose.await_count == answers.count("y")
    if asked[-1] == R:
        assert not any(field.startswith("brush.") for field in visit.notebook.values)


@pytest.mark.parametrize(
    ("after", "asked"),
    [
        (("a", "n"), [GIVE, INK]),
        ((BACK, "/dev/ttyUSB1", "n"), [LINE, GIVE, INK]),
        (("f", "5"), [R, L]),
        (("f", BACK, "n"), [R, GIVE, INK]),
    ],
    ids=["again", "the question before", "the step afresh", "not afresh after all"],
)
async def test_a_step_that_was_refused_goes_on_where_the_person_wants(
    after: tuple[str, ...], asked: list[str], tmp_path: Path, station: AsyncMock
) -> None:
    silent = DeviceTimeout("robot", "connect", "no reply in 1 s", condition="A stop was sent to the arm.")
    silent.add_note("The arm may still be moving.")
    station.connect.side_effect = [silent, station.connect.return_value]
    person = Answering("6", "48", "20", "", "i", "/dev/ttyUSB0", *after)
    await led(person, tmp_path)
    assert person.asked == [R, L, DEEPEST, NAME, WELL, LINE, HOW, *asked]
    assert re.fullmatch(r"(?s)robot: connect: .* A stop was sent .* still be moving\.\nCheck power.*", person.trouble)


@pytest.mark.parametrize(
    ("asked", "line", "said"),
    [
        (ask_length([0.0, 0.0, 180.0]), "190", r"190 mm cannot be \(5 to 180 mm\)"),
        (ask_depth(48.0), "30", r"30 mm cannot be \(0\.5 to 28\.8 mm\)"),
        (RADIUS, "nan", "is not a number"),
        (RADIUS, "0,1", r"0\.1 is outside 0\.5 to 50 mm"),
        (ASK_PORT, "", "no serial line was named"),
        (ASK_BUS, "host:bus", "Port could not be cast to integer value as 'bus'"),
        (ASK_SQUARES, "26", "is not two numbers of squares like 26x20"),
        (ASK_ADDRESS, "192.0.2.7:65536", "Port out of range"),
        (ASK_ADDRESS, "192.0.2.7:x", "Port could not be cast to integer value as 'x'"),
        (ASK_ADDRESS, "the cabinet", "is not an address like 192.0.2.7"),
    ],
)
def test_a_line_that_cannot_be_the_value_is_refused_where_it_is_typed(asked: Prompt, line: str, said: str) -> None:
    assert asked.read is not None
    with pytest.raises(ValueError, match=said):
        asked.read(line)


async def test_a_step_that_is_taught_again_by_mistake_is_as_it_was_after_back(tmp_path: Path) -> None:
    await led(Answering("6", "48", "20", "", "n", ""), tmp_path)
    again = Answering(BACK)
    visit = again.visit(tmp_path / "rig.toml")
    before = visit.notebook
    await Wizard(visit, (BrushStep(), ForceStep())).again("brush")
    assert again.asked == [R]
    assert visit.notebook == before


async def test_a_step_is_taught_again_only_where_all_before_it_are_done(tmp_path: Path) -> None:
    person = Person()
    with pytest.raises(CollectAborted, match="`force` depends on brush, which is not taught yet"):
        await Wizard(person.visit(tmp_path / "rig.toml"), (BrushStep(), ForceStep())).again("force")
    assert not person.asked
