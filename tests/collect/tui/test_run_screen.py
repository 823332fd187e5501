"""`run_screen` leaves no arm unwatched: signals, lost terminals and its own defects."""

from __future__ import annotations

import asyncio
import functools
import io
import os
import signal

import pytest
from textual.pilot import Pilot

from brushloop.collect.errors import CollectAborted
from brushloop.collect.tui.app import OperatorApp
from brushloop.collect.tui.runner import ScreenCrashed, run_screen
from brushloop.collect.tui.terminal import TerminalDriver, _LostWrites
from tests.collect.tui.fake import FakeEngine, picture


def without_terminal(monkeypatch: pytest.MonkeyPatch, pilot: object) -> None:
    monkeypatch.setattr(OperatorApp, "run", functools.partialmethod(OperatorApp.run, headless=True, auto_pilot=pilot))


async def until_over(pilot: Pilot[None]) -> None:
    while pilot.app.is_running:
        await asyncio.sleep(0.02)


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_a_signal_stops_the_arm_and_ends_the_screen(number: int, monkeypatch: pytest.MonkeyPatch) -> None:
    async def send(pilot: Pilot[None]) -> None:
        os.kill(os.getpid(), number)
        await until_over(pilot)

    without_terminal(monkeypatch, send)
    engine = FakeEngine(picture())
    before = signal.getsignal(number)
    with pytest.raises(CollectAborted):
        run_screen(engine)
    assert engine.calls == ["start", "stop", "join"]
    assert signal.getsignal(number) == before


def test_a_lost_terminal_parks_the_arm_and_ends_the_screen(monkeypatch: pytest.MonkeyPatch) -> None:
    async def hang_up(pilot: Pilot[None]) -> None:
        os.kill(os.getpid(), signal.SIGHUP)
        await until_over(pilot)

    without_terminal(monkeypatch, hang_up)
    engine = FakeEngine(picture())
    with pytest.raises(CollectAborted):
        run_screen(engine)
    assert engine.calls == ["start", "park", "join"]


def test_y_ends_it_with_what_ended_the_run(monkeypatch: pytest.MonkeyPatch) -> None:
    async def press(pilot: Pilot[None]) -> None:
        await pilot.pause(0.3)
        await pilot.press("q", "y")
        await until_over(pilot)

    without_terminal(monkeypatch, press)
    engine = FakeEngine(picture())
    with pytest.raises(CollectAborted):
        run_screen(engine)
    assert engine.calls == ["start", "park", "join"]


def test_a_screen_that_breaks_stops_the_arm(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    class Broken(FakeEngine):
        def snapshot(self):
            if self.looks > 2:
                raise ZeroDivisionError
            return super().snapshot()

    without_terminal(monkeypatch, until_over)
    engine = Broken(picture())
    with pytest.raises(ScreenCrashed):
        run_screen(engine)
    assert engine.calls == ["start", "stop", "join"]
    assert "ZeroDivisionError" in capsys.readouterr().err


def test_a_screen_that_cannot_begin_stops_the_arm(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(_app: OperatorApp) -> None:
        raise OSError("no terminal")

    monkeypatch.setattr(OperatorApp, "run", refuse)
    engine = FakeEngine(picture())
    with pytest.raises(OSError, match="no terminal"):
        run_screen(engine)
    assert engine.calls == ["start", "stop", "join"]


def test_writes_to_a_lost_terminal_are_lost_and_hurt_nobody() -> None:
    class Gone(io.StringIO):
        def write(self, _text: str) -> int:
            raise OSError(5, "Input/output error")

        def flush(self) -> None:
            raise OSError(5, "Input/output error")

    file = _LostWrites(Gone())
    assert file.write("abc") == 3
    file.flush()


def test_a_hang_up_does_not_start_the_driver_twice(monkeypatch: pytest.MonkeyPatch) -> None:
    started: list[str] = []
    monkeypatch.setattr(TerminalDriver, "start_application_mode", lambda _driver: started.append("start"))
    driver = TerminalDriver.__new__(TerminalDriver)
    driver.resume_application_mode()
    assert started == []
