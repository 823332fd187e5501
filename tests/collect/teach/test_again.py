"""A step that is taught again, and what becomes of it if the person leaves off in the middle."""

from __future__ import annotations

from pathlib import Path

import pytest

from brushloop.collect.errors import CollectAborted
from brushloop.collect.teach.day import Day
from brushloop.collect.teach.guide import LeftOff, Shown, StepState
from brushloop.collect.teach.steps.camera import CameraStep
from brushloop.collect.teach.store import Notebook, Taught, TaughtFile, now_utc
from brushloop.collect.teach.wizard import Wizard
from brushloop.drivers.errors import DeviceTimeout
from brushloop.drivers.host import HostClock


class Leaving:
    """A person who leaves at the first question."""

    def __init__(self) -> None:
        self.shown: list[str] = []

    async def overview(self, steps: tuple[StepState, ...]) -> None:
        pass

    async def show(self, what: Shown) -> None:
        self.shown += what.lines

    async def choose(self, *_: object) -> str:
        raise LeftOff

    async def number(self, *_: object) -> float:
        raise LeftOff


async def test_a_step_that_is_taught_again_stays_open_until_it_is_done(tmp_path: Path) -> None:
    values = {
        "camera.source": Taught(value="http://192.0.2.8/", how="typed", at=now_utc(), step="camera"),
        "aside.frame_rate_hz": Taught(value=10.0, how="counted", at=now_utc(), step="camera"),
    }
    taught = Notebook().with_values(values).finished("arm").finished("camera")
    TaughtFile(tmp_path / "rig.toml").save(taught)
    day = Day(Leaving(), tmp_path / "rig.toml", HostClock(), armed=False)  # type: ignore[arg-type]
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
    person = Leaving()
    day = Day(person, tmp_path / "rig.toml", HostClock(), armed=True)  # type: ignore[arg-type]
    with pytest.raises(CollectAborted):
        await Wizard(day, (CameraStep(),)).run()
    assert person.shown[0] == (
        "robot: moveLine: no reply in 1 s. A stop was sent to the arm. The arm may still be moving."
    )
