"""Going back, teaching a step again, leaving off: what was answered before is as it was."""

from __future__ import annotations

from pathlib import Path

import pytest

from brushloop.collect.errors import CollectAborted
from brushloop.collect.teach import brush
from brushloop.collect.teach.brush import STATION, BrushStep
from brushloop.collect.teach.camera import CameraStep
from brushloop.collect.teach.day import Day
from brushloop.collect.teach.force import ForceStep
from brushloop.collect.teach.guide import LeftOff, Question, Shown, StepState, WentBack
from brushloop.collect.teach.store import Notebook, Taught, TaughtFile, now_utc
from brushloop.collect.teach.wizard import Wizard
from brushloop.drivers.errors import DeviceTimeout
from brushloop.drivers.host import HostClock

TAUGHT = {
    "robot.tcp_offset_mm": [0.0, 0.0, 180.0],
    "paper.size_mm": [240.0, 160.0],
    "aside.plane": [98.0, 0.0, 0.0],
}
BACK, LEAVE = "<", "q"


class Typing:
    """A person who types one answer after the other; `<` goes back, the end of the list leaves."""

    def __init__(self, *answers: str) -> None:
        self.answers = list(answers)
        self.asked: list[str] = []
        self.trouble: list[str] = []

    async def overview(self, steps: tuple[StepState, ...]) -> None:
        pass

    async def show(self, what: Shown) -> None:
        if what.tone == "trouble":
            self.trouble += what.lines

    async def ask(self, question: Question) -> str | float:
        self.asked.append(question.text.split(":")[0].split(",")[0])
        if not self.answers:
            raise LeftOff
        if (answer := self.answers.pop(0)) == BACK:
            raise WentBack
        answer = answer or question.default
        assert question.kind != "choose" or answer in {choice.key for choice in question.choices}, question
        return float(answer) if question.kind == "number" else answer


def begun(person: Typing, folder: Path) -> Day:
    """A day on which the steps before the brush are done."""
    day = Day(person, folder / "rig.toml", HostClock(), armed=False)  # type: ignore[arg-type]
    for field, value in TAUGHT.items():
        taught = Taught(value=value, how="typed", at=now_utc(), step="tip")
        day.save(day.notebook.with_values({field: taught}))
    for step in ("arm", "camera", "tip", "sheet", "places"):
        day.save(day.notebook.finished(step))
    return day


async def led(person: Typing, folder: Path) -> Day:
    day = begun(person, folder)
    with pytest.raises(CollectAborted):
        await Wizard(day, (BrushStep(), ForceStep())).run()
    return day


R, L, DEEPEST = "R", "L", "Deepest press that this brush can take"
NAME, WELL, INK, BUS = (
    "Name of the brush",
    "What keeps the ink well filled?",
    "Name of the ink",
    "CAN bus of the force sensor",
)


async def test_back_asks_the_question_before_and_no_other(tmp_path: Path) -> None:
    person = Typing("6", "48", BACK, "47", "20", "", BACK, "wolf")
    day = await led(person, tmp_path)
    assert person.asked == [R, L, DEEPEST, L, DEEPEST, NAME, WELL, NAME, WELL]
    assert (day.notebook.get("brush.radius_mm"), day.notebook.get("brush.length_mm")) == (6.0, 47.0)
    assert day.notebook.get("brush.name") == "wolf"


async def test_back_goes_on_to_the_first_question_and_into_the_step_before(tmp_path: Path) -> None:
    person = Typing("6", "48", "20", "", "n", "", BACK, BACK, BACK, BACK, BACK, BACK)
    day = await led(person, tmp_path)
    assert person.asked == [R, L, DEEPEST, NAME, WELL, INK, BUS, INK, WELL, NAME, DEEPEST, L, R]
    assert "brush" not in day.notebook.done
    assert not any(field.startswith("brush.") for field in day.notebook.values)


async def test_after_a_refusal_back_leads_to_what_was_typed_before_it(tmp_path: Path) -> None:
    person = Typing("6", "190", BACK, "47")
    await led(person, tmp_path)
    assert "190 mm cannot be (5 to 180 mm)" in person.trouble[0]
    assert person.asked == [R, L, "How do you want to go on?", L, DEEPEST]


async def test_a_step_can_be_begun_afresh_or_the_one_before_it_and_back_undoes_that(tmp_path: Path) -> None:
    person = Typing("6", "48", "20", "", "n", "", "no:bus", "b", BACK, "no:bus", "b", "5")
    day = await led(person, tmp_path)
    how = "How do you want to go on?"
    assert person.asked == [R, L, DEEPEST, NAME, WELL, INK, BUS, how, R, BUS, how, R, L]
    assert "brush" not in day.notebook.done


async def test_going_back_doses_nothing_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    doses: list[float] = []

    class Station:
        async def connect(self) -> object:
            return type("Identity", (), {"model": "station", "firmware": "1"})

        async def level(self) -> None:
            return None

        async def dose(self, ml: float) -> None:
            doses.append(ml)

        async def close(self) -> None:
            pass

    monkeypatch.setattr(brush, "make_ink", lambda *_: Station())
    person = Typing("6", "48", "20", "", "i", "/dev/ttyUSB0", "y", "y", "n", BACK)
    await led(person, tmp_path)
    give = person.asked[6]
    assert give.startswith("Give 0.5 ml")
    assert person.asked == [R, L, DEEPEST, NAME, WELL, "Its serial line", give, give, give, INK, give]
    assert len(doses) == 2


async def test_a_step_that_is_taught_again_by_mistake_is_as_it_was_after_back(tmp_path: Path) -> None:
    person = Typing("6", "48", "20", "", "n", "")
    await led(person, tmp_path)
    again = Typing(BACK)
    day = Day(again, tmp_path / "rig.toml", HostClock(), armed=False)  # type: ignore[arg-type]
    before = day.notebook
    await Wizard(day, (BrushStep(), ForceStep())).again("brush")
    assert again.asked == [R]
    assert day.notebook == before


class LeavingAtOnce:
    """A person who leaves at the first question."""

    def __init__(self) -> None:
        self.shown: list[str] = []

    async def overview(self, steps: tuple[StepState, ...]) -> None:
        pass

    async def show(self, what: Shown) -> None:
        self.shown += what.lines

    async def ask(self, _: Question) -> str:
        raise LeftOff


async def test_a_step_that_is_taught_again_stays_open_until_it_is_done(tmp_path: Path) -> None:
    values = {
        "camera.source": Taught(value="http://192.0.2.8/", how="typed", at=now_utc(), step="camera"),
        "aside.frame_rate_hz": Taught(value=10.0, how="counted", at=now_utc(), step="camera"),
    }
    taught = Notebook().with_values(values).finished("arm").finished("camera")
    TaughtFile(tmp_path / "rig.toml").save(taught)
    day = Day(LeavingAtOnce(), tmp_path / "rig.toml", HostClock(), armed=False)  # type: ignore[arg-type]
    with pytest.raises(CollectAborted):
        await Wizard(day, (CameraStep(),)).again("camera")
    assert set(day.notebook.done) == {"arm"}
    assert day.notebook.values == {}


async def test_a_step_that_failed_says_in_what_state_the_arm_is(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    async def silent(*_: object) -> None:
        error = DeviceTimeout("robot", "moveLine", "no reply in 1 s", condition="A stop was sent to the arm.")
        error.add_note("The arm may still be moving.")
        raise error

    monkeypatch.setattr(CameraStep, "teach", silent)
    person = LeavingAtOnce()
    day = Day(person, tmp_path / "rig.toml", HostClock(), armed=True)  # type: ignore[arg-type]
    with pytest.raises(CollectAborted):
        await Wizard(day, (CameraStep(),)).run()
    assert person.shown[0] == (
        "robot: moveLine: no reply in 1 s. A stop was sent to the arm. The arm may still be moving."
    )


async def test_an_ink_device_without_a_serial_line_is_refused_with_the_way_out(tmp_path: Path) -> None:
    person = Typing("6", "48", "20", "", STATION.key, "")
    await led(person, tmp_path)
    assert person.trouble[0] == "no serial line was named."
    assert person.trouble[1].startswith("Type its path")
