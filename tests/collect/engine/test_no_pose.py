"""An arm that no longer sends its pose: the screens say so after a second, long before a call times out."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from brushloop.collect import start
from brushloop.collect.engine.control import State
from brushloop.collect.engine.engine import Engine
from brushloop.collect.engine.open_or_resume import CollectRequest, Opening
from brushloop.collect.engine.snapshot import Snapshot
from brushloop.collect.protocols.kinds import GridConfig
from brushloop.collect.rig.config import load_rig
from brushloop.collect.rig.devices import Rig, make_robot
from brushloop.collect.tui.app import OperatorApp
from brushloop.drivers.devices import Identity
from brushloop.drivers.geometry import brush_pose
from brushloop.drivers.sim.config import SimConfig
from brushloop.drivers.sim.rig import Addresses, rig_toml
from tests.collect.tui.fake import TOUCHED, FakeEngine, look, picture

WHO = Identity("robot", "aubo_i5", "", True)


class HandClock:
    """Time that a test sets."""

    seconds = 0.0

    def now_ns(self) -> int:
        return round(self.seconds * 1e9)


def test_the_snapshot_says_for_how_long_no_pose_has_come(tmp_path: Path) -> None:
    (tmp_path / "rig.toml").write_text(rig_toml(SimConfig(), Addresses("127.0.0.1", 1, 1, 1, 1, None)))
    config, clock = load_rig(tmp_path / "rig.toml"), HandClock()
    robot = make_robot(config, clock, print)
    devices: Any = robot
    grid = GridConfig(kind="grid", depths_mm=[11.0], tilts_deg=[0.0])
    request = CollectRequest(tmp_path / "rig.toml", tmp_path / "protocol.toml")
    engine = Engine(Opening(request, config, grid, {}), None, clock)
    assert engine.snapshot().no_pose_s is None, "not connected yet"
    engine._rig = Rig(config, clock, robot, devices, WHO, WHO)
    assert engine.snapshot().no_pose_s is None, "no pose yet"
    robot._telemetry._take(brush_pose(300.0, 0.0, 200.0))

    for seconds, shown_s in ((0.4, None), (0.9, None), (1.4, 1.4), (20.0, 20.0)):
        clock.seconds = seconds
        now = engine.snapshot()
        assert now.no_pose_s == (None if shown_s is None else pytest.approx(shown_s))
        assert (now.tip_mm is None) is (seconds > 0.5)
    robot._telemetry._take(brush_pose(300.0, 0.0, 200.0))
    assert engine.snapshot().no_pose_s is None, "it sends again"
    clock.seconds += 30.0
    engine._control.end(State.FAILED)
    assert engine.snapshot().no_pose_s is None, "a run that is over has let the arm go"


async def test_the_run_screen_is_not_green_without_a_pose() -> None:
    engine = FakeEngine(picture())
    app = OperatorApp(engine)
    async with app.run_test(size=(80, 24)) as pilot:
        await look(app, pilot)
        state = app.screen.query_one("#state")
        green = state.styles.background
        engine.now = picture(tip_mm=None, no_pose_s=1.44)
        await look(app, pilot)
        assert str(state.render()) == "RUNNING\nno pose for 1.4 s"
        assert state.styles.background != green
        assert "no pose for 1.4 s" in str(app.screen.query_one("#figures").render())
        engine.now = picture(state=State.PAUSED, tip_mm=None, no_pose_s=75.2)
        await look(app, pilot)
        assert str(state.render()) == "PAUSED\nno pose for 75 s"
        engine.now = picture()
        await look(app, pilot)
        assert (str(state.render()), state.styles.background) == ("RUNNING", green)


async def test_a_question_says_it_beside_the_tip() -> None:
    app = OperatorApp(FakeEngine(picture(state=State.ASKING, prompt=TOUCHED, tip_mm=None, no_pose_s=1.44)))
    async with app.run_test(size=(110, 30)) as pilot:
        await look(app, pilot)
        assert "Tip      no pose for 1.4 s" in str(app.screen.query_one("#live").render())


def test_without_a_screen_it_is_one_line_when_it_begins_and_one_when_it_ends(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    class Scripted(FakeEngine):
        def __init__(self, shots: Iterator[Snapshot]) -> None:
            super().__init__(next(shots))
            self._shots = shots

        def snapshot(self) -> Snapshot:
            self.now = next(self._shots, self.now)
            return self.now

        @property
        def finished(self) -> bool:
            return self.now.state is State.DONE

    shots = [picture(messages=(), no_pose_s=s) for s in (None, None, 1.04, 1.1, 2.0, None)]
    monkeypatch.setattr(start, "REFRESH_S", 0.0)
    start.show_progress(Scripted(iter([*shots, picture(state=State.DONE, messages=())])))
    printed = [line for line in capsys.readouterr().err.splitlines() if "pose" in line]
    assert printed == ["warning: no pose for 1.0 s", "the arm sends its pose again"]
