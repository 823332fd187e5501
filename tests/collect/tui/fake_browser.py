"""A session browser and a session without a disk, for screens that show them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from brushloop.collect.engine.last_capture import LastCapture
from brushloop.collect.tui.app import OperatorApp
from brushloop.collect.tui.pictures import Pictures
from brushloop.collect.tui.review_screen import Review, ReviewCapture, ReviewScreen
from brushloop.collect.tui.start_screen import SessionBrowser
from brushloop.sessions.events import CaptureResult, Press, Remark
from brushloop.sessions.records import Condition, Header, Source
from brushloop.sessions.show import Details, Summary
from tests.collect.tui.fake import blot

LATE = "touched the paper 10.2 s after its dip, the others after 1.1 s"


def engine_for(*_arguments: Any, **_options: Any) -> Any:
    raise AssertionError("no engine is made")


class FakeBrowser(SessionBrowser):
    """Two sessions, one cut in its middle."""

    def __init__(self) -> None:
        super().__init__(engine_for)
        self.asked: list[Any] = []

    def recent(self) -> list[Summary]:
        return [
            Summary("2026-11-21-grid-02", "open", "", 13, ""),
            Summary("2026-11-21-grid-01", "closed", "loopback rig", 150, "2026-11-21-grid-01.mcap"),
        ]

    def standing(self, session_id: str) -> Details:
        header = Header(session_id=session_id, source=Source.LOOPBACK, software="brushloop 0.1")
        details = Details(session_id, "open", header, {"capture": 13}, strokes=13, planned=30)
        details.void = ["press H15-a5-r01, attempt 1: the process ended during it"]
        details.next, details.sheets = "press H15-a5-r01", {1: [1, 2]}
        return details

    def planned(self) -> str:
        return "30 strokes on 1 sheet, about 21 min"


def captured(stroke_id: str, still: int, waited_s: float | None = None, verdict: str = "") -> CaptureResult:
    press = Press(stroke_id=stroke_id, condition=Condition(13.0, 0.0), dip_to_touch_s=waited_s)
    return CaptureResult(press=press, still=still, kept=not verdict, verdict=verdict)


class FakeReview(Review):
    """Three captures of one cell, one of them marked bad."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder / "2026-11-21-grid-01"
        self.folder.mkdir(exist_ok=True)
        self.read()

    def read(self) -> None:
        self.open = False
        bad = Remark(t_ns=1, still=7, stroke_id="H13-a0-r02", bad=True, note="smudged, 墨 ran")
        self.captures = (
            ReviewCapture(captured("H13-a0-r01", 4, 1.24), "0004-capture-a.mcap", None),
            ReviewCapture(captured("H13-a0-r02", 7), "0007-capture-b.mcap", bad),
            ReviewCapture(captured("H13-a0-r03", 10, 10.2, "split"), "0010-capture-c.mcap", None, LATE),
        )

    def pictures(self, capture: ReviewCapture) -> LastCapture:
        binary = blot()
        photo = np.where(binary, 40, 210).astype(np.uint8)
        return LastCapture(capture.press, capture.result.still, True, None, photo, binary)

    def repeatability(self, condition: Condition) -> tuple[float, int] | None:
        return 0.914, 9


def a_review(folder: Path, app: OperatorApp) -> ReviewScreen:
    return ReviewScreen(FakeReview(folder), Pictures(), app._finish, at_work=lambda: app.at_work)
