"""Going back, teaching a step again, leaving off: what was answered before is as it was."""

from __future__ import annotations

from pathlib import Path

import pytest

from brushloop.collect.errors import CollectAborted
from brushloop.collect.teach.brush import BrushStep, ForceStep
from brushloop.collect.teach.camera import CameraStep
from brushloop.collect.teach.day import Day
from brushloop.collect.teach.guide import Answer, LeftOff, Question, WentBack
from brushloop.collect.teach.store import Notebook, TaughtFile, taught
from brushloop.collect.teach.wizard import Wizard
from brushloop.drivers.errors import DeviceTimeout
from brushloop.drivers.host import HostClock
from brushloop.drivers.ink.station import InkStationConfig
from tests.collect.teach.conftest import Person, day_of

BACK, HOW, GIVE, PORT = "<", "How do you want to go on?", "Give 0.5 ml", "Its serial line"
R, L, DEEPEST, NAME = "R", "L", "Deepest press that this brush can take", "Name of the brush"
WELL, INK, BUS = "What keeps the ink well filled?", "Name of the ink", "CAN bus of the force sensor"


class Typing(Person):
    """Types one answer after the other; `<` goes back, the end of the list leaves."""

    def __init__(self, *answers: str) -> None:
        super().__init__()
        self.answers = list(answers)

    async def ask(self, question: Question) -> Answer:
        self.asked.append(question.text.split(":")[0].split(",")[0])
        if not self.answers:
            raise LeftOff
        if (answer := self.answers.pop(0)) == BACK:
            raise WentBack
        answer = answer or question.default
        assert question.kind != "choose" or answer in {choice.key for choice in question.choices}, question
        return float(answer) if question.kind == "number" else answer


async def led(person: Typing, folder: Path) -> Day:
    """Steps before the brush are done; the person is led through brush and force."""
    day = day_of(person, folder)
    for step in ("arm", "camera", "tip", "sheet", "places"):
        day.save(day.notebook.finished(step))
    with pytest.raises(CollectAborted):
        await Wizard(day, (BrushStep(), ForceStep())).run()
    return day


class Station:
    """An ink station that counts its doses."""

    doses = 0

    async def connect(self) -> object:
        return type("Identity", (), {"model": "station", "firmware": "1"})

    async def level(self) -> None:
        return None

    async def dose(self, ml: float) -> None:
        Station.doses += 1

    async def close(self) -> None:
        pass


@pytest.mark.parametrize(
    ("answers", "asked"),
    [
        (("6", "48", BACK, "47", "20", "", BACK, "wolf"), [R, L, DEEPEST, L, DEEPEST, NAME, WELL, NAME, WELL]),
        (
            ("6", "48", "20", "", "n", "", *[BACK] * 6),
            [R, L, DEEPEST, NAME, WELL, INK, BUS, INK, WELL, NAME, DEEPEST, L, R],
        ),
        (("6", "190", BACK, "47"), [R, L, HOW, L, DEEPEST]),
        (
            ("6", "48", "20", "", "n", "", "no:bus", "b", BACK, "no:bus", "b", "5"),
            [R, L, DEEPEST, NAME, WELL, INK, BUS, HOW, R, BUS, HOW, R, L],
        ),
        (
            ("6", "48", "20", "", "i", "/dev/ttyUSB0", "y", "y", "n", BACK),
            [R, L, DEEPEST, NAME, WELL, PORT, GIVE, GIVE, GIVE, INK, GIVE],
        ),
        (("6", "48", "20", "", "i", ""), [R, L, DEEPEST, NAME, WELL, PORT, HOW]),
    ],
    ids=["one question", "into the step before", "after a refusal", "a step begun afresh", "no dose again", "no line"],
)
async def test_back_asks_the_question_before_and_no_other(
    answers: tuple[str, ...], asked: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(InkStationConfig, "device", lambda *_: Station())
    monkeypatch.setattr(Station, "doses", 0)
    person = Typing(*answers)
    day = await led(person, tmp_path)
    assert person.asked == asked
    assert Station.doses == answers.count("y")
    if asked[-1] == R:
        assert not any(field.startswith("brush.") for field in day.notebook.values)


async def test_a_value_that_cannot_be_is_refused_with_its_range(tmp_path: Path) -> None:
    person = Typing("6", "190")
    await led(person, tmp_path)
    assert any("190 mm cannot be (5 to 180 mm)" in line for line in person.said)


async def test_a_step_that_is_taught_again_by_mistake_is_as_it_was_after_back(tmp_path: Path) -> None:
    await led(Typing("6", "48", "20", "", "n", ""), tmp_path)
    again = Typing(BACK)
    day = Day(again, tmp_path / "rig.toml", HostClock(), armed=False)
    before = day.notebook
    await Wizard(day, (BrushStep(), ForceStep())).again("brush")
    assert again.asked == [R]
    assert day.notebook == before


async def test_a_step_that_is_taught_again_stays_open_until_it_is_done(tmp_path: Path) -> None:
    source = {"camera.source": taught("camera", "http://192.0.2.8/", "typed")}
    TaughtFile(tmp_path / "rig.toml").save(Notebook().with_values(source).finished("arm").finished("camera"))
    day = Day(Person(), tmp_path / "rig.toml", HostClock(), armed=False)
    with pytest.raises(CollectAborted):
        await Wizard(day, (CameraStep(),)).again("camera")
    assert (set(day.notebook.done), day.notebook.values) == ({"arm"}, {})


async def test_a_step_that_failed_says_in_what_state_the_arm_is(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    async def silent(*_: object) -> None:
        error = DeviceTimeout("robot", "moveLine", "no reply in 1 s", condition="A stop was sent to the arm.")
        error.add_note("The arm may still be moving.")
        raise error

    monkeypatch.setattr(CameraStep, "teach", silent)
    person = Person()
    with pytest.raises(CollectAborted):
        await Wizard(Day(person, tmp_path / "rig.toml", HostClock(), armed=True), (CameraStep(),)).run()
    assert person.said[0].endswith("no reply in 1 s. A stop was sent to the arm. The arm may still be moving.")
