"""Engines, sessions, a browser and a first day without an arm or a disk, and what a screen shows of them as text."""

from __future__ import annotations

import contextlib
import math
from collections.abc import AsyncGenerator, Awaitable, Callable
from concurrent.futures import wait
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any
from unittest.mock import patch

import cv2
import numpy as np
import pytest
from rich.cells import cell_len
from rich.console import Console  # noqa: TID251
from textual.app import App
from textual.pilot import Pilot

from brushloop.collect.commission.visit import Visit
from brushloop.collect.engine.capture import AGAIN, KEEP, SKIP, mark_of
from brushloop.collect.engine.control import State
from brushloop.collect.engine.engine import Engine
from brushloop.collect.engine.snapshot import ConditionCount, LastCapture, Mark, Picture, SheetMap, Snapshot
from brushloop.collect.errors import CollectAborted, ConfigError
from brushloop.collect.operator import Choice, OperatorRequest, Prompt
from brushloop.collect.photograph.checks import Verdict
from brushloop.collect.tui.app import OperatorApp
from brushloop.collect.tui.commission_app import CommissionApp
from brushloop.collect.tui.review_screen import Review, ReviewCapture
from brushloop.collect.tui.start_screen import SessionBrowser
from brushloop.drivers.host import Clock
from brushloop.model.fitted import FittedPress
from brushloop.sessions.events import CaptureResult, Press
from brushloop.sessions.records import Check, Condition, Header, Source
from brushloop.sessions.show import Details, Summary
from tests.waiting import until

HEIGHTS_MM = (11.0, 13.0, 15.0, 17.0, 20.0)
TILTS_DEG = (0.0, 5.0, 10.0)
ERROR = (
    "aubo-arcs: move: protective stop: joint 4 torque 31.2 N m above 28.0 N m. "
    "The arm stands where it stopped; the brush may be on the paper.\n"
    "Release the stop at the pendant, then run the same command again: it begins with a retreat."
)


def marked_grid() -> tuple[ConditionCount, ...]:
    """Thirteen strokes of thirty, and every sign once: a bad take, one left out, one now, one next; the more important
    of two."""
    conditions = [Condition(h, a) for h in HEIGHTS_MM for a in TILTS_DEG]
    cells = [ConditionCount(asked, min(max(13 - 2 * n, 0), 2), 2) for n, asked in enumerate(conditions)]
    cells[1] = replace(cells[1], bad=2)
    cells[3] = replace(cells[3], done=1, left_out=1, bad=3)
    cells[6] = replace(cells[6], now=True, bad=1)
    cells[8] = replace(cells[8], next=True, bad=1)
    return tuple(cells)


def marked_sheet() -> SheetMap:
    """Seventeen used patches of 42, with every sign."""
    marks: list[Mark | None] = [Mark.KEPT] * 17
    marks[2], marks[5], marks[0], marks[-1] = Mark.BAD, Mark.VOID, Mark.CHECK, Mark.NOW
    return SheetMap(1, 6, (*marks, *([None] * 25)))


def blot(size: int = 128) -> np.ndarray[Any, np.dtype[np.bool_]]:
    """Something like a stroke."""
    y, x = np.mgrid[0:size, 0:size] / size
    return ((x - 0.5) / 0.35) ** 2 + ((y - 0.5) / (0.04 + 0.12 * x)) ** 2 < 1.0


def capture(*, kept: bool = True) -> LastCapture:
    """The last one, whose tip is split if it is not kept."""
    score, reason = (0.02, "") if kept else (0.42, "The tip is split.")
    verdict = Verdict(
        (
            Check(name="exposure", score=201.0, unit="of 255", threshold=250.0, passed=True),
            Check(name="blurred", score=0.11, unit="mm", threshold=0.25, passed=True),
            Check(name="dry", score=0.06, threshold=0.125, passed=True),
            Check(name="split", score=score, unit="mm", threshold=0.3, passed=kept, reason=reason),
        )
    )
    binary = blot()
    photo = np.where(binary, 45, 205).astype(np.uint8).repeat(4, axis=0).repeat(4, axis=1)
    model = mark_of(FittedPress(6.0, 48.0), Condition(15.0, 5.0))
    press = Press(stroke_id="H15-a5-r01", condition=Condition(15.0, 5.0))
    return LastCapture(press, 41, kept, verdict, photo, binary, model)


def camera_picture() -> Picture:
    y, x = np.mgrid[0:240, 0:320]
    image = (170 + 40 * x / 320 - 20 * y / 240).astype(np.uint8)
    image[((x // 20 + y // 20) % 2 == 0) & ((x < 60) | (y > 180))] = 40
    return Picture(image, 0.9)


def picture(**changes: Any) -> Snapshot:
    """A run in its middle, with what differs."""
    running = Snapshot(
        session_id="2026-11-21-grid-01",
        source="loopback rig",
        state=State.RUNNING,
        step="press H15-a5-r02",
        strokes_done=13,
        strokes_planned=30,
        grid=marked_grid(),
        voids=1,
        elapsed_s=185.0,
        eta_s=242.0,
        tip_mm=(123.4, -45.25, 12.0),
        messages=("session: 2026-11-21-grid-01", *(f"capture {n}: blob 212 mm2, sharp" for n in range(1, 14))),
        error="",
    )
    return replace(running, **changes)


def full_picture(**changes: Any) -> Snapshot:
    """The same with everything that a screen can show."""
    values: dict[str, Any] = {
        "target_mm": (123.4, -45.25, 7.0),
        "force_n": 0.041,
        "force_ceiling_n": 5.0,
        "ink_level": 0.63,
        "given_up": 1,
        "trace_n": tuple(0.03 * max(0.0, math.sin(n / 9)) for n in range(70, 120)),
        "sheet": marked_sheet(),
        "last": capture(),
        "picture": camera_picture(),
        "folder": "",
    }
    return picture(**(values | changes))


SPLIT = Prompt(
    "H15-a5-r01: The tip is split by 0.42 mm. Comb the brush.",
    (KEEP, AGAIN, SKIP),
    "k",
    image=capture(kept=False).photo,
    number=3,
)
TOUCHED = Prompt(
    "Zero touch and plane: not everything is within limits.\n"
    "  method               force\n"
    "  point 1 (4, 4)       120.012 mm\n"
    "!   span of touches    0.180 mm  (at most 0.15)\n"
    "  plane                assumed level: fewer than three points",
    (
        Choice("g", "go on anyway"),
        Choice("a", "measure again"),
        Choice("b", "measure by jog"),
        Choice("f", "measure by force"),
        Choice("x", "stop the run"),
    ),
    "x",
    number=2,
)
FAILED = picture(state=State.FAILED, error=ERROR, messages=("capture 13: blob 212 mm2, sharp", f"warning: {ERROR}"))


class FakeEngine:
    """`Engine` without an arm, which notes what is asked of it; a stop or a park leads straight to its end."""

    def __init__(self, now: Snapshot) -> None:
        self.now = now
        self.calls: list[str] = []
        self.looks = 0
        self.finished = False
        self.control = self

    def snapshot(self) -> Snapshot:
        self.looks += 1
        return self.now

    def pause(self) -> None:
        self.calls.append("pause")

    def resume(self) -> None:
        self.calls.append("resume")

    def answer(self, number: int, key: str) -> bool:
        self.calls.append(f"answer {number} {key}")
        return True

    def toggle(self, request: OperatorRequest) -> None:
        self.calls.append(f"request {request.name}")
        self.now = replace(self.now, requests=(*self.now.requests, request))

    obey = Engine.obey

    def park(self) -> None:
        self.calls.append("park")
        self.now = replace(self.now, state=State.STOPPED, parked=True, prompt=None)
        self.finished = True

    def stop(self) -> None:
        self.calls.append("stop")
        self.finished = True

    def start(self) -> None:
        self.calls.append("start")

    def join(self) -> None:
        self.calls.append("join")
        assert self.finished
        raise CollectAborted("stopped; the session can be resumed with the same command")


LATE = "touched the paper 10.2 s after its dip, other strokes after 1.1 s"


class FakeBrowser(SessionBrowser):
    """Two sessions, one cut in its middle."""

    def __init__(self) -> None:
        super().__init__()
        self.asked: list[Any] = []

    def recent(self) -> list[Summary]:
        return [
            Summary("2026-11-21-grid-02", "open", "", 13, ""),
            Summary("2026-11-21-grid-01", "closed", "loopback rig", 150, "2026-11-21-grid-01.mcap"),
        ]

    def standing(self, session_id: str) -> Details:
        header = Header(session_id=session_id, source=Source.LOOPBACK, software="brushloop 0.1")
        details = Details(session_id, "open", header, {"capture": 13}, strokes=13, planned=30)
        details.void = ["press H15-a5-r01, attempt 1: the process ended during the step"]
        details.next, details.sheets = "press H15-a5-r01", {1: [1, 2]}
        return details

    def engine(self, session_id: str | None) -> Any:
        self.asked.append(session_id)
        if session_id is None:
            raise ConfigError("rig.toml", "robot", "another brushloop is driving the arm")
        return FakeEngine(picture())

    def planned(self) -> str:
        return "30 strokes on 1 sheet, about 21 min"


def captured(stroke_id: str, still: int, waited_s: float | None = None, verdict: str = "") -> CaptureResult:
    press = Press(stroke_id=stroke_id, condition=Condition(13.0, 0.0), dip_to_touch_s=waited_s)
    return CaptureResult(press=press, still=still, kept=not verdict, verdict=verdict)


class FakeReview(Review):
    """Three captures of one condition, one of them marked bad."""

    def __init__(self) -> None:
        self.folder = Path("2026-11-21-grid-01")
        self.open = False
        self.captures = (
            ReviewCapture(captured("H13-a0-r01", 4, 1.24), "0004-capture-a.mcap"),
            ReviewCapture(captured("H13-a0-r02", 7), "0007-capture-b.mcap", marked_bad=True, note="smudged, 墨 ran"),
            ReviewCapture(captured("H13-a0-r03", 10, 10.2, "split"), "0010-capture-c.mcap", unlike=LATE),
        )

    def pictures(self, capture: ReviewCapture) -> LastCapture:
        binary = blot()
        photo = np.where(binary, 40, 210).astype(np.uint8)
        return LastCapture(capture.press, capture.result.still, True, None, photo, binary)

    def repeatability(self, condition: Condition) -> str:
        return "mean CSIM 91.4 % between pairs, from 9 presses (identical: 100 %)"


def app_of(engine: Any = None, browser: FakeBrowser | None = None) -> OperatorApp:
    """The app of one run, or of a day; neither resumes anything."""
    return OperatorApp(pytest.fail, engine, browser=browser)


def shown(app: App[None]) -> str:
    """The lines of the screen, without blanks at their ends; fewer of them while a new screen has no layout yet.

    Drawing them as SVG takes five times as long.
    """
    with patch.object(Console, "export_svg", lambda console, **_style: console.export_text()):
        lines = [line.rstrip() for line in app.export_screenshot().splitlines()]
    assert len(lines) <= app.size.height
    assert all(cell_len(line) <= app.size.width for line in lines)
    return "\n".join(lines)


async def settled(pilot: Pilot[Any], polls: int = 5) -> str:
    """The screen once it is laid out, every worker has done its work, and a run was looked at so many times more: the
    first poll may come before the layout has its sizes, and the parts of a screen take turns."""
    engine = pilot.app.engine  # pyright: ignore[reportAttributeAccessIssue]
    enough = engine.looks + polls if engine is not None else 0
    while engine is not None and engine.looks < enough:
        await pilot.pause(0.02)
    await pilot.app.workers.wait_for_complete()
    await pilot.pause()
    return shown(pilot.app)


@dataclass(frozen=True)
class Watched:
    """A run on the screen, and somebody at its keyboard."""

    engine: FakeEngine
    app: OperatorApp
    pilot: Pilot[None]

    async def look(self, now: Snapshot | None = None) -> str:
        """The screen, with what is to be shown from now on."""
        self.engine.now = now or self.engine.now
        return await settled(self.pilot, polls=2)

    async def press(self, *keys: str) -> None:
        await self.pilot.press(*keys)


@contextlib.asynccontextmanager
async def watched(now: Snapshot, size: tuple[int, int] = (80, 24)) -> AsyncGenerator[Watched]:
    """A run that is shown until the end of the block."""
    engine = FakeEngine(now)
    app = app_of(engine)
    async with app.run_test(size=size, notifications=True) as pilot:
        run = Watched(engine, app, pilot)
        await run.look()
        yield run


# A first day


async def brings(visit: Visit) -> bool:
    """Ask for the tip at a pin, with a picture of the board."""
    board = cv2.aruco.CharucoBoard((7, 5), 20.0, 15.0, cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_5X5_100))
    visit.say("the board as the camera sees it", picture=board.generateImage((560, 400), marginSize=20))
    how = "Guide the tip to the pin by hand, the brush leaning toward the window, then press Enter."
    return await visit.brought("pin 2", how, may_skip=True)


class Asking:
    """Asks the given questions, and notes the answers."""

    def __init__(self, *questions: Callable[[Visit], Awaitable[object]]) -> None:
        self.questions = questions
        self.answers: list[object] = []
        self.visit = Visit(Path("rig.toml"), Clock(), armed=False)
        self.app = CommissionApp(self.visit, self)

    async def __call__(self) -> None:
        self.visit.step = "step 3 of 9: Tip of the brush, about 8 min"
        self.visit.say("five directions: the tip is known to 0.11 mm", "residuals 0.10, 0.24, 0.08, 0.17, 0.21 mm")
        self.visit.say("direction 2 is like direction 1: lean the brush farther", tone="warning")
        for ask in self.questions:
            self.answers.append(await ask(self.visit))

    async def asked(self, pilot: Pilot[Any]) -> None:
        """Once the first question is on the screen."""
        first_day = self.app.first_day
        await until(lambda: first_day.is_mounted and first_day.prompt is not None, "the first question")
        await pilot.pause()

    def end(self) -> None:
        """Stop what a test has left."""
        self.app.steps.stop()
        wait([self.app.steps.outcome])
